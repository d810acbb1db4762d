"""[L]'s experiment: a recorded gyro stream moves the sensor, the field is simulated.

[L] (2.13), first order with normalisation:   q+ = q + (dt / 2) q (x) (0, w),   q = q+ / |q+|
reading:                                      B_k = A_k H + b + noise,  A_k = attitude of q_k
"""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array
from ahrsd.simulation.experiment import Experiment, measured
from ahrsd.simulation.scenarios import generator
from ahrsd.simulation.truth import Iron

LICHLYTER = Iron(soft_iron=np.eye(3), gyro_bias_rad_s=np.zeros(3), offset_behind_iron=True)


def integrate(rate_b_rad_s: Array, dt_s: Array) -> Array:
    """Quaternions (N, 4), scalar first, sensor to world, from rates (N, 3) and steps (N,).

    Row 0 is the identity and its rate is not used: a rate belongs to the step that ends at it.
    """
    q = np.empty((len(dt_s), 4))
    q[0] = (1.0, 0.0, 0.0, 0.0)
    half = rate_b_rad_s * dt_s[:, None] / 2
    for k in range(1, len(dt_s)):
        w, v = q[k - 1, 0], q[k - 1, 1:]
        q[k, 0] = w - v @ half[k]
        q[k, 1:] = v + w * half[k] + np.cross(v, half[k])
        q[k] /= np.linalg.norm(q[k])
    return q


def rotation(q: Array) -> Array:
    """R_nb (N, 3, 3) of unit quaternions (N, 4), scalar first."""
    w, v = q[:, :1, None], q[:, 1:]
    K = so3.skew(v)
    return np.asarray(np.eye(3) + 2 * w * K + 2 * K @ K)


def simulate_recorded(
    time_s: Array,
    gyro_b_rad_s: Array,
    *,
    iron: Iron = LICHLYTER,
    seed: int = 0,
    noise_mag_gauss: float = 1e-3,
    noise_gyro_rad_s: float = 0.0,
) -> Experiment:
    """An experiment on the motion of a recorded gyro stream without gaps: (N,) and (N, 3).

    [L] calls the recorded rates true. First-order integration turns by 2 atan(|w| dt / 2) and not
    by |w| dt, so the true rate is taken from the attitude it gives: both agree to the last digit.
    Raises ValueError where the time does not increase or a rate is not finite.
    """
    dt_s = np.concatenate([[np.nan], np.diff(time_s)])
    if not np.all(dt_s[1:] > 0):
        row = int(np.flatnonzero(~(dt_s[1:] > 0))[0]) + 1
        raise ValueError(f"time_s of row {row} does not increase: {time_s[row]}")
    if not np.isfinite(gyro_b_rad_s).all():
        row = int(np.argmin(np.isfinite(gyro_b_rad_s).all(axis=1)))
        raise ValueError(f"gyro_b_rad_s of row {row} is not finite: {gyro_b_rad_s[row]}")
    R_nb = rotation(integrate(gyro_b_rad_s, dt_s))
    turned = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:])
    rate = np.vstack([np.full((1, 3), np.nan), turned / dt_s[1:, None]])
    return measured(
        f"recorded gyro stream, seed {seed}",
        iron,
        R_nb,
        rate,
        np.asarray(time_s, dtype=np.float64),
        (noise_mag_gauss, noise_gyro_rad_s),
        (generator(seed, 1), generator(seed, 2)),
    )
