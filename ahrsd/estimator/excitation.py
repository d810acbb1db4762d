"""Whether an epoch turned the sensor: one that did not says nothing about the iron.

A field that changes while the sensor rests (a lift, a magnet, drift) would be taken for a strange
calibration. So both sensors must have seen a rotation. How much of a steady rate is the gyro's bias
is not known well: where the field swept far, any turn that the gyro saw will do.
"""

from __future__ import annotations

import numpy as np

from ahrsd.estimator import chain
from ahrsd.samples import Array

_SWEPT = 0.10  # spread of the field over its size: a turn, if the gyro saw any
_SEEN = 0.3  # spread of the integrated rate, less the bias as known, over that: it saw any
_STIRRED = 0.004  # the same, if the gyro saw the turn
_TURNED_RAD = 0.002  # spread of the integrated rate less its mean
_SMOOTHED = 16  # steps


def spread(field: Array) -> float:
    """Standard deviation of (N, 3) along the direction in which it varied most."""
    away = field - field.mean(axis=0)
    return float(np.sqrt(np.linalg.eigvalsh(away.T @ away)[-1] / (len(field) - 1)))


def turned(data: chain.EpochData, bias_rad_s: Array) -> bool:
    """True where the epoch is worth a factor on the calibration; bias (3,) of the gyro as known."""
    count = len(data) // _SMOOTHED
    field = data.field_b_gauss[: count * _SMOOTHED].reshape(count, _SMOOTHED, 3).mean(axis=1)
    relative = spread(field) / float(np.median(np.linalg.norm(data.field_b_gauss, axis=1)))
    angle = data.angle_b_rad[1:]
    path = np.cumsum(angle - bias_rad_s * data.dt_s[1:, None], axis=0)
    if relative > _SWEPT and spread(path) > _SEEN * relative:
        return True
    unsteady = np.cumsum(angle - angle.mean(axis=0), axis=0)
    return relative > _STIRRED and spread(unsteady) > _TURNED_RAD
