"""Whether an epoch contradicts a calibration as a whole: the iron has changed.

A magnet that passes disturbs some rows, one that stays with the sensor disturbs them all.
"""

from __future__ import annotations

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.epoch import Epoch
from ahrsd.samples import Array

_MOST_ROWS = 0.6


def contradicts(
    epoch: Epoch, c: Array, covariance: Array, usual: chain.Noise, limit_sigma: float
) -> bool:
    """Most of its rows are beyond what noise and the covariance (9, 9) of c allow.

    Its directions must still be where the epoch was linearised, at c.
    """
    u = chain.move(epoch.u, epoch.quadratic, np.zeros(chain.WIDTH))
    J = chain.symmetric_columns(epoch.data.seen(u))
    J = np.concatenate([J, np.broadcast_to(np.eye(3), (len(u), 3, 3))], axis=2)
    known = np.sum((J @ covariance) * J, axis=(1, 2))
    error = np.sum(epoch.data.field_error(u, c) ** 2, axis=1)
    beyond = error > limit_sigma**2 * (usual.mag_gauss**2 / epoch.data.count + known)
    return epoch.turned and float(np.mean(beyond)) > _MOST_ROWS
