"""Residuals that real recordings have, as columns that follow attitude, rate or time.

Neither sensor is exactly linear, and the field of a room varies with place and time. `diagnose` has
these functions in its model of a recording (the ordinary remainder), and the estimator tests the
residuals of its epochs for them (`model_checks`). These are pure functions of directions, rates and
times. Their sizes were measured on untouched real recordings.
"""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array

#: (5, 3, 3) symmetric matrices of trace zero, the changes of soft iron that keep its trace:
#: xx - zz, yy - zz, xy, xz, yz
TRACELESS = np.zeros((5, 3, 3))
TRACELESS[0, [0, 2], [0, 2]] = TRACELESS[1, [1, 2], [1, 2]] = 1.0, -1.0
for _at, (_i, _j) in enumerate(((0, 1), (0, 2), (1, 2)), start=2):
    TRACELESS[_at, _i, _j] = TRACELESS[_at, _j, _i] = 1.0
TRACELESS.flags.writeable = False

#: Standard deviation of the coefficients of functions of unit size: medians over untouched real
#: recordings, measured by `python tests/benchmarks/diagnosis/bench_remainder_priors.py`. How much
#: recordings differ from the median is in `ahrsd/diagnosis/priors.py: ORDINARY`.
#: BY_DIRECTION: field by its direction in the sensor (`harmonics`), gauss.
#: FIELD_BY_RATE: field by the turn rate, gauss at 1 rad/s.
#: BY_RATE_SQUARED: gyro error by products of the rates, rad/s at 1 rad/s.
#: BY_CHANGE: field by its rate of change (`change_columns`), a difference of delays, s.
#: COURSE: field by time, gauss; the standard deviation over the recording.
BY_DIRECTION, FIELD_BY_RATE, BY_RATE_SQUARED, BY_CHANGE = 2.90e-3, 7.4e-4, 1.42e-3, 1.23e-3
COURSE = 7.75e-3


def harmonics(field_b: Array) -> Array:
    """(N, 12) harmonics of degree 2 and 3 of a direction, of mean square 1 on the sphere."""
    x, y, z = (field_b / np.maximum(np.linalg.norm(field_b, axis=1, keepdims=True), 1e-300)).T
    second = [x * y, y * z, z * x, (x**2 - y**2) / 2, (3 * z**2 - 1) / (2 * np.sqrt(3))]
    third = [
        x * y * z * 2,
        z * (x**2 - y**2),
        x * (5 * z**2 - 1) / np.sqrt(10),
        y * (5 * z**2 - 1) / np.sqrt(10),
        z * (5 * z**2 - 3) / np.sqrt(15),
        x * (x**2 - 3 * y**2) / np.sqrt(6),
        y * (3 * x**2 - y**2) / np.sqrt(6),
    ]
    return np.column_stack(
        [np.sqrt(15.0) * np.array(second).T, np.sqrt(105.0 / 4) * np.array(third).T]
    )


def rate_products(rate: Array) -> Array:
    """(N, 6) products of the rates. Their mean is not subtracted: it is a gyro bias, which is part
    of the calibration.
    """
    x, y, z = rate.T
    return np.column_stack([x * x, y * y, z * z, x * y, y * z, z * x])


def change_columns(change_b: Array) -> Array:
    """(N, 3, 8) columns of a matrix applied to the field's rate of change (N, 3), without the
    multiple of the identity, which is a delay of all axes.
    """
    matrix = np.concatenate([TRACELESS, so3.skew(np.eye(3))])
    return np.asarray(np.einsum("aij,nj->nia", matrix, change_b))


def on_each_axis(functions: Array) -> Array:
    """(N, 3, 3 k) columns: each of the functions (N, k) acting along each axis of the sensor."""
    flat = np.einsum("nk,ia->nika", functions, np.eye(3))
    return np.asarray(flat.reshape(len(functions), 3, -1))


def cosine_modes(time_s: Array, modes: int) -> Array:
    """(N, modes) cosines with 1, 2, ... half waves over the times, of mean square 1."""
    since = (time_s - time_s.min()) / max(float(np.ptp(time_s)), 1e-9)
    return np.asarray(np.sqrt(2.0) * np.cos(np.pi * since[:, None] * np.arange(1, modes + 1)))
