"""What a column says without the noise of its logger.

A speed, a depth or a temperature is often logged with a noise of its own, a few times a second,
and held or drawn straight between.  The noise is then in the regressor: what follows the column is
told too small, and the noise itself is left over as a source that nobody knows.  Where the noise
can be told from the course, the column is what it is expected to be, given what was logged
(`time_series.denoised`).

It can be told where the values' upper half of frequencies is flat and Gaussian, as what a sensor
adds is, and next to nothing of the course.  A throttle has steps, a gust is not flat: these are
left as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from ahrsd.diagnosis.time_series import SPECTRUM_ROWS, denoised
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

#: deviations of its own scatter by which the noise may depart from flat, and from Gaussian
SCATTER = 3.0
#: part of a column's power that its course has at least
COURSE = 0.8


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
    course = denoised(own[:, None])[:, 0]
    if np.var(course) < COURSE * np.var(own):
        return None
    return how.between(course, len(values))


def _is_noise(values: Array) -> bool:
    """Whether the upper half of the frequencies of (n,) values is flat and Gaussian."""
    cosines = fft.dct(values - values.mean(), norm="ortho")
    half, rest = len(cosines) // 2, len(cosines) * 3 // 4
    third, fourth = np.mean(cosines[half:rest] ** 2), np.mean(cosines[rest:] ** 2)
    # a mean of k squares of normal numbers scatters by sqrt(2 / k), a fourth moment by sqrt(24 / k)
    flat = abs(third - fourth) < SCATTER * np.sqrt(16.0 / len(values)) * fourth
    quick = fft.idct(np.where(np.arange(len(cosines)) < half, 0.0, cosines), norm="ortho")
    fourth_moment = np.mean(quick**4) / max(float(np.mean(quick**2) ** 2), 1e-300)
    gaussian = abs(fourth_moment - 3.0) < SCATTER * np.sqrt(24.0 / half)
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
