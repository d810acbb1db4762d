"""Which way is up, in the sensor frame, at every sample.

accelerometer: the specific force of the sample, as [R] 2.1; it leans with every acceleration.
gravity:       specific forces around the sample, turned into its frame by the gyro: their mean,
               weighted by exp(-|dt| / 10 s), before and after alike, so that a constant gyro bias
               cancels to first order.
device:        roll and pitch as the device says them.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.signal import lfilter

from ahrsd import so3
from ahrsd.evaluation.track import EvaluationError, EvaluationTrack
from ahrsd.samples import Array

Tilt = Literal["auto", "gravity", "accelerometer", "device"]
_MEMORY_S = 10.0


def up_b(track: EvaluationTrack, tilt: Tilt) -> tuple[Array, str]:
    """(N, 3) directions, of any length, and which were taken.

    auto: gravity, else the device's. Raises EvaluationError where the recording does not have it.
    """
    if tilt == "auto":
        tilt = "gravity" if track.has_accel else "device"
    if tilt == "device":
        return _of_device(track), tilt
    if not track.has_accel:
        raise EvaluationError(f"--tilt {tilt}: not every sample has an acceleration; try device")
    return (_gravity(track) if tilt == "gravity" else track.accel_b_m_s2), tilt


def _of_device(track: EvaluationTrack) -> Array:
    """Up is -z_n: its sensor components by pitch and roll (3-2-1)."""
    attitude = track.device_attitude()
    if attitude is None:
        raise EvaluationError(
            "nothing says which way is up: neither accel_{x,y,z}_m_s2 nor vn_{yaw,pitch,roll}_deg"
        )
    _, pitch, roll = attitude
    return np.column_stack(
        [np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)]
    )


def _gravity(track: EvaluationTrack) -> Array:
    out = np.empty((len(track), 3))
    for a, b in zip(track.starts, track.ends(), strict=True):
        dt_s = np.diff(track.time_s[a:b], prepend=track.time_s[a])
        R_0b = _turned(so3.exp(track.gyro_b_rad_s[a:b] * dt_s[:, None]))
        force_0 = np.einsum("kij,kj->ki", R_0b, track.accel_b_m_s2[a:b])
        step_s = float(np.median(dt_s[1:])) if b - a > 1 else 1.0
        out[a:b] = np.einsum("kji,kj->ki", R_0b, _both_ways(force_0, step_s / _MEMORY_S))
    return out


def _turned(steps: Array) -> Array:
    """R_0b (N, 3, 3) of the rotations over the steps that end at each sample."""
    R = np.empty_like(steps)
    R[0] = np.eye(3)
    for k in range(1, len(steps)):
        R[k] = R[k - 1] @ steps[k]
    return R


def _both_ways(values: Array, share: float) -> Array:
    """Exponential means (N, 3) from the past and from the future, added; each counts its own."""
    keep = np.exp(-share)
    weight = lfilter([1.0], [1.0, -keep], np.ones(len(values)))
    past = lfilter([1.0], [1.0, -keep], values, axis=0)
    future = lfilter([1.0], [1.0, -keep], values[::-1], axis=0)[::-1]
    return np.asarray((past + future - values) / (weight + weight[::-1] - 1.0)[:, None])
