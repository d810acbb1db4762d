"""A track thinned for a quick descent, its rotations composed exactly.

Each row stands for a group of consecutive samples: the last reading of the magnetometer, and the
rate whose rotation over the whole group equals the product of the samples' own.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.mismatch.track import Track
from ahrsd.samples import Array

_ROWS = 3000
_LARGEST_TURN_RAD = 0.3  # per row, root mean square: beyond, a bias no longer adds to the mean rate


def group_size(track: Track) -> int:
    """Samples per row: at most about 3000 rows, and no row that turns too far."""
    step = np.linalg.norm(track.gyro_b_rad_s, axis=1) * np.nan_to_num(track.dt_s, nan=0.0)
    turn = float(np.sqrt(np.mean(step**2)))
    return max(1, min(len(track) // _ROWS, int(_LARGEST_TURN_RAD / max(turn, 1e-9))))


def thinned(track: Track, size: int) -> Track:
    """Groups of `size` samples; the remainder of each run is left out.  Covariates are dropped."""
    if size <= 1:
        return track
    last, begins = _groups(track, size)
    if not begins:
        return track
    steps = last[:, None] - np.arange(size - 1, -1, -1)
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    angle = track.gyro_b_rad_s * dt[:, None]
    total = so3.exp(angle[steps[:, 0]])
    for column in range(1, size):
        total = total @ so3.exp(angle[steps[:, column]])
    length = dt[steps].sum(axis=1)
    rate = so3.log(total) / np.maximum(length, 1e-12)[:, None]
    length[begins] = np.nan
    runs = tuple(slice(a, b) for a, b in pairwise([*begins, len(last)]))
    accel = None if track.accel_b_m_s2 is None else track.accel_b_m_s2[last]
    return Track(track.time_s[last], length, track.mag_b_gauss[last], rate, accel, {}, runs)


def _groups(track: Track, size: int) -> tuple[NDArray[np.intp], list[int]]:
    """Last sample of each group, and which group is its run's first."""
    last: list[int] = []
    begins: list[int] = []
    for run in track.runs or (slice(0, len(track)),):
        mine = range(run.start + size - 1, run.stop, size)
        if len(mine) > 1:
            begins.append(len(last))
            last.extend(mine)
    return np.array(last, dtype=np.intp), begins


def noise_of(track: Track) -> tuple[float, float]:
    """White noise of one reading, (gauss, rad/s): third differences, per second, the middle one.

    Third differences of white noise have 20 times its variance and take out what is smooth over
    four samples; what motion is left makes both values too large, never too small.
    """
    return _from_differences(track, track.mag_b_gauss), _from_differences(track, track.gyro_b_rad_s)


def _from_differences(track: Track, values: Array) -> float:
    found: list[Array] = []
    known = track.dt_s[np.isfinite(track.dt_s)]
    block = max(8, round(1.0 / float(np.median(known)))) if len(known) else 8
    for run in track.runs or (slice(0, len(track)),):
        third = np.diff(values[run], 3, axis=0)
        third = third[np.isfinite(third).all(axis=1)]
        whole = len(third) // block * block
        if whole:
            square = np.mean(np.square(third[:whole]).reshape(-1, block, 3), axis=1)
            found.append(square / 20.0)
    if not found:
        return 0.0
    return float(np.sqrt(np.mean(np.median(np.concatenate(found), axis=0))))
