"""The clock of a column (`columns/clocks.py`) by the innovations, beside the calibration.

A field by the column must explain far more there at its true time than as logged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis.columns.clocks import Late, at_clock, likeliest_clock
from ahrsd.diagnosis.effects.shapes import on_axes
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.regression import Base, quieter, without_known
from ahrsd.diagnosis.values import Columns


def clock_of(basis: Base, name: str, around_s: float) -> Late | None:
    """The clock of a column that moves a field in the sensor's axes; None where it is right.

    basis: with the calibration known, and nothing that follows the column
    """
    return likeliest_clock(_EvidenceInInnovations(basis, name), around_s)


class _EvidenceInInnovations:
    """A field in the sensor's axes by one column at other times, against the innovations."""

    def __init__(self, basis: Base, name: str) -> None:
        track = basis.context.track
        self.middle_s = float(track.time_s[0] + track.time_s[-1]) / 2
        self.column, self.duration_s, self._basis = name, track.duration_s, basis

    def quieten(self, clock: tuple[float, float]) -> None:
        """Take the noise's colour from what the column leaves at (lag, drift)."""
        (part,) = self._basis.whitened([self._columns(*clock)])
        self._basis = quieter(self._basis, part)

    def _columns(self, lag_s: float, drift: float) -> Columns:
        track = self._basis.context.track
        course = at_clock(track, self.column, (lag_s, drift), self.middle_s)
        return Columns(mag=on_axes(course[:, None]))

    def nats(self, clocks: Sequence[tuple[float, float]]) -> list[float]:
        """Half the score statistic at each (lag, drift), in the noise's colour."""
        parts = self._basis.whitened([self._columns(*clock) for clock in clocks])
        X, e = without_known(self._basis, np.concatenate(parts, axis=2))
        flat, seen = X.reshape(-1, X.shape[2]), e.ravel()
        score = flat.T @ seen
        found = []
        for k in range(0, len(score), 3):
            part = flat[:, k : k + 3]
            s = score[k : k + 3]
            found.append(0.5 * float(s @ solve(part.T @ part, s[:, None])[:, 0]))
        return [one / self._basis.colour for one in found]
