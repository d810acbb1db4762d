"""Whether a logged column runs by another clock than the sensor, asked at the richest model.

Its free course on the sensor holds what is missing, whatever it is.  A column that explains most of
that course at some other time (`clocks`) is asked there, beside all of the richest model but the
course and what follows the column as it was logged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.columns.clocks import Late, at_clock, likeliest_clock, suspects
from ahrsd.diagnosis.effects.design_matrix import on_axes
from ahrsd.diagnosis.inference.components.component import Component, Sized
from ahrsd.diagnosis.inference.likelihood.candidates import beside
from ahrsd.diagnosis.inference.likelihood.evidence import At
from ahrsd.diagnosis.inference.likelihood.linearisation import by_key, linearised
from ahrsd.diagnosis.inference.likelihood.richest_model import RICH_COURSES, Judged, psi_by_key
from ahrsd.diagnosis.model import Columns
from ahrsd.diagnosis.where_and_when.locate import Located, equal_segments

_COURSE = RICH_COURSES[0]


def wrong_clock(found: Judged) -> Late | None:
    """The clock of the column that explains most of the richest model's free course, if wrong."""
    track = found.base.made.context.track
    if not track.covariates:
        return None
    asked = suspects(_course(found), track)
    asked = [one for one in asked if abs(one[0]) > priors.ON_TIME_S]
    return likeliest_clock(_EvidenceBesideModel(found, asked[0][1]), asked[0][0]) if asked else None


def _course(found: Judged) -> Located:
    """The free course on the sensor, stretch by stretch."""
    base, track = found.base, found.base.made.context.track
    cut = equal_segments(track.time_s, max(2, int(track.duration_s / priors.ON_TIME_S)))
    value, unsure = (
        by_key(base.made, base.whole, at)[_COURSE].reshape(-1, 3)
        for at in (found.at, replace(found.at, mean=found.at.deviation))
    )
    phase = np.pi * (cut.middle_s - track.time_s[0]) / track.duration_s
    waves = np.cos(phase[:, None] * np.arange(1, len(value) + 1))
    deviation = np.sqrt(np.mean(waves**2 @ unsure**2, axis=1))
    flat = np.array([1.0, 0.0, 0.0])
    return Located("sensor", 0.0, cut, waves @ value, deviation, flat)


class _EvidenceBesideModel:
    """A field by one column at other times, against the readings beside a model."""

    def __init__(self, found: Judged, column: str) -> None:
        base, track = found.base, found.base.made.context.track
        self.column, self.duration_s = column, track.duration_s
        self.middle_s = float(track.time_s[0] + track.time_s[-1]) / 2
        made = linearised(base.made.point, base.made.context)
        parts = [base.made.seen[key].component for key in base.whole]
        self._parts = [one for one in parts if one.key != _COURSE and not self._follows(one)]
        made.add(self._parts)
        made.put_back({
            key: value for key, value in made.point.values.items() if key in made.seen
        })  # fmt: skip
        self._keys = tuple(one.key for one in self._parts)
        psi = psi_by_key(base.made, base.whole, found.at)
        at = np.concatenate([*(psi[key] for key in self._keys), np.zeros(0)])
        self._made, self._at = made, replace(found.at, psi=at)

    def _follows(self, one: Component) -> bool:
        return one.setting.get("covariate") == self.column

    def nats(self, clocks: Sequence[tuple[float, float]]) -> list[float]:
        """Log Bayes factors."""
        new = [self._component(clock) for clock in clocks]
        self._made.add(new)
        at: At = self._at
        worth = beside(self._made, self._keys, at).worth([one.key for one in new])
        return [worth[one.key] for one in new]

    def _component(self, clock: tuple[float, float]) -> Component:
        course = at_clock(self._made.context.track, self.column, clock, self.middle_s)
        scaled = course / max(float(np.std(course)), 1e-300)
        low, high = np.log(priors.EFFECT_SIZES)
        law = Sized(np.full(3, priors.COURSE_UNIT["sensor"]), np.array([low]), np.array([high]))
        columns = Columns(mag=on_axes(scaled[:, None]))
        return Component(f"{self.column} at {clock}", "sensor", columns, law)
