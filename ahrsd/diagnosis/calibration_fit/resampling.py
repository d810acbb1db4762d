"""A track at a lower rate: averaged for a search, or decimated for a quick descent.

`average_groups` keeps nearly all of the information.  Every m samples become one: the readings are
turned to the middle sample by the gyro and averaged there, and the gyro's turns from middle to
middle are multiplied.  The noise stays white as long as the gyro's noise turns a group by little
compared with the magnetometer's noise: the same gyro noise is in the averaged reading and in the
turns on both sides of it.  Turning needs a calibration, h = C (m - b), turned, m = A h + b; an
approximate one is enough, since a group turns by a few degrees only.

The middle of an even number is the later of two.  Other logged columns are averaged over the group,
like their effect on the readings.  Attitude information is averaged about the middle sample, with
half a sample at either end.

`decimate` composes rotations exactly.  Each row stands for a group of consecutive samples: the last
reading of the magnetometer, and the rate whose rotation over the whole group equals the product of
the samples' rotations.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import NothingToFit, Track
from ahrsd.samples import Array

#: rows per second of a search; the least rate, used if a group of samples turns by less than
#: GROUP_TURN_RAD, root mean square
WORKING_HZ, SLOWEST_HZ, GROUP_TURN_RAD = 12.0, 8.0, 0.15
#: largest `gyro_noise_ratio` of m samples; neighbours then share some three hundredths of the
#: variance of an innovation
MOST_GYRO_NOISE_RATIO = 0.5
_DECIMATED_ROWS = 3000
#: per row, root mean square: beyond it, a bias no longer adds to the mean rate
_LARGEST_TURN_RAD = 0.3


def thin_factor(track: Track, wanted_hz: float) -> int:
    """The largest m that leaves at least `wanted_hz`, 1 if that allows no averaging."""
    steps = track.dt_s[np.isfinite(track.dt_s)]
    rate_hz = 1.0 / float(np.median(steps)) if len(steps) else wanted_hz
    return max(1, int(rate_hz / wanted_hz))


def working_factor(track: Track, model: NullModel) -> int:
    """Samples per working row.

    The largest number that leaves SLOWEST_HZ and for which a group turns little, or else the one
    that leaves WORKING_HZ; fewer if the noise would not stay white.
    model: the noise of a sample
    """
    least, most = (thin_factor(track, hz) for hz in (WORKING_HZ, SLOWEST_HZ))
    step = np.linalg.norm(track.gyro_b_rad_s, axis=1) * np.nan_to_num(track.dt_s)
    turn_rad = float(np.sqrt(np.mean(step**2)))
    found = next((m for m in range(most, least, -1) if m * turn_rad < GROUP_TURN_RAD), least)
    white = MOST_GYRO_NOISE_RATIO / max(
        gyro_noise_ratio(track, model), MOST_GYRO_NOISE_RATIO / found
    )
    return max(1, int(white + 1e-9))


def gyro_noise_ratio(track: Track, model: NullModel) -> float:
    """Field by which the gyro's noise turns a reading in one step, over the reading's noise."""
    turned_gauss = model.sigma_gyro_rad_s * track.step_s * track.usual_gauss
    return turned_gauss / model.sigma_mag_gauss


def average_groups(track: Track, m: int, model: NullModel, riding: Array | None = None) -> Track:
    """The track with every m samples averaged; runs shorter than 2 m samples are left out.

    riding: (N, 3) gauss fixed in the sensor's axes, in addition to the hard iron: averaged, not
            turned.  0.3 gauss of a motor turned by a hundredth of a radian are three noise levels.
    ValueError if m is not positive.
    """
    if m < 1:
        raise ValueError(f"cannot keep one sample in {m}")
    if m == 1:
        return track
    if riding is not None:
        return _average_with_riding(track, m, model, riding)
    runs = [run for run in track.runs if run.stop - run.start >= 2 * m]
    if not runs:
        raise NothingToFit(f"no run of {2 * m} samples without a gap: too little for a fit")
    parts = [_average_run(track, run, m, model) for run in runs]
    lengths = [len(part["time_s"]) for part in parts]
    ends = np.cumsum(lengths).tolist()
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    accel = joined.pop("accel") if track.accel_b_m_s2 is not None else None
    unseen = joined.pop("unseen") if track.lost_turns is not None else None
    fields = {name: joined.pop(name) for name in ("time_s", "dt_s", "mag", "gyro")}
    return Track(
        fields["time_s"],
        fields["dt_s"],
        fields["mag"],
        fields["gyro"],
        accel,
        joined,
        tuple(slice(end - size, end) for end, size in zip(ends, lengths, strict=True)),
        unseen,
        track.step_share / m,
    )


def _average_with_riding(track: Track, m: int, model: NullModel, riding: Array) -> Track:
    """The same, with `riding` removed before the turn and its means added afterwards."""
    names = [f"riding {axis}" for axis in "xyz"]
    known = {**track.covariates, **dict(zip(names, riding.T, strict=True))}
    averaged = average_groups(
        replace(track, mag_b_gauss=track.mag_b_gauss - riding, covariates=known), m, model
    )
    means = np.column_stack([averaged.covariates[name] for name in names])
    covariates = {name: values for name, values in averaged.covariates.items() if name not in names}
    return replace(averaged, mag_b_gauss=averaged.mag_b_gauss + means, covariates=covariates)


def _average_run(track: Track, run: slice, m: int, model: NullModel) -> dict[str, Array]:
    """The columns of one averaged run."""
    groups = (run.stop - run.start) // m
    rows = slice(run.start, run.start + groups * m)
    half = m // 2
    step = track.dt_s[rows]
    increments = so3.exp(track.gyro_b_rad_s[rows] * np.nan_to_num(step)[:, None])
    carried = _turn_to_middle(track, rows, m, model)
    shifted = np.arange(groups - 1)[:, None] * m + half + 1 + np.arange(m)
    product = increments[shifted[:, 0]]
    for k in range(1, m):
        product = product @ increments[shifted[:, k]]
    dt = step[shifted].sum(axis=1)
    gyro = np.empty((groups, 3))
    gyro[1:] = so3.log(product) / dt[:, None]
    gyro[0] = gyro[1]
    out = {
        "time_s": track.time_s[rows][half::m],
        "dt_s": np.concatenate([[np.nan], dt]),
        "mag": _mean_of_readings(carried.reshape(groups, m, 3)),
        "gyro": gyro,
    }
    if track.accel_b_m_s2 is not None:
        out["accel"] = _means_about_middle(track.accel_b_m_s2[rows], m)
    if track.lost_turns is not None:
        out["unseen"] = np.concatenate([[0.0], track.lost_turns[rows][shifted].sum(axis=1)])
    for name, values in track.covariates.items():
        out[name] = values[rows].reshape(-1, m).mean(1)
    return out


def _means_about_middle(values: Array, m: int) -> Array:
    """Means of (n m, ...) about the middle sample of each m; for even m the last is one-sided."""
    groups = values.reshape(-1, m, *values.shape[1:])
    mean = groups.mean(axis=1)
    if m % 2 == 0:
        mean[:-1] += (groups[1:, 0] - groups[:-1, 0]) / (2 * m)
        mean[-1] = groups[-1, 1:].mean(axis=0)
    return np.asarray(mean)


def _mean_of_readings(values: Array) -> Array:
    """(n, 3) mean over the rows (n, m, 3) that are readings; nan if there are none."""
    known = np.asarray(np.isfinite(values).all(axis=2))
    count = known.sum(axis=1)
    total = np.where(known[:, :, None], values, 0.0).sum(axis=1)
    return np.asarray(
        np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], np.nan), float
    )


def _turn_to_middle(track: Track, rows: slice, m: int, model: NullModel) -> Array:
    """Readings (n m, 3) turned to the middle of their group."""
    rate = track.gyro_b_rad_s[rows] - model.gyro_bias_rad_s
    back = so3.exp(-rate * np.nan_to_num(track.dt_s[rows])[:, None]).reshape(-1, m, 3, 3)
    field = (track.mag_b_gauss[rows] - model.hard_iron_gauss) @ np.linalg.inv(model.soft_iron)
    h = field.reshape(-1, m, 3).copy()
    half = m // 2
    ahead = behind = np.broadcast_to(np.eye(3), (len(h), 3, 3))
    for k in range(1, m - half):
        behind = behind @ np.swapaxes(back[:, half + k], 1, 2)
        h[:, half + k] = np.einsum("nij,nj->ni", behind, h[:, half + k])
    for k in range(1, half + 1):
        ahead = ahead @ back[:, half - k + 1]
        h[:, half - k] = np.einsum("nij,nj->ni", ahead, h[:, half - k])
    return np.asarray(h.reshape(-1, 3) @ model.soft_iron + model.hard_iron_gauss)


def decimation_factor(track: Track) -> int:
    """Samples per row: at most about 3000 rows, and no row that turns too far."""
    step = np.linalg.norm(track.gyro_b_rad_s, axis=1) * np.nan_to_num(track.dt_s, nan=0.0)
    turn = float(np.sqrt(np.mean(step**2)))
    return max(1, min(len(track) // _DECIMATED_ROWS, int(_LARGEST_TURN_RAD / max(turn, 1e-9))))


def decimate(track: Track, size: int) -> Track:
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
    """Last and first sample of each group, and which groups are the first of their run.

    A group ends at the last sample that has a reading; later samples belong to the next group.
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
