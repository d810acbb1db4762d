"""Gyro bias as the mean at rest: the plainest second opinion there is.

A segment is cut in bins of one second. At rest the force is steady, the rate is small and steady,
and the field stays where it is (a slow steady turn has the first two). No bias is assumed. Runs
of three such bins and more count, between two more. The scatter of the bins gives the sigma of the
mean; the Earth's rotation (0.07 mrad/s) and a bias that wanders are a floor under it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.evidence.history import Segment
from ahrsd.samples import Array

STILL_GYRO_RAD_S = 0.01
STILL_ACCEL_M_S2 = 0.05
STILL_BINS = 3
MOST_BIAS_RAD_S = 0.0625  # 3 deg/s of bias and what counts as still
_TURN_GAUSS = 0.003  # between the halves of a run: more is a slow turn
_FLOOR_RAD_S = 1e-4
_NEWEST_S = 900.0  # rest that is older says nothing about the bias of today


@dataclass(frozen=True, slots=True, eq=False)
class Seconds:
    """One-second bins of a segment: time_s (k,), rate (k, 3), force_std (k,), field (k, 3)."""

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


def seconds(segment: Segment) -> Seconds:
    """Cut a segment in one-second bins; an incomplete last bin is left out."""
    dt_s = np.diff(segment.time_s)
    size = max(1, round(1.0 / float(np.median(dt_s))))
    rate = segment.angle_b_rad[1:] / dt_s[:, None]
    whole = len(rate) // size * size
    force = segment.accel_b_m_s2[1 : whole + 1].reshape(-1, size, 3)
    return Seconds(
        time_s=segment.time_s[1 : whole + 1].reshape(-1, size).mean(axis=1),
        rate_b_rad_s=rate[:whole].reshape(-1, size, 3).mean(axis=1),
        force_std_m_s2=np.linalg.norm(force.std(axis=1), axis=1),
        field_b_gauss=segment.raw_b_gauss[1 : whole + 1].reshape(-1, size, 3).mean(axis=1),
    )


def rest(bins: Sequence[Seconds]) -> Rest:
    """Mean rate over the rest within the newest quarter of an hour."""
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
    still = bins.force_std_m_s2 < STILL_ACCEL_M_S2
    if not still.any():
        return []
    rate = bins.rate_b_rad_s
    usual = np.median(rate[still], axis=0)
    still &= np.linalg.norm(rate - usual, axis=1) < STILL_GYRO_RAD_S
    still &= np.linalg.norm(rate, axis=1) < MOST_BIAS_RAD_S
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    inner = [(int(i) + 1, int(j) - 1) for i, j in edges.reshape(-1, 2)]  # the ends may have moved
    runs = [(i, j) for i, j in inner if j - i >= STILL_BINS]
    return [(i, j) for i, j in runs if _drift_gauss(bins.field_b_gauss[i:j]) < _TURN_GAUSS]


def _drift_gauss(field: Array) -> float:
    """Second half against first: noise averages out, a steady turn does not."""
    middle = len(field) // 2
    return float(np.linalg.norm(field[middle:].mean(axis=0) - field[:middle].mean(axis=0)))
