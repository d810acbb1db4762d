"""What a logger does to a column: it holds values in between (`interpolate_held_column`), or adds
noise.

A battery's current is logged five times a second, a position once, and the logger repeats the last
value until the next.  On average the column is then late by half a period, which an effect of the
column's change (an eddy current, the edge of another current) explains as well as the truth.  So
sampled values are interpolated linearly instead.  Commanded levels also hold, but never for equally
long intervals.

A speed, a depth or a temperature is often logged with noise of its own, a few times a second, and
held or interpolated.  The noise is then in the regressor: the coefficient is estimated too small,
and the noise itself remains as an unknown source.  If the noise can be distinguished from the
signal, the column is replaced by its expectation given the logged values (`denoise_columns`).

It can be distinguished if the upper half of the values' frequencies is flat and Gaussian, as a
sensor's noise is, and contains next to nothing of the signal.  A throttle has steps, and a gust is
not flat: these columns are left unchanged.
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

#: roles of columns with two levels, whose edges are exact
TWO_LEVEL_ROLES = ("switch", "ping")


@dataclass(frozen=True, slots=True)
class HeldColumn:
    """A column with a new value at each of some rows, about every `period_s`."""

    name: str
    rows: NDArray[np.intp]
    period_s: float

    def interpolate(self, values: Array) -> Array:
        """(N,) values interpolated linearly between the rows at which they were new."""
        return np.asarray(np.interp(np.arange(len(values)), self.rows, values[self.rows]))

    @property
    def interval_words(self) -> str:
        """The interval of its values, in words."""
        return f"every {self.period_s:.2g} s"


def find_held_column(track: Track, name: str) -> HeldColumn | None:
    """The column as one that was sampled less often than the sensor and held; None if it is not."""
    values = track.covariates[name]
    if role_of(name, values) in (None, *TWO_LEVEL_ROLES) or not np.isfinite(values).all():
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
    # a sample with the same value shows no change: it was new one period before the next one, too
    again = rows[1:][lengths > period + miss] - round(period)
    return HeldColumn(name, np.union1d(rows, again), period * track.step_s)


def interpolate_held_column(track: Track, column: HeldColumn) -> Track:
    """The track with this column interpolated linearly between its values."""
    interpolated = column.interpolate(track.covariates[column.name])
    return track.with_columns({**track.covariates, column.name: interpolated})


@dataclass(frozen=True, slots=True)
class LoggingPattern:
    """How a column was logged: a value every `rows` rows from row `first`, held or interpolated."""

    rows: int
    first: int
    held: bool

    def interpolate(self, values: Array, count: int) -> Array:
        """(count,) rows of the logged values, constant before the first and after the last."""
        if self.held:
            at = np.clip((np.arange(count) - self.first) // self.rows, 0, len(values) - 1)
            return np.asarray(values[at])
        known = self.first + self.rows * np.arange(len(values))
        return np.asarray(np.interp(np.arange(count), known, values))


def find_logging_pattern(values: Array) -> LoggingPattern:
    """How (N,) values were logged: they change, or change slope, at regularly spaced rows."""
    changes = np.flatnonzero(np.diff(values)) + 1
    slope_changes = np.flatnonzero(np.abs(np.diff(values, 2)) > 2.01 * _resolution(values)) + 1
    for at, held in ((changes, True), (slope_changes, False)):
        rows = int(np.gcd.reduce(np.diff(at))) if len(at) > 1 else 1
        if rows > 1:
            return LoggingPattern(rows, int(at[0]) % rows, held)
    return LoggingPattern(1, 0, held=True)


def _resolution(values: Array) -> float:
    """The smallest difference between two different numbers: the resolution of the log."""
    apart = np.diff(np.unique(values))
    return float(apart.min()) if len(apart) else 0.0


def denoised_column(values: Array) -> Array | None:
    """Expectation (N,) of a column without its logger's noise.

    None if it has no noise that can be distinguished from the signal.
    """
    pattern = find_logging_pattern(values)
    samples = values[pattern.first :: pattern.rows]
    if len(samples) < SPECTRUM_ROWS or not _is_flat_and_gaussian(samples):
        return None
    signal = wiener_filter(samples[:, None])[:, 0]
    if np.var(signal) < priors.COLUMN_COURSE * np.var(samples):
        return None
    return pattern.interpolate(signal, len(values))


def _is_flat_and_gaussian(values: Array) -> bool:
    """Whether the upper half of the frequencies of (n,) values is flat and Gaussian."""
    cosines = fft.dct(values - values.mean(), norm="ortho")
    half, later = len(cosines) // 2, len(cosines) * 3 // 4
    third, fourth = np.mean(cosines[half:later] ** 2), np.mean(cosines[later:] ** 2)
    # with k normal numbers a mean square deviates by sqrt(2 / k), a fourth moment by sqrt(24 / k)
    flat = abs(third - fourth) < priors.COLUMN_NOISE_SCATTER * np.sqrt(16.0 / len(values)) * fourth
    high_pass = fft.idct(np.where(np.arange(len(cosines)) < half, 0.0, cosines), norm="ortho")
    fourth_moment = np.mean(high_pass**4) / max(float(np.mean(high_pass**2) ** 2), 1e-300)
    gaussian = abs(fourth_moment - 3.0) < priors.COLUMN_NOISE_SCATTER * np.sqrt(24.0 / half)
    return bool(flat and gaussian)


def denoise_columns(track: Track, names: tuple[str, ...]) -> Track | None:
    """The track with these columns without their loggers' noise; None if none of them has any.

    A track with pauses is left unchanged: how often a column was logged cannot be determined there.
    """
    if len(track.runs) > 1:
        return None
    denoised_by_name = {name: denoised_column(track.covariates[name]) for name in names}
    found = {name: values for name, values in denoised_by_name.items() if values is not None}
    return track.with_columns({**track.covariates, **found}) if found else None
