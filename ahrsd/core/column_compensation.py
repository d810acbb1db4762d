"""Columns that the vehicle tells beside the stream, and what a repaired model's terms make of them.

    vehicle.load_terms(text)                 # model.json of `ahrsd diagnose --report`
    vehicle.record_columns(host_s, {"motor_current_a": 3.2})  # as often as the vehicle says it
    block = vehicle.with_columns(block)      # by the host's time of each sample
    free = vehicle.without_terms(block)      # what is calibrated; None: no column

Only terms that a column gives from one sample to the next can be taken out of a running stream: a
current's field, a temperature's bias. What follows the motion, the edges of a column or the time
of one recording stays where it is, and is said.
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

_KEPT = 256  # instants of a column: some seconds at any rate that a vehicle tells it
Added = Callable[["Term", Array, Array, Mapping[str, Array]], Array]


class VehicleTerms:
    """See the module. `warn` takes sentences for a person; one may come again and again."""

    def __init__(self, warn: Callable[[str], object], max_age_s: float) -> None:
        self.terms: tuple[Term, ...] = ()
        self.waits_for: tuple[str, ...] = ()  # columns that the newest samples lack
        self._warn, self._max_age_s = warn, max_age_s
        self._columns: dict[str, deque[tuple[float, float]]] = {}
        self._gap = False
        self._added: Added | None = None

    def take(self, item: Columns | TermsKnown) -> None:
        """What the vehicle measures, or the model. A text that is no model is said, not raised."""
        if isinstance(item, Columns):
            self.record_columns(item.host_ns * 1e-9, item.values)
            return
        try:
            self.load_terms(item.text)
        except ValueError as error:
            self._warn(f"the model of the terms {error}")

    def load_terms(self, text: str) -> None:
        """The model's text; terms that cannot be followed are said. ValueError: it is no model."""
        # the library of effects takes 50 MB, which a daemon without a model does without
        from ahrsd.diagnosis.repaired_model.column_terms import (
            column_contribution,
            follows_a_column,
        )
        from ahrsd.diagnosis.repaired_model.model_file import from_text

        terms, self._added = from_text(text).terms, column_contribution
        self.terms = tuple(term for term in terms if follows_a_column(term))
        for term in terms:
            if term not in self.terms:
                self._warn(
                    f"{term.identifier} is in the model and does not follow a column from sample "
                    "to sample: it stays in the readings"
                )
        if self.terms:
            names = ", ".join(f"{t.identifier} ({t.setting['covariate']})" for t in self.terms)
            self._warn(f"calibrated without {names}")

    def record_columns(self, host_s: float, values: Mapping[str, float]) -> None:
        """The columns at a moment."""
        for name, value in values.items():
            self._columns.setdefault(name, deque(maxlen=_KEPT)).append((host_s, value))

    def with_columns(self, block: SampleBlock) -> SampleBlock:
        """The block with what the vehicle told; nan where that is older than `max_age_s`."""
        if not self._columns:
            return block
        told = {name: self._at(block.host_s, known) for name, known in self._columns.items()}
        return replace(block, covariates={**told, **block.covariates})

    def _at(self, host_s: Array, known: deque[tuple[float, float]]) -> Array:
        at_s, values = np.array(known).T
        after = np.clip(np.searchsorted(at_s, host_s), 0, len(at_s) - 1)
        before = np.maximum(after - 1, 0)
        away_s = np.minimum(np.abs(host_s - at_s[after]), np.abs(host_s - at_s[before]))
        return np.where(away_s <= self._max_age_s, np.interp(host_s, at_s, values), np.nan)

    def without_terms(self, block: SampleBlock) -> SampleBlock | None:
        """The block without what the terms add; None where one of its columns is not known."""
        if not self.terms or self._added is None or not len(block):
            return block
        columns = block.covariates
        parts = [self._added(term, block.time_s, block.dt_s, columns) for term in self.terms]
        if not all(np.isfinite(part).all() for part in parts):
            self._gap, self.waits_for = True, self._missing(block)
            self._warn(f"samples without {', '.join(self.waits_for)} are not calibrated")
            return None
        self.waits_for = ()
        gap, self._gap = block.gap_before or self._gap, False
        mag, gyro = np.sum(parts, axis=0)
        return replace(
            block,
            raw_b_gauss=block.raw_b_gauss - mag,
            gyro_b_rad_s=block.gyro_b_rad_s - gyro,
            gap_before=gap,
        )

    def _missing(self, block: SampleBlock) -> tuple[str, ...]:
        wanted = dict.fromkeys(str(term.setting["covariate"]) for term in self.terms)
        known = block.covariates
        return tuple(n for n in wanted if n not in known or not np.isfinite(known[n]).all())
