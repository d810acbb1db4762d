"""Which epochs are worth linearising again, after the calibration moved away from where they were.

An epoch's factor is exact to second order, so a straight move costs nothing, however many sigmas
long. What counts is by how much the way there is curved (`retraction.py`), in sigmas: linearising
again moves the answer by about that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.epoch import Epoch
from ahrsd.estimator.graph import sigmas
from ahrsd.estimator.retraction import Moments, moved
from ahrsd.samples import Array

_WORTH = 0.02  # sigmas
_ANOTHER_NOISE, _EXACTLY = 0.1, 0.04  # of the gyro's level, that an epoch may have assumed else


def bends(epochs: Sequence[Epoch], c: Array, moments: Moments, information: Array) -> Array:
    """How curved the way is to c from where each was linearised, in sigmas (E,); 0 at rest."""
    known: dict[int, float] = {}
    for epoch in epochs:
        at = epoch.factor.point.c
        if epoch.turned and id(at) not in known:
            known[id(at)] = sigmas(moved(at, c - at, moments) - c, information)
    return np.array([known[id(e.factor.point.c)] if e.turned else 0.0 for e in epochs])


def outdated(
    epochs: Sequence[Epoch], bent: Array, usual: chain.Noise, *, exactly: bool
) -> list[int]:
    """Epochs that were left too far behind, or assumed another noise of the gyro than `usual`."""
    assumed = np.array([e.usual.gyro_rad_s for e in epochs])
    limit = _EXACTLY if exactly else _ANOTHER_NOISE
    other = np.abs(assumed / usual.gyro_rad_s - 1.0) > limit
    return [int(k) for k in np.flatnonzero((bent > _WORTH) | other)]
