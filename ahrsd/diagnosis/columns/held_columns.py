"""Columns that were logged more seldom than the sensor, and held in between.

A battery's current comes five times a second, a position once, and a logger repeats the last value
until the next: on the average the column is late by half a period, which an effect by the column's
change (an eddy current, another current's edge) explains as well as the truth.  What was sampled is
drawn straight between its values instead.  Levels that were commanded hold as well, but no two of
them equally long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.columns.roles import role_of
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

#: seconds between values, at most: what changes more seldom is a level
LONGEST_S = 5.0
#: share of the values that come after one period, and by how much of one they may miss it
REGULAR, MISS = 0.6, 0.25
#: fewest values that tell how a column was logged
FEWEST = 20
#: columns of two levels, whose edges are as they are
EDGES = ("switch", "ping")


@dataclass(frozen=True, slots=True)
class HeldColumn:
    """A column with a new value at each of some rows, every `period_s` or so."""

    name: str
    rows: NDArray[np.intp]
    period_s: float

    def between(self, values: Array) -> Array:
        """(N,) the values drawn straight between the rows at which they were new."""
        return np.asarray(np.interp(np.arange(len(values)), self.rows, values[self.rows]))

    @property
    def often(self) -> str:
        """How often it was logged."""
        return f"every {self.period_s:.2g} s"


def held_columns(track: Track) -> tuple[HeldColumn, ...]:
    """The columns that were sampled more seldom than the sensor and held."""
    found = (_held(name, values, track) for name, values in track.covariates.items())
    return tuple(one for one in found if one is not None)


def _held(name: str, values: Array, track: Track) -> HeldColumn | None:
    if role_of(name, values) in (None, *EDGES) or not np.isfinite(values).all():
        return None
    rows = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    if len(rows) < FEWEST:
        return None
    lengths = np.diff(rows)
    period = float(np.median(lengths))
    miss = max(MISS * period, 1.0)
    usual = np.abs(lengths - period) <= miss
    if period < 2.0 or period * track.step_s > LONGEST_S or usual.mean() < REGULAR:
        return None
    # a value that came again is no change: it was new one period before the next as well
    again = rows[1:][lengths > period + miss] - round(period)
    return HeldColumn(name, np.union1d(rows, again), period * track.step_s)


def drawn_between(track: Track, columns: tuple[HeldColumn, ...]) -> Track:
    """The track with these columns drawn straight between their values."""
    drawn = {one.name: one.between(track.covariates[one.name]) for one in columns}
    return track.with_columns({**track.covariates, **drawn})
