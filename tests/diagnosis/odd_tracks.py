"""Tracks of a sensor at rest, and of one that is turned and shaken by hand."""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis.track import Track

#: of a track at rest
COUNT, RATE_HZ = 6000, 10.0
#: of a shaken track
SIGMA_MAG, SIGMA_GYRO = 6e-4, 1e-3


def standing(bias: np.ndarray, warmth: np.ndarray | None = None, seed: int = 4) -> Track:
    """At rest for as many rows as bias (N, 3) rad/s has."""
    rng = np.random.default_rng(seed)
    count = len(bias)
    time_s = np.arange(count) / RATE_HZ
    dt_s = np.full(count, 1 / RATE_HZ)
    dt_s[0] = np.nan
    mag = np.array([0.2, 0.05, 0.4]) + rng.normal(0.0, 1e-3, (count, 3))
    gyro = bias + rng.normal(0.0, 1.5e-4, (count, 3))
    accel = np.array([0.0, 0.0, -9.81]) + rng.normal(0.0, 0.01, (count, 3))
    covariates = {} if warmth is None else {"temperature_c": warmth}
    return Track(time_s, dt_s, mag, gyro, accel, covariates, (slice(0, count),))


def warming(count: int = COUNT) -> np.ndarray:
    """Degrees Celsius; ten minutes by default."""
    passed = np.arange(count) / RATE_HZ
    return 8.0 + 7.0 * (1 - np.exp(-passed / 200.0)) + 1.5 * np.sin(passed / 60.0)


def shaking(seed: int, *, jitter_rad_s: float = 0.05) -> Track:
    """Five minutes of turning by hand, with tremor in three of four intervals of six seconds."""
    rng = np.random.default_rng(seed)
    count, rate_hz = 12_000, 40.0
    time_s = np.arange(count) / rate_hz
    slow = np.cumsum(rng.normal(size=(count // 40 + 2, 3)), axis=0)
    slow = 0.5 * (slow - slow.mean(axis=0)) / slow.std(axis=0)
    knots = np.arange(len(slow)) * 40 / rate_hz
    rate = np.column_stack([np.interp(time_s, knots, one) for one in slow.T])
    on = np.repeat(rng.random(count // 240) < 0.75, 240)
    rate += jitter_rad_s * on[:, None] * rng.normal(size=(count, 3))
    return measured(rate, rate_hz, rng)


def wobbling(sigma_gyro: float) -> Track:
    """Five minutes of slow turns that wobble by 0.2 rad/s, a little less than once a second."""
    rng, rate_hz = np.random.default_rng(5), 40.0
    time_s = np.arange(12_000) / rate_hz
    phase = 2 * np.pi * np.outer(time_s, [0.73, 0.81, 0.9])
    rate = 0.2 * np.sin(phase) + 0.1 * np.sin(phase / 19.0)
    return measured(rate, rate_hz, rng, sigma_gyro=sigma_gyro)


def measured(
    rate: np.ndarray, rate_hz: float, rng: np.random.Generator, sigma_gyro: float = SIGMA_GYRO
) -> Track:
    """Readings of a sensor that turns by rate (N, 3) rad/s."""
    count = len(rate)
    time_s = np.arange(count) / rate_hz
    turn = so3.exp(rate / rate_hz)
    field_b = np.empty((count, 3))
    R_nb = np.eye(3)
    for k in range(count):
        R_nb = R_nb @ turn[k]
        field_b[k] = R_nb.T @ [0.2, 0.05, 0.45]
    A = np.array([[1.03, 0.02, -0.01], [0.02, 0.96, 0.01], [-0.01, 0.01, 1.01]])
    mag = field_b @ A + [0.05, -0.08, 0.03] + SIGMA_MAG * rng.normal(size=(count, 3))
    gyro = rate + [2e-3, -1e-3, 1.5e-3] + sigma_gyro * rng.normal(size=(count, 3))
    dt_s = np.r_[np.nan, np.diff(time_s)]
    return Track(time_s, dt_s, mag, gyro, None, {}, (slice(0, count),))


def without_rows(track: Track, keep: np.ndarray, *, restamp: bool) -> Track:
    """The track without some rows; restamped, the time stamps do not show it."""
    time_s = track.time_s[: len(keep)] if restamp else track.time_s[keep]
    assert track.accel_b_m_s2 is not None
    return Track(
        time_s,
        np.diff(time_s, prepend=np.nan),
        track.mag_b_gauss[keep],
        track.gyro_b_rad_s[keep],
        track.accel_b_m_s2[keep],
        {},
        (slice(0, len(keep)),),
    )
