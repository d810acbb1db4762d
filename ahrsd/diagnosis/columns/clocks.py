"""A logged column with a clock of its own: so many seconds late, or early, or drifting.

What no name explains has a course, one vector per stretch.  A cause that was logged by another
clock has the same course at another time.  So for every column its share of that course is taken
at all lags up to a minute.  Any column fits at some lag as chance has it: it must stand out from
what it reaches when it is turned round to any other time, in which its number of independent values
is.  That finds the column; its clock is then the one at which it is worth most to a model of the
recording (`ColumnEvidence`), far more than as logged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.columns.roles import shown
from ahrsd.diagnosis.external_simulation import cut_track
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.where_and_when.locate import Located
from ahrsd.samples import Array

LONGEST_S, STEP_S = 60.0, 0.5
#: drifts from one end to the other, seconds
DRIFTS_S = (1.0, 2.0, 4.0, 6.0, 9.0, 13.0, 19.0, 28.0, 40.0)
#: half the range and step in which a clock is first sought
COARSE_S = (8.0, 0.5)


@dataclass(frozen=True, slots=True)
class Late:
    """What a column says at t was true at t - lag_s - drift * (t - middle_s)."""

    column: str
    lag_s: float
    drift: float
    middle_s: float

    def moved(self, track: Track) -> Track:
        """The track with the column at the sensor's time, while the column was logged."""
        at_s = track.time_s + self.lag_s + self.drift * (track.time_s - self.middle_s)
        values = np.interp(at_s, track.time_s, track.covariates[self.column])
        inside = np.flatnonzero((at_s >= track.time_s[0]) & (at_s <= track.time_s[-1]))
        whole = track.with_columns({**track.covariates, self.column: values})
        return cut_track(whole, float(track.time_s[inside[0]]), float(track.time_s[inside[-1]]))

    @property
    def words(self) -> str:
        """Which column, by how much."""
        way = "late" if self.lag_s > 0 else "early"
        text = f"column {shown(self.column)} runs {abs(self.lag_s):.3g} s {way} against the sensor"
        if self.drift:
            text += f" halfway, and its clock drifts by {100 * abs(self.drift):.2g} %"
        return text


def suspects(course: Located, track: Track) -> list[tuple[float, str]]:
    """(lag_s, column) of the columns that explain most of the course at some lag, the best first.

    course: in the sensor's axes
    """
    found = []
    for name, values in track.covariates.items():
        if not roles.role_of(name, values) or roles.fault(name, values):
            continue
        held = _Held(course, track, name)
        reach_s = min(LONGEST_S, track.duration_s / 4)
        lags = np.arange(-reach_s, reach_s + STEP_S, STEP_S)
        share = held.shares(lags)
        most, lag_s = float(share.max()), float(lags[int(np.argmax(share))])
        if most > priors.CLOCK_SHARE and np.arctanh(most**0.5) > priors.CLOCK_SURE * held.usual(
            lag_s
        ):
            found.append((most, lag_s, name))
    return [(lag_s, name) for _, lag_s, name in sorted(found, reverse=True)]


class ColumnEvidence(Protocol):
    """A field in the sensor's axes by one column at other times, against the readings.

    middle_s: time about which a clock drifts;  duration_s: of the recording
    """

    column: str
    middle_s: float
    duration_s: float

    def nats(self, clocks: Sequence[tuple[float, float]]) -> list[float]:
        """What the column explains at each (lag, drift)."""


def likeliest_clock(asked: ColumnEvidence, around_s: float) -> Late | None:
    """The clock by the evidence of a model, sought round a lag, s."""
    coarse = np.arange(around_s - COARSE_S[0], around_s + COARSE_S[0] + 0.1, COARSE_S[1])
    at, _ = _best(asked, [(float(lag), 0.0) for lag in coarse])
    none, most = asked.nats([(0.0, 0.0), at])
    slopes = [sign * d / asked.duration_s for d in DRIFTS_S for sign in (-1.0, 1.0)]
    near = np.arange(-COARSE_S[0], COARSE_S[0] + 0.1, 2.0)
    wider = [(at[0] + float(k), slope) for slope in slopes for k in near]
    drifting, more = _best(asked, wider)
    if more > most + priors.CLOCK_NATS:
        at, most = drifting, more
    for step_s in (0.5, 0.15, 0.05):
        slope = 2 * step_s / asked.duration_s if at[1] else 0.0
        slopes = [at[1] + k * slope for k in (-2, -1, 0, 1, 2)] if slope else [0.0]
        at, most = _best(asked, [(at[0] + k * step_s, b) for k in range(-3, 4) for b in slopes])
    if most < none + priors.CLOCK_NATS or (abs(at[0]) < priors.CLOCK_SMALLEST_S and not at[1]):
        return None
    return Late(asked.column, round(at[0], 3), at[1], asked.middle_s)


def _best(
    asked: ColumnEvidence, clocks: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], float]:
    """The (lag, drift) that explains most, and its nats."""
    found = asked.nats(clocks)
    k = int(np.argmax(found))
    return clocks[k], found[k]


def at_clock(track: Track, column: str, clock: tuple[float, float], middle_s: float) -> Array:
    """(N,) a column as it would be at a (lag, drift), about its mean."""
    lag_s, drift = clock
    at_s = track.time_s + lag_s + drift * (track.time_s - middle_s)
    course = np.interp(at_s, track.time_s, track.covariates[column])
    return np.asarray(course - course.mean())


class _Held:
    """One column against the course (J, 3) in its stretches, weighted."""

    def __init__(self, course: Located, track: Track, name: str) -> None:
        self._edges, self._time_s = course.cut.edges_s, track.time_s
        self._weight = 1.0 / np.maximum(course.deviation, 1e-12)
        self._sum = np.cumsum(
            track.covariates[name] * np.diff(track.time_s, prepend=track.time_s[0])
        )
        self._y = self._centred(course.course)

    def _means(self, lag_s: float) -> Array:
        """(J,) means of the column over the stretches, so much later."""
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
        """Part of the course that the means (J,) explain."""
        x = self._centred(means)
        power = float(x @ x) * float(np.sum(self._y**2))
        return float(np.sum((x @ self._y) ** 2)) / power if power > 0 else 0.0

    def shares(self, lags_s: Array) -> Array:
        """Parts of the course explained at each lag."""
        return np.array([self._share(self._means(lag)) for lag in lags_s.tolist()])

    def usual(self, lag_s: float) -> float:
        """Root mean square of what the column reaches when it is turned round elsewhere."""
        still, count = self._means(0.0), len(self._weight)
        at = round(lag_s / float(self._edges[-1] - self._edges[0]) * count)
        shifts = [k for k in range(count) if min((k + at) % count, -(k + at) % count) > 2]
        found = [self._share(np.roll(still, k)) for k in shifts]
        return float(np.sqrt(np.mean(np.arctanh(np.sqrt(np.clip(found, 0, 0.999))) ** 2)))
