"""A logged column with a clock of its own: late or early by some seconds, or drifting.

The part of the field that no effect explains is a time series, one vector per interval.  A cause
that was logged by another clock follows the same time series at another time.  So for every column
the share of the series that it explains is computed at all lags up to a minute.  By chance any
column fits at some lag.  It must stand out from what it explains when it is shifted cyclically to
any other time, which also accounts for its number of independent values.  This finds the column.
Its clock is then the one with the highest evidence in a model of the recording (`ColumnEvidence`),
which must be far higher than that of the column as logged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.external_simulation import cut_track
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.where_and_when.locate import Located
from ahrsd.samples import Array

LONGEST_S, STEP_S = 60.0, 0.5
#: drifts from one end to the other, seconds
DRIFTS_S = (1.0, 2.0, 4.0, 6.0, 9.0, 13.0, 19.0, 28.0, 40.0)
#: half the range and the step of the first search for a clock
COARSE_S = (8.0, 0.5)


@dataclass(frozen=True, slots=True)
class ColumnClock:
    """What a column shows at t was true at t - lag_s - drift * (t - middle_s)."""

    column: str
    lag_s: float
    drift: float
    middle_s: float

    def realigned_track(self, track: Track) -> Track:
        """The track with the column at the sensor's time, cut to where the column was logged."""
        at_s = track.time_s + self.lag_s + self.drift * (track.time_s - self.middle_s)
        values = np.interp(at_s, track.time_s, track.covariates[self.column])
        inside = np.flatnonzero((at_s >= track.time_s[0]) & (at_s <= track.time_s[-1]))
        whole = track.with_columns({**track.covariates, self.column: values})
        return cut_track(whole, float(track.time_s[inside[0]]), float(track.time_s[inside[-1]]))

    @property
    def words(self) -> str:
        """Which column, and by how much."""
        way = "late" if self.lag_s > 0 else "early"
        text = f"column {label(self.column)} is {abs(self.lag_s):.3g} s {way} against the sensor"
        if self.drift:
            text += (
                " in the middle of the recording, and its clock drifts by "
                f"{100 * abs(self.drift):.2g} %"
            )
        return text


def find_shifted_columns(series: Located, track: Track) -> list[tuple[float, str]]:
    """(lag_s, column) of columns that explain most of a time series at some lag, the best first.

    series: in the sensor's axes
    """
    found = []
    for name, values in track.covariates.items():
        if not roles.role_of(name, values) or roles.refusal_reason(name, values):
            continue
        match = _ColumnMatch(series, track, name)
        reach_s = min(LONGEST_S, track.duration_s / 4)
        lags = np.arange(-reach_s, reach_s + STEP_S, STEP_S)
        share = match.shares(lags)
        most, lag_s = float(share.max()), float(lags[int(np.argmax(share))])
        if most > priors.CLOCK_SHARE and np.arctanh(
            most**0.5
        ) > priors.CLOCK_SURE * match.chance_level(lag_s):
            found.append((most, lag_s, name))
    return [(lag_s, name) for _, lag_s, name in sorted(found, reverse=True)]


class ColumnEvidence(Protocol):
    """Evidence for a field, in the sensor's axes, that follows one column at other times.

    middle_s: time about which a clock drifts;  duration_s: of the recording
    """

    column: str
    middle_s: float
    duration_s: float

    def nats(self, clocks: Sequence[tuple[float, float]]) -> list[float]:
        """Log Bayes factor of the column at each (lag, drift)."""


def most_probable_clock(evidence: ColumnEvidence, around_s: float) -> ColumnClock | None:
    """The clock with the highest evidence near a lag, seconds; None if it is right as logged."""
    coarse = np.arange(around_s - COARSE_S[0], around_s + COARSE_S[0] + 0.1, COARSE_S[1])
    at, _ = _best_clock(evidence, [(float(lag), 0.0) for lag in coarse])
    none, most = evidence.nats([(0.0, 0.0), at])
    slopes = [sign * d / evidence.duration_s for d in DRIFTS_S for sign in (-1.0, 1.0)]
    near = np.arange(-COARSE_S[0], COARSE_S[0] + 0.1, 2.0)
    wider = [(at[0] + float(k), slope) for slope in slopes for k in near]
    drifting, more = _best_clock(evidence, wider)
    if more > most + priors.CLOCK_NATS:
        at, most = drifting, more
    for step_s in (0.5, 0.15, 0.05):
        slope = 2 * step_s / evidence.duration_s if at[1] else 0.0
        slopes = [at[1] + k * slope for k in (-2, -1, 0, 1, 2)] if slope else [0.0]
        at, most = _best_clock(
            evidence, [(at[0] + k * step_s, b) for k in range(-3, 4) for b in slopes]
        )
    if most < none + priors.CLOCK_NATS or (abs(at[0]) < priors.CLOCK_SMALLEST_S and not at[1]):
        return None
    return ColumnClock(evidence.column, round(at[0], 3), at[1], evidence.middle_s)


def _best_clock(
    evidence: ColumnEvidence, clocks: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], float]:
    """The (lag, drift) with the highest evidence, and its nats."""
    found = evidence.nats(clocks)
    k = int(np.argmax(found))
    return clocks[k], found[k]


def column_at_clock(
    track: Track, column: str, clock: tuple[float, float], middle_s: float
) -> Array:
    """(N,) a column as it would be at a (lag, drift), less its mean."""
    lag_s, drift = clock
    at_s = track.time_s + lag_s + drift * (track.time_s - middle_s)
    values = np.interp(at_s, track.time_s, track.covariates[column])
    return np.asarray(values - values.mean())


class _ColumnMatch:
    """One column compared with the time series (J, 3) in its intervals, weighted."""

    def __init__(self, series: Located, track: Track, name: str) -> None:
        self._edges, self._time_s = series.cut.edges_s, track.time_s
        self._weight = 1.0 / np.maximum(series.deviation, 1e-12)
        self._sum = np.cumsum(
            track.covariates[name] * np.diff(track.time_s, prepend=track.time_s[0])
        )
        self._y = self._centred(series.course)

    def _means(self, lag_s: float) -> Array:
        """(J,) means of the column over the intervals, shifted by a lag."""
        edges = np.clip(self._edges + lag_s, self._time_s[0], self._time_s[-1])
        length = np.diff(edges)
        means = np.diff(np.interp(edges, self._time_s, self._sum)) / np.maximum(length, 1e-9)
        known = np.flatnonzero(length > 0)
        return np.asarray(np.interp(np.arange(len(means)), known, means[known]))

    def _centred(self, values: Array) -> Array:
        """Values (J, ...), weighted, without their weighted mean."""
        return np.asarray(
            ((values - np.average(values, axis=0, weights=self._weight**2)).T * self._weight).T
        )

    def _share(self, means: Array) -> float:
        """Share of the time series that the means (J,) explain."""
        x = self._centred(means)
        power = float(x @ x) * float(np.sum(self._y**2))
        return float(np.sum((x @ self._y) ** 2)) / power if power > 0 else 0.0

    def shares(self, lags_s: Array) -> Array:
        """Share of the time series explained at each lag."""
        return np.array([self._share(self._means(lag)) for lag in lags_s.tolist()])

    def chance_level(self, lag_s: float) -> float:
        """Root mean square, as atanh of a correlation, of what other cyclic shifts explain."""
        still, count = self._means(0.0), len(self._weight)
        at = round(lag_s / float(self._edges[-1] - self._edges[0]) * count)
        shifts = [k for k in range(count) if min((k + at) % count, -(k + at) % count) > 2]
        found = [self._share(np.roll(still, k)) for k in shifts]
        return float(np.sqrt(np.mean(np.arctanh(np.sqrt(np.clip(found, 0, 0.999))) ** 2)))
