"""The gyro moved in time against the magnetometer, exactly.

A magnetometer that is late by tau shows at t the field of t - tau.  Its columns are linear only for
a lag that is short against the motion, so a lag that has been found is taken out by giving each
magnetometer sample the rotation between t_(k-1) - tau and t_k - tau: the rates are constant within
their steps, so the attitude between samples is exact, and only the gyro's small noise is mixed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd import so3
from ahrsd.mismatch.track import Track
from ahrsd.samples import Array


def delayed_gyro(track: Track, tau_s: float) -> Track:
    """The track with the rates of tau_s earlier; beyond the ends of a run they stay as they are."""
    if tau_s == 0.0:
        return track
    gyro = track.gyro_b_rad_s.copy()
    for run in track.runs or (slice(0, len(track)),):
        if run.stop - run.start > 2:
            gyro[run] = _delayed_run(track.time_s[run], track.gyro_b_rad_s[run], tau_s)
    return replace(track, gyro_b_rad_s=gyro)


def _delayed_run(time_s: Array, rate: Array, tau_s: float) -> Array:
    step_s = np.diff(time_s)
    R = np.empty((len(time_s), 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(so3.exp(rate[1:] * step_s[:, None])):
        R[k + 1] = R[k] @ turn
    wanted = time_s - tau_s
    before = np.clip(np.searchsorted(time_s, wanted, side="right") - 1, 0, len(time_s) - 2)
    since = wanted - time_s[before]
    at = R[before] @ so3.exp(rate[before + 1] * since[:, None])
    moved = so3.log(np.swapaxes(at[:-1], 1, 2) @ at[1:]) / step_s[:, None]
    return np.vstack([moved[:1], moved])
