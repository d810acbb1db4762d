"""A track thinned for a quick descent, its rotations composed exactly.

Each row stands for a group of consecutive samples: the last reading of the magnetometer, and the
rate whose rotation over the whole group equals the product of the samples' own.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.diagnosis.track import Track
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
    last, first, begins = _groups(track, size)
    if not begins:
        return track
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    angle = track.gyro_b_rad_s * dt[:, None]
    total = so3.exp(angle[first])
    for step in range(1, int(np.max(last - first)) + 1):
        at = np.minimum(first + step, last)
        total = total @ so3.exp(np.where((first + step <= last)[:, None], angle[at], 0.0))
    clock = np.concatenate([[0.0], np.cumsum(dt)])
    length = clock[last + 1] - clock[first]
    rate = so3.log(total) / np.maximum(length, 1e-12)[:, None]
    length[begins] = np.nan
    runs = tuple(slice(a, b) for a, b in pairwise([*begins, len(last)]))
    accel = None if track.accel_b_m_s2 is None else track.accel_b_m_s2[last]
    return Track(track.time_s[last], length, track.mag_b_gauss[last], rate, accel, {}, runs)


def _groups(track: Track, size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], list[int]]:
    """Last and first sample of each group, and which group is its run's first.

    A group ends at the last sample that has a reading; what is behind it goes to the next.
    """
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    latest = np.maximum.accumulate(np.where(seen, np.arange(len(track)), -1))
    last: list[int] = []
    first: list[int] = []
    begins: list[int] = []
    for run in track.runs or (slice(0, len(track)),):
        ends = np.unique(latest[run.start + size - 1 : run.stop : size])
        ends = ends[ends >= run.start]
        if len(ends) > 1:
            begins.append(len(last))
            first.extend([run.start, *(ends[:-1] + 1).tolist()])
            last.extend(ends.tolist())
    return np.array(last, dtype=np.intp), np.array(first, dtype=np.intp), begins


def noise_of(track: Track) -> tuple[float, float]:
    """White noise of one reading, (gauss, rad/s), from third differences.

    Of the middle second and the middle axis: a jolt is short, a propeller shakes one axis.
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
    return float(np.sqrt(np.median(np.median(np.concatenate(found), axis=0))))
