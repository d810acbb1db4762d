"""Drift and change points of devices' calibrations: a line in time, a line in temperature, and
steps, all fitted together; all devices at once, as one more axis of the arrays.

Every calibration has its own standard deviations; what calibrations scatter beyond them (places,
loads, the motion of the day) is told from one to the next, which steps and drift hardly touch. A
step is added where it lowers chi2 by more than chance does at any of the places it could be, the
largest first, until none does. A point alone between two steps is neither before nor after (it
holds an average over a step, or is an outlier): it is left out, and the fit made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ahrsd.samples import Array

MOST_POINTS = 200  # of a device; more calibrations are averaged, neighbours in time with each other
FEWEST = 3  # points on either side of a step
_MOST_STEPS = 5
_CHANCE = 1e-3  # of a step in a series that has none
_SPREAD_C = 1.0  # standard deviation of temperature below which nothing can be said of it
_KNOWN = 0.8  # of the points, that have to have a temperature
_MAD = 1.4826
_TINY = 1e-12
_DEPENDENT = 1e-10  # eigenvalue of columns of length one, below which they depend on others
_ROUNDS = 4  # of fits without points that stood alone

_Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Calibrations of one device in the order of time.

    day (n,): days since 1970; temperature_c (n,): nan where unknown; values, sigmas (n, k)
    """

    day: Array
    temperature_c: Array
    values: Array
    sigmas: Array


@dataclass(frozen=True, slots=True, eq=False)
class StepChange:
    """A step: after day `before` and not later than day `after`; size, sigma (k,)."""

    before_day: float
    after_day: float
    size: Array
    sigma: Array
    chi2: float


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """per_year, per_degree (k,) with sigmas: nan where the series does not tell.

    scatter (k,): standard deviation of a point beside its own sigma; days: from first to last
    """

    points: int
    days: float
    per_year: Array
    per_year_sigma: Array
    per_degree: Array
    per_degree_sigma: Array
    scatter: Array
    changes: tuple[StepChange, ...]


def binned(series: Series, most: int = MOST_POINTS) -> Series:
    """At most so many points: means of neighbours in time; sigmas of the means."""
    n = len(series.day)
    if n <= most:
        return series
    starts = np.arange(most) * n // most
    count = np.diff([*starts, n])
    warm = np.isfinite(series.temperature_c)
    known = np.add.reduceat(warm.astype(float), starts)
    total = np.add.reduceat(np.where(warm, series.temperature_c, 0.0), starts)
    return Series(
        np.add.reduceat(series.day, starts) / count,
        np.divide(total, known, out=np.full(most, np.nan), where=known > 0),
        np.add.reduceat(series.values, starts) / count[:, None],
        np.sqrt(np.add.reduceat(series.sigmas**2, starts)) / count[:, None],
    )


def trends(every: Sequence[Series]) -> list[Trend]:
    """Drift, dependence on temperature, and steps of each device."""
    if not every:
        return []
    batch = _Batch.of(every)
    for _ in range(_ROUNDS):
        steps, gains = batch.steps()
        alone = (np.diff(steps, axis=1) == 1) & (steps[:, 1:] < batch.length[:, None])
        if not alone.any():
            break
        devices, order = np.nonzero(alone)
        batch.root[devices, steps[devices, order]] = 0.0
    beta, sigma = batch.fitted(steps)
    return [batch.trend(i, steps[i], gains[i], beta[i], sigma[i]) for i in range(len(every))]


@dataclass(slots=True, eq=False)
class _Batch:
    """D devices, N points at most, k values: length (D,); day (D, N); lines (D, N, 3): constant,
    years, degrees, 0 where a device does not tell; root (D, N): of the points' weights, 0 behind
    the last; Y (D, N, k): values over `scale` (D, k)."""

    length: _Rows
    day: Array
    lines: Array
    root: Array
    Y: Array
    scale: Array
    scatter: Array

    @staticmethod
    def of(every: Sequence[Series]) -> _Batch:
        """The series side by side."""
        length = np.array([len(one.day) for one in every])
        D, N, k = len(every), int(length.max()), every[0].values.shape[1]
        day, lines, root = np.zeros((D, N)), np.zeros((D, N, 3)), np.zeros((D, N))
        Y, scale, scatter = np.zeros((D, N, k)), np.ones((D, k)), np.zeros((D, k))
        for i, (one, n) in enumerate(zip(every, length, strict=True)):
            lines[i, :n] = _lines(one)
            scatter[i] = _scatter(one, lines[i, :n, 2])
            variance = one.sigmas**2 + scatter[i] ** 2 + _TINY**2
            scale[i] = np.sqrt(variance.mean(axis=0))
            root[i, :n] = np.sqrt(1.0 / (variance / scale[i] ** 2).mean(axis=1))
            day[i, :n], Y[i, :n] = one.day, one.values / scale[i]
        return _Batch(length, day, lines, root, Y, scale, scatter)

    def steps(self) -> tuple[_Rows, Array]:
        """Rows of the steps (D, steps) in order, N where there is none, and their gains of chi2."""
        D, N, k = self.Y.shape
        rows, gains = np.full((D, _MOST_STEPS), N), np.zeros((D, _MOST_STEPS))
        points = (self.root > 0.0).sum(axis=1)
        limit = chi2.isf(_CHANCE / np.maximum(points, 1), k)
        active = np.flatnonzero(points >= 2 * FEWEST)
        for number in range(_MOST_STEPS):
            row, gain = self._best(active, rows[active])
            better = gain > limit[active]
            active, row, gain = active[better], row[better], gain[better]
            if not len(active):
                break
            rows[active, number], gains[active, number] = row, gain
        order = np.argsort(rows, axis=1, kind="stable")
        return np.take_along_axis(rows, order, 1), np.take_along_axis(gains, order, 1)

    def _design(self, devices: _Rows, steps: _Rows) -> Array:
        behind = np.arange(self.Y.shape[1])[None, :, None] >= steps[:, None, :]
        columns = np.concatenate([self.lines[devices], behind], axis=2)
        weighted: Array = columns * self.root[devices][:, :, None]
        return weighted

    def _best(self, devices: _Rows, steps: _Rows) -> tuple[_Rows, Array]:
        """The row at which a step lowers chi2 most, and by how much; every row is tried at once."""
        root, k = self.root[devices], self.Y.shape[2]
        Q = _basis(self._design(devices, steps))
        Y = self.Y[devices] * root[:, :, None]
        left = Y - Q @ (Q.transpose(0, 2, 1) @ Y)
        terms = np.concatenate([left, Q, root[:, :, None]], axis=2) * root[:, :, None]
        sums = np.cumsum(terms[:, ::-1], axis=1)[:, ::-1]  # from each row to the last
        power = sums[:, :, -1] - (sums[:, :, k:-1] ** 2).sum(axis=2)
        behind = np.cumsum((root > 0.0)[:, ::-1], axis=1)[:, ::-1]
        told = power > 1e-6 * sums[:, :1, -1]
        told &= (behind >= FEWEST) & (behind[:, :1] - behind >= FEWEST)
        gain = np.divide(
            (sums[:, :, :k] ** 2).sum(axis=2), power, out=np.zeros_like(power), where=told
        )
        row = np.argmax(gain, axis=1)
        return row, np.take_along_axis(gain, row[:, None], 1)[:, 0]

    def fitted(self, steps: _Rows) -> tuple[Array, Array]:
        """Coefficients and their sigmas (D, columns, k), in the units of the values; sigma 0 for a
        column that is not there."""
        X = self._design(np.arange(len(self.Y)), steps)
        Y = self.Y * self.root[:, :, None]
        Xt = X.transpose(0, 2, 1)
        inverse = np.linalg.pinv(Xt @ X, rcond=1e-12, hermitian=True)
        beta = inverse @ (Xt @ Y)
        used = (np.abs(X) > 0.0).any(axis=1).sum(axis=1)
        free = np.maximum((self.root > 0.0).sum(axis=1) - used, 1)
        misfit = np.maximum(((Y - X @ beta) ** 2).sum(axis=1) / free[:, None], 1.0)
        own = np.diagonal(inverse, axis1=1, axis2=2)[:, :, None]
        scale = self.scale[:, None, :]
        return beta * scale, np.sqrt(np.maximum(own, 0.0) * misfit[:, None, :]) * scale

    def trend(self, i: int, steps: _Rows, gains: Array, beta: Array, sigma: Array) -> Trend:
        """The answer about one device."""
        slopes = [
            (beta[j], sigma[j])
            if self.lines[i, :, j].any()
            else (np.full_like(beta[j], np.nan),) * 2
            for j in (1, 2)
        ]
        changes = tuple(
            self._change(i, int(row), beta[3 + j], sigma[3 + j], float(gains[j]))
            for j, row in enumerate(steps)
            if row < self.length[i]
        )
        n = int(self.length[i])
        days = float(self.day[i, n - 1] - self.day[i, 0])
        return Trend(n, days, *slopes[0], *slopes[1], self.scatter[i], changes)

    def _change(self, i: int, row: int, size: Array, sigma: Array, gain: float) -> StepChange:
        used = np.flatnonzero(self.root[i] > 0.0)
        place = int(np.searchsorted(used, row))
        before, after = self.day[i, used[place - 1]], self.day[i, used[place]]
        return StepChange(float(before), float(after), size, sigma, gain)


def _scatter(series: Series, degrees: Array) -> Array:
    """(k,) beyond the sigmas, from each point to the next; what follows the temperature is not."""
    if len(series.day) < FEWEST:
        return np.zeros(series.values.shape[1])
    step, warmer = np.diff(series.values, axis=0), np.diff(degrees)
    if warmer.any():
        step -= np.outer(warmer, warmer @ step / (warmer @ warmer))
    seen: Array = (_MAD * np.median(np.abs(step), axis=0)) ** 2 / 2.0
    return np.sqrt(np.maximum(seen - np.median(series.sigmas**2, axis=0), 0.0))


def _lines(series: Series) -> Array:
    """(n, 3): constant, years, degrees, about their means; 0 where the series does not tell."""
    n, warm = len(series.day), series.temperature_c
    out = np.zeros((n, 3))
    out[:, 0] = 1.0
    if n > FEWEST:
        out[:, 1] = (series.day - series.day.mean()) / 365.25
    known = np.isfinite(warm)
    if n >= 2 * FEWEST and known.mean() >= _KNOWN and np.std(warm[known]) > _SPREAD_C:
        out[:, 2] = np.where(known, warm, warm[known].mean()) - warm[known].mean()
    return out


def _basis(X: Array) -> Array:
    """(D, N, p): orthonormal columns that span those of X, and 0 for what these depend on."""
    size = np.linalg.norm(X, axis=1, keepdims=True)
    unit = X / np.where(size > 0.0, size, 1.0)
    weight, turn = np.linalg.eigh(unit.transpose(0, 2, 1) @ unit)
    kept = weight > _DEPENDENT
    scale = np.where(kept, 1.0 / np.sqrt(np.where(kept, weight, 1.0)), 0.0)
    spanned: Array = unit @ (turn * scale[:, None, :])
    return spanned
