"""What a logger does to a column: it holds values in between (`drawn_between`), or adds noise.

A battery's current comes five times a second, a position once, and a logger repeats the last value
until the next: on the average the column is late by half a period, which an effect by the column's
change (an eddy current, another current's edge) explains as well as the truth.  What was sampled is
drawn straight between its values instead.  Levels that were commanded hold as well, but no two of
them equally long.

A speed, a depth or a temperature is often logged with a noise of its own, a few times a second,
and held or drawn straight between.  The noise is then in the regressor: what follows the column is
told too small, and the noise itself is left over as a source that nobody knows.  Where the noise
can be told from the course, the column is what it is expected to be, given what was logged
(`cleaned`).

It can be told where the values' upper half of frequencies is flat and Gaussian, as what a sensor
adds is, and next to nothing of the course.  A throttle has steps, a gust is not flat: these are
left as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.columns.roles import role_of
from ahrsd.diagnosis.time_series import SPECTRUM_ROWS, wiener_filter
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

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
    if len(rows) < priors.COLUMN_UPDATES:
        return None
    lengths = np.diff(rows)
    period = float(np.median(lengths))
    miss = max(priors.COLUMN_MISS * period, 1.0)
    usual = np.abs(lengths - period) <= miss
    if (
        period < 2.0
        or period * track.step_s > priors.COLUMN_HELD_S
        or usual.mean() < priors.COLUMN_REGULAR
    ):
        return None
    # a value that came again is no change: it was new one period before the next as well
    again = rows[1:][lengths > period + miss] - round(period)
    return HeldColumn(name, np.union1d(rows, again), period * track.step_s)


def drawn_between(track: Track, columns: tuple[HeldColumn, ...]) -> Track:
    """The track with these columns drawn straight between their values."""
    drawn = {one.name: one.between(track.covariates[one.name]) for one in columns}
    return track.with_columns({**track.covariates, **drawn})


@dataclass(frozen=True, slots=True)
class Logged:
    """How a column was logged: a value every `rows` rows from row `first` on, held or drawn."""

    rows: int
    first: int
    held: bool

    def between(self, values: Array, count: int) -> Array:
        """(count,) rows of logged values; before the first and after the last as these are."""
        if self.held:
            at = np.clip((np.arange(count) - self.first) // self.rows, 0, len(values) - 1)
            return np.asarray(values[at])
        known = self.first + self.rows * np.arange(len(values))
        return np.asarray(np.interp(np.arange(count), known, values))


def logged(values: Array) -> Logged:
    """How (N,) values were logged: the rows at which they change, or turn, are a step apart."""
    changes = np.flatnonzero(np.diff(values)) + 1
    bends = np.flatnonzero(np.abs(np.diff(values, 2)) > 2.01 * _resolution(values)) + 1
    for at, held in ((changes, True), (bends, False)):
        rows = int(np.gcd.reduce(np.diff(at))) if len(at) > 1 else 1
        if rows > 1:
            return Logged(rows, int(at[0]) % rows, held)
    return Logged(1, 0, held=True)


def _resolution(values: Array) -> float:
    """The smallest difference between numbers that are not the same: how fine they were written."""
    apart = np.diff(np.unique(values))
    return float(apart.min()) if len(apart) else 0.0


def without_noise(values: Array) -> Array | None:
    """(N,) a column as it is expected to be without its logger's noise; None where it has none
    that can be told from its course."""
    how = logged(values)
    own = values[how.first :: how.rows]
    if len(own) < SPECTRUM_ROWS or not _is_noise(own):
        return None
    course = wiener_filter(own[:, None])[:, 0]
    if np.var(course) < priors.COLUMN_COURSE * np.var(own):
        return None
    return how.between(course, len(values))


def _is_noise(values: Array) -> bool:
    """Whether the upper half of the frequencies of (n,) values is flat and Gaussian."""
    cosines = fft.dct(values - values.mean(), norm="ortho")
    half, rest = len(cosines) // 2, len(cosines) * 3 // 4
    third, fourth = np.mean(cosines[half:rest] ** 2), np.mean(cosines[rest:] ** 2)
    # a mean of k squares of normal numbers scatters by sqrt(2 / k), a fourth moment by sqrt(24 / k)
    flat = abs(third - fourth) < priors.COLUMN_NOISE_SCATTER * np.sqrt(16.0 / len(values)) * fourth
    quick = fft.idct(np.where(np.arange(len(cosines)) < half, 0.0, cosines), norm="ortho")
    fourth_moment = np.mean(quick**4) / max(float(np.mean(quick**2) ** 2), 1e-300)
    gaussian = abs(fourth_moment - 3.0) < priors.COLUMN_NOISE_SCATTER * np.sqrt(24.0 / half)
    return bool(flat and gaussian)


def cleaned(track: Track, names: tuple[str, ...]) -> Track | None:
    """The track with these columns without their loggers' noise; None where none of them has any.

    A track with pauses is left alone: how often a column was logged cannot be told there.
    """
    if len(track.runs) > 1:
        return None
    clean = {name: without_noise(track.covariates[name]) for name in names}
    found = {name: values for name, values in clean.items() if values is not None}
    return track.with_columns({**track.covariates, **found}) if found else None
