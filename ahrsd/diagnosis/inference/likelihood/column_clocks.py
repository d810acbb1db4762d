"""Test whether a logged column has another clock than the sensor, with the richest model.

The richest model's free field on the sensor contains whatever is missing.  If a column explains
most of that field at some other time (`clocks`), the shift is tested by Bayes factors.  The model
is then the richest model without the free field and without what depends on the column as logged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.columns.clocks import (
    ColumnClock,
    column_at_clock,
    find_shifted_columns,
    most_probable_clock,
)
from ahrsd.diagnosis.effects.design_matrix import on_axes
from ahrsd.diagnosis.inference.components.component import Component, ScaledLaw
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit
from ahrsd.diagnosis.inference.likelihood.linearisation import coefficients_by_key, linearise
from ahrsd.diagnosis.inference.likelihood.richest_model import (
    FREE_PROCESSES,
    FittedPoint,
    psi_by_key,
)
from ahrsd.diagnosis.model import Columns
from ahrsd.diagnosis.where_and_when.locate import Located, equal_segments

_FREE_FIELD = FREE_PROCESSES[0]


def find_wrong_clock(fitted: FittedPoint) -> ColumnClock | None:
    """The clock of the column that explains most of the richest model's free field, if wrong."""
    track = fitted.base.made.context.track
    if not track.covariates:
        return None
    suspected = find_shifted_columns(_free_field(fitted), track)
    suspected = [one for one in suspected if abs(one[0]) > priors.ON_TIME_S]
    return (
        most_probable_clock(_ClockEvidence(fitted, suspected[0][1]), suspected[0][0])
        if suspected
        else None
    )


def _free_field(fitted: FittedPoint) -> Located:
    """The free field on the sensor, interval by interval."""
    base, track = fitted.base, fitted.base.made.context.track
    cut = equal_segments(track.time_s, max(2, int(track.duration_s / priors.ON_TIME_S)))
    value, coefficient_deviation = (
        coefficients_by_key(base.made, base.whole, at)[_FREE_FIELD].reshape(-1, 3)
        for at in (fitted.at, replace(fitted.at, mean=fitted.at.deviation))
    )
    phase = np.pi * (cut.middle_s - track.time_s[0]) / track.duration_s
    modes = np.cos(phase[:, None] * np.arange(1, len(value) + 1))
    deviation = np.sqrt(np.mean(modes**2 @ coefficient_deviation**2, axis=1))
    flat = np.array([1.0, 0.0, 0.0])
    return Located("sensor", 0.0, cut, modes @ value, deviation, flat)


class _ClockEvidence:
    """Evidence for the field of one column shifted in time, given a model (`ColumnEvidence`)."""

    def __init__(self, fitted: FittedPoint, column: str) -> None:
        base, track = fitted.base, fitted.base.made.context.track
        self.column, self.duration_s = column, track.duration_s
        self.middle_s = float(track.time_s[0] + track.time_s[-1]) / 2
        made = linearise(base.made.point, base.made.context)
        parts = [base.made.seen[key].component for key in base.whole]
        self._parts = [
            one for one in parts if one.key != _FREE_FIELD and not self._depends_on_column(one)
        ]
        made.add(self._parts)
        made.add_back({
            key: value for key, value in made.point.values.items() if key in made.seen
        })  # fmt: skip
        self._keys = tuple(one.key for one in self._parts)
        psi = psi_by_key(base.made, base.whole, fitted.at)
        at = np.concatenate([*(psi[key] for key in self._keys), np.zeros(0)])
        self._made, self._at = made, replace(fitted.at, psi=at)

    def _depends_on_column(self, one: Component) -> bool:
        return one.setting.get("covariate") == self.column

    def nats(self, clocks: Sequence[tuple[float, float]]) -> list[float]:
        """Log Bayes factors."""
        candidates = [self._component(clock) for clock in clocks]
        self._made.add(candidates)
        at: ModelFit = self._at
        log_bayes_factors = candidate_scan(self._made, self._keys, at).log_bayes_factors(
            [one.key for one in candidates]
        )
        return [log_bayes_factors[one.key] for one in candidates]

    def _component(self, clock: tuple[float, float]) -> Component:
        values = column_at_clock(self._made.context.track, self.column, clock, self.middle_s)
        scaled = values / max(float(np.std(values)), 1e-300)
        low, high = np.log(priors.EFFECT_SIZES)
        law = ScaledLaw(np.full(3, priors.COURSE_UNIT["sensor"]), np.array([low]), np.array([high]))
        columns = Columns(mag=on_axes(scaled[:, None]))
        return Component(f"{self.column} at {clock}", "sensor", columns, law)
