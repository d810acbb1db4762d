"""Gyro bias as the mean at rest: the plainest second opinion there is.

What is contiguous is cut in bins of one second, whatever segments it lies in. At rest the force is
steady, the rate is small and steady, and the field stays where it is (a slow steady turn has the
first two). No bias is assumed. Runs of three such bins and more count, between two more. The
scatter of the bins gives the sigma of the mean; the Earth's rotation (0.07 mrad/s) and a bias that
wanders are a floor under it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.evidence.segments import Segment
from ahrsd.samples import Array

STILL_GYRO_RAD_S = 0.01
STILL_ACCEL_M_S2 = 0.05
STILL_BINS = 3
MOST_BIAS_RAD_S = 0.0625  # 3 deg/s of bias and what counts as still
_LONGEST_BINS = 30
_TURN_GAUSS = 0.003  # between the halves of a run: more is a slow turn
_FLOOR_RAD_S = 1e-4
_JOINED_ROWS = 2.5  # of averaged rows: a shorter hole is the row that a cut left incomplete
_NEWEST_S = 900.0  # rest that is older says nothing about the bias of today


@dataclass(frozen=True, slots=True, eq=False)
class Seconds:
    """One-second bins of a stretch: time_s (k,), rate (k, 3), force_std (k,), field (k, 3)."""

    time_s: Array
    rate_b_rad_s: Array
    force_std_m_s2: Array
    field_b_gauss: Array


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Mean rate at rest (3,) with the sigma of that mean; nan and 0 s where there was no rest."""

    rate_b_rad_s: Array
    sigma_rad_s: float
    duration_s: float


def seconds(stretch: Sequence[Segment]) -> Seconds:
    """Cut segments that follow each other in one-second bins; an incomplete last one is left out.

    The angle into a segment's first row is not known: the rate of its next row stands for it.
    """
    time_s = np.concatenate([segment.time_s for segment in stretch])
    dt_s = np.diff(time_s)
    size = max(1, round(1.0 / float(np.median(dt_s))))
    rate = np.concatenate([segment.angle_b_rad for segment in stretch])[1:] / dt_s[:, None]
    firsts = np.cumsum([len(segment) for segment in stretch])[:-1] - 1
    rate[firsts] = rate[np.minimum(firsts + 1, len(rate) - 1)]
    whole = len(rate) // size * size
    rows = slice(1, whole + 1)
    force = np.concatenate([segment.accel_b_m_s2 for segment in stretch])[rows]
    field = np.concatenate([segment.raw_b_gauss for segment in stretch])[rows]
    return Seconds(
        time_s=time_s[rows].reshape(-1, size).mean(axis=1),
        rate_b_rad_s=rate[:whole].reshape(-1, size, 3).mean(axis=1),
        force_std_m_s2=np.linalg.norm(force.reshape(-1, size, 3).std(axis=1), axis=1),
        field_b_gauss=field.reshape(-1, size, 3).mean(axis=1),
    )


def stretches(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Segments of the newest quarter of an hour, those together that follow each other.

    Nothing from before the device's clock began anew is among them.
    """
    found: list[list[Segment]] = []
    for segment in reversed(segments):
        if found and segment.time_s[-1] > found[-1][0].time_s[0]:
            break
        if segment.time_s[-1] < segments[-1].time_s[-1] - _NEWEST_S:
            break
        if found and _follows(segment, found[-1][0]):
            found[-1].insert(0, segment)
        else:
            found.append([segment])
    return found[::-1]


def _follows(before: Segment, after: Segment) -> bool:
    """Whether nothing but an incomplete row is missing between them."""
    usual_s = float(np.median(np.diff(before.time_s)))
    same = before.averaged == after.averaged
    return same and float(after.time_s[0] - before.time_s[-1]) < _JOINED_ROWS * usual_s


def rest(segments: Sequence[Segment]) -> Rest:
    """Mean rate over the rest within the newest quarter of an hour."""
    bins = [seconds(stretch) for stretch in stretches(segments)]
    newest_s = max((float(b.time_s[-1]) for b in bins if len(b.time_s)), default=0.0)
    runs = [
        b.rate_b_rad_s[i:j]
        for b in bins
        for i, j in _still_runs(b)
        if newest_s - _NEWEST_S <= b.time_s[i] <= newest_s
    ]
    if not runs:
        return Rest(np.full(3, np.nan), float("nan"), 0.0)
    rates = np.concatenate(runs)
    scatter = np.concatenate([run - run.mean(axis=0) for run in runs])
    freedom = max(1, len(rates) - len(runs))
    sigma = np.sqrt(np.max(np.sum(scatter**2, axis=0)) / freedom / len(rates))
    return Rest(rates.mean(axis=0), float(np.hypot(sigma, _FLOOR_RAD_S)), float(len(rates)))


def _still_runs(bins: Seconds) -> list[tuple[int, int]]:
    """Bins at rest, in pieces of at most half a minute: a field that drifts slowly is no turn.

    What is usual is that of each piece by itself: elsewhere the vehicle may turn, as steadily.
    """
    still = bins.force_std_m_s2 < STILL_ACCEL_M_S2
    still &= np.linalg.norm(bins.rate_b_rad_s, axis=1) < MOST_BIAS_RAD_S
    found: list[tuple[int, int]] = []
    for first, last in _runs(still):
        rate = bins.rate_b_rad_s[first:last]
        near = np.linalg.norm(rate - np.median(rate, axis=0), axis=1) < STILL_GYRO_RAD_S
        for i, j in _runs(near):
            inner = np.arange(first + i + 1, first + j - 1)  # the ends may have moved
            pieces = np.array_split(inner, max(1, -(-len(inner) // _LONGEST_BINS)))
            found += [(int(p[0]), int(p[-1]) + 1) for p in pieces if len(p) >= STILL_BINS]
    return [(i, j) for i, j in found if _drift_gauss(bins.field_b_gauss[i:j]) < _TURN_GAUSS]


def _runs(true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(int)))
    return [(int(i), int(j)) for i, j in edges.reshape(-1, 2)]


def _drift_gauss(field: Array) -> float:
    """Second half against first: noise averages out, a steady turn does not."""
    middle = len(field) // 2
    return float(np.linalg.norm(field[middle:].mean(axis=0) - field[:middle].mean(axis=0)))
