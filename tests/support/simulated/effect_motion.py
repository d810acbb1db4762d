"""A made-up recording with every covariate, as truth and as the context of a perfect fit."""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.model import Context, NullModel
from ahrsd.diagnosis.track import Track

SOFT_IRON = np.array([[1.05, 0.08, 0.03], [0.08, 0.9, 0.02], [0.03, 0.02, 1.05]])
HARD_IRON = np.array([0.03, -0.12, 0.09])
GYRO_BIAS = np.array([4e-3, -5e-3, 2e-3])
FIELD_N = np.array([0.23, 0.05, 0.41])


def track_time(rows: int, rate_hz: float, gap_at: int | None) -> tuple[np.ndarray, np.ndarray]:
    time_s = 5.0 + np.arange(1, rows + 1) / rate_hz
    dt_s = np.full(rows, 1.0 / rate_hz)
    dt_s[0] = np.nan
    if gap_at is not None:
        time_s[gap_at:] += 3.0
        dt_s[gap_at] = np.nan
    return time_s, dt_s


def moving(seed: int = 0, rows: int = 600, rate_hz: float = 20.0, gap_at: int | None = None):
    """Context and readings (noise-free) that agree exactly: h_k = Exp(-w_k dt) h_(k-1)."""
    rng = np.random.default_rng(seed)
    time_s, dt_s = track_time(rows, rate_hz, gap_at)
    phase, pace = rng.uniform(0, 6, (3, 3)), rng.uniform(0.2, 1.5, (3, 3))
    rate = 0.3 * sum(np.sin(pace[k] * time_s[:, None] + phase[k]) for k in range(3))
    R_nb = np.empty((rows, 3, 3))
    R_nb[0] = so3.exp(rng.uniform(-1, 1, 3))
    for k in range(1, rows):
        R_nb[k] = R_nb[k - 1] @ so3.exp(rate[k] / rate_hz)
    field_b = np.einsum("nji,j->ni", R_nb, FIELD_N)
    accel = R_nb[:, 2, :] * -9.80665 + 0.3 * np.sin(17 * time_s)[:, None]
    covariates = everything(rng, time_s)
    mag = field_b @ SOFT_IRON.T + HARD_IRON
    readings = Readings(
        time_s, dt_s, mag, rate + GYRO_BIAS, accel, rate, field_b, R_nb, SOFT_IRON, covariates
    )
    runs = (slice(0, rows),) if gap_at is None else (slice(0, gap_at), slice(gap_at, rows))
    track = Track(time_s, dt_s, mag, rate + GYRO_BIAS, accel, covariates, runs)
    model = NullModel(SOFT_IRON, HARD_IRON, GYRO_BIAS, 1e-3, 5e-4)
    zero = np.zeros((rows, 3))
    context = Context(track, model, field_b, field_b, rate, zero, R_nb, True)
    return context, readings


def everything(rng: np.random.Generator, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """A column of every role."""
    t = time_s - time_s[0]
    return {
        "motor_current_a": 5 + 4 * np.sin(0.4 * t + rng.uniform(0, 6)),
        "temperature_c": 22 + 8 * (1 - np.exp(-t / 30.0)),
        "rudder_angle_rad": 0.5 * np.sin(0.7 * t),
        "position_north_m": 0.5 * t,
        "position_east_m": 5 * np.sin(0.2 * t),
        "position_down_m": 2 + np.cos(0.1 * t),
        "altitude_m": 6 + 2 * np.cos(0.13 * t),
        "speed_m_s": 1 + 0.5 * np.sin(0.3 * t),
        "motor_rpm": 900 + 50 * np.sin(0.21 * t),
        "ping": (np.arange(len(t)) % 37 < 2).astype(float),
        "lamp_on": (np.sin(0.5 * t) > 0).astype(float),
        "throttle": 0.5 + 0.1 * np.sin(0.4 * t),
        "battery_v": 12 - 0.01 * t,
        "pressure_kpa": 101 + 0.1 * np.sin(0.2 * t),
        "latitude_deg": np.full(len(t), 48.0),
    }
