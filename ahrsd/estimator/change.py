"""Whether an epoch contradicts a calibration as a whole: the iron has changed.

A magnet that passes disturbs some rows; one that stays with the sensor disturbs them all, and
another hard iron explains what it does. A field that differs from place to place does neither.
"""

from __future__ import annotations

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.epoch import Epoch
from ahrsd.samples import Array

_MOST_ROWS = 0.6
_EXPLAINED = 0.9  # share of the epoch's cost that another hard iron alone must take away
_FREE = np.r_[6:9, 12:16]  # hard iron and borders among the numbers of `chain.Quadratic`


def spoken(at_s: float) -> str:
    """What is said of a change at that time."""
    return f"the iron changed at about {at_s:.0f} s: calibrated anew from there"


def contradicts(
    epoch: Epoch, c: Array, covariance: Array, usual: chain.Noise, limit_sigma: float
) -> bool:
    """Most of its rows are beyond what noise and the covariance (9, 9) of c allow, and b mends it.

    Its directions must still be where the epoch was linearised, at c.
    """
    u = chain.move(epoch.u, epoch.quadratic, np.zeros(chain.WIDTH))
    J = chain.symmetric_columns(epoch.data.seen(u))
    J = np.concatenate([J, np.broadcast_to(np.eye(3), (len(u), 3, 3))], axis=2)
    known = np.sum((J @ covariance) * J, axis=(1, 2))
    error = np.sum(epoch.data.field_error(u, c) ** 2, axis=1)
    beyond = error > limit_sigma**2 * (usual.mag_gauss**2 / epoch.data.count + known)
    if not epoch.turned or float(np.mean(beyond)) <= _MOST_ROWS:
        return False
    q = epoch.quadratic
    H, g = q.H[np.ix_(_FREE, _FREE)], q.g[_FREE]
    explained = 0.5 * g @ np.linalg.lstsq(H, g, rcond=1e-12)[0]
    return bool(explained > _EXPLAINED * q.cost)
