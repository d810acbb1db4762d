"""Columns that the vehicle reports besides the stream, and a repaired model's terms of them.

    vehicle.load_terms(text)                 # model.json of `ahrsd diagnose --report`
    vehicle.record_columns(host_s, {"motor_current_a": 3.2})  # as often as the vehicle reports it
    block = vehicle.with_columns(block)      # at the host time of each sample
    free = vehicle.without_terms(block)      # for the calibration; None: a column is missing

Only terms that follow from a column sample by sample can be subtracted from a running stream: the
field of a current, the bias due to temperature. Terms of the motion, of the edges of a column or of
the time of one recording stay in the readings, and are reported.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ahrsd.inputs import Columns, TermsKnown
from ahrsd.samples import Array, SampleBlock

if TYPE_CHECKING:
    from ahrsd.diagnosis.model import Term

_KEPT = 256  # instants of a column: some seconds at any rate of the vehicle
TermEvaluation = Callable[["Term", Array, Array, Mapping[str, Array]], Array]


class VehicleTerms:
    """See the module. `warn` takes sentences for a person; the same one may be repeated."""

    def __init__(self, warn: Callable[[str], object], max_age_s: float) -> None:
        self.terms: tuple[Term, ...] = ()
        self.waits_for: tuple[str, ...] = ()  # columns missing from the newest samples
        self._warn, self._max_age_s = warn, max_age_s
        self._columns: dict[str, deque[tuple[float, float]]] = {}
        self._gap = False
        self._evaluate_term: TermEvaluation | None = None

    def take(self, item: Columns | TermsKnown) -> None:
        """Take columns or the model. An invalid model text is a warning, not an exception."""
        if isinstance(item, Columns):
            self.record_columns(item.host_ns * 1e-9, item.values)
            return
        try:
            self.load_terms(item.text)
        except ValueError as error:
            self._warn(f"the model of the terms {error}")

    def load_terms(self, text: str) -> None:
        """Load the model; warns of terms that cannot be followed. ValueError: it is no model."""
        # the effect library takes 50 MB, which a daemon without a model does not need
        from ahrsd.diagnosis.repaired_model.column_terms import (
            column_contribution,
            follows_a_column,
        )
        from ahrsd.diagnosis.repaired_model.model_file import from_text

        terms, self._evaluate_term = from_text(text).terms, column_contribution
        self.terms = tuple(term for term in terms if follows_a_column(term))
        for term in terms:
            if term not in self.terms:
                self._warn(
                    f"{term.identifier} is in the model but is no function of a column, "
                    "sample by sample: it stays in the readings"
                )
        if self.terms:
            names = ", ".join(f"{t.identifier} ({t.setting['covariate']})" for t in self.terms)
            self._warn(f"calibrated without {names}")

    def record_columns(self, host_s: float, values: Mapping[str, float]) -> None:
        """Store the columns at one instant."""
        for name, value in values.items():
            self._columns.setdefault(name, deque(maxlen=_KEPT)).append((host_s, value))

    def with_columns(self, block: SampleBlock) -> SampleBlock:
        """The block with the vehicle's columns; nan where no value is within `max_age_s`."""
        if not self._columns:
            return block
        measured = {
            name: self._interpolate(block.host_s, known) for name, known in self._columns.items()
        }
        return replace(block, covariates={**measured, **block.covariates})

    def _interpolate(self, host_s: Array, known: deque[tuple[float, float]]) -> Array:
        at_s, values = np.array(known).T
        after = np.clip(np.searchsorted(at_s, host_s), 0, len(at_s) - 1)
        before = np.maximum(after - 1, 0)
        away_s = np.minimum(np.abs(host_s - at_s[after]), np.abs(host_s - at_s[before]))
        return np.where(away_s <= self._max_age_s, np.interp(host_s, at_s, values), np.nan)

    def without_terms(self, block: SampleBlock) -> SampleBlock | None:
        """The block with the terms subtracted; None if one of their columns is missing."""
        if not self.terms or self._evaluate_term is None or not len(block):
            return block
        columns = block.covariates
        contributions = [
            self._evaluate_term(term, block.time_s, block.dt_s, columns) for term in self.terms
        ]
        if not all(np.isfinite(values).all() for values in contributions):
            self._gap, self.waits_for = True, self._missing_columns(block)
            self._warn(f"samples without {', '.join(self.waits_for)} are not calibrated")
            return None
        self.waits_for = ()
        gap, self._gap = block.gap_before or self._gap, False
        mag, gyro = np.sum(contributions, axis=0)
        return replace(
            block,
            raw_b_gauss=block.raw_b_gauss - mag,
            gyro_b_rad_s=block.gyro_b_rad_s - gyro,
            gap_before=gap,
        )

    def _missing_columns(self, block: SampleBlock) -> tuple[str, ...]:
        required = dict.fromkeys(str(term.setting["covariate"]) for term in self.terms)
        known = block.covariates
        return tuple(n for n in required if n not in known or not np.isfinite(known[n]).all())
