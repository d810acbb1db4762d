"""Drift of every device out of all calibrations at once: columns of the whole fleet, sorted by
device and time, averaged to points, and given to `trends`.

What is not of a device (nobody knows whose it is) or has no time is no part of it.

**Trends.** Drift and change points of devices' calibrations: a line in time, a line in temperature,
and steps, all fitted together; all devices at once, as one more axis of the arrays.

Every calibration has its own standard deviations; what calibrations scatter beyond them (places,
loads, the motion of the day) is told from one to the next, which steps and drift hardly touch. A
step is added where it lowers chi2 by more than chance does at any of the places it could be, the
largest first, until none does. A point alone between two steps is neither before nor after (it
holds an average over a step, or is an outlier): it is left out, and the fit made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri  # scipy.stats would take half of the time of a question

from ahrsd.fleet.row import AXES, finite
from ahrsd.samples import Array

# -- Trends and steps ------------------------------------------------------------------------------


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


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Calibrations of all devices, neighbours in time together: at most so many bins of a device.

    of_row (n,): the bin of each calibration; count: calibrations of each bin; start (D + 1,): the
    first bin of each device
    """

    of_row: _Rows
    count: _Rows
    start: _Rows

    @staticmethod
    def of(device: _Rows, order: _Rows, most: int = MOST_POINTS) -> Bins:
        """device (n,): its number, from 0; order (n,): rows by device, then by time."""
        number = np.bincount(device)
        first = np.cumsum(number) - number
        start = np.r_[0, np.cumsum(np.minimum(number, most))]
        own, n = device[order], number[device[order]]
        rank = np.arange(len(order)) - first[own]
        within = np.where(n <= most, rank, ((rank + 1) * most - 1) // n)
        of_row = np.empty_like(order)
        of_row[order] = start[own] + within
        return Bins(of_row, np.bincount(of_row), start)

    def sums(self, column: Array) -> Array:
        """Of a value of each calibration."""
        total: Array = np.bincount(self.of_row, column).astype(np.float64, copy=False)
        return total

    def means(self, columns: Sequence[Array]) -> Array:
        """(bins, k) of k values of each calibration."""
        return np.column_stack([self.sums(column) for column in columns]) / self.count[:, None]

    def known_means(self, column: Array) -> Array:
        """Of those that are known; nan where none is."""
        known = np.isfinite(column)
        number = self.sums(known.astype(np.float64))
        total = self.sums(np.where(known, column, 0.0))
        return np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0)

    def sigmas(self, columns: Sequence[Array]) -> Array:
        """(bins, k) of the means of values with these standard deviations."""
        squares = [self.sums(column * column) for column in columns]
        return np.sqrt(np.column_stack(squares)) / self.count[:, None]


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
        here = np.arange(max(length.max(), 2)) < length[:, None]
        day = _padded([one.day for one in every], here)
        values, sigmas = (
            np.stack([_padded(columns, here) for columns in zip(*split, strict=True)], axis=2)
            for split in ([one.values.T for one in every], [one.sigmas.T for one in every])
        )
        lines = _lines(day, _padded([one.temperature_c for one in every], here), length)
        scatter = _scatter(values, sigmas, lines[:, :, 2], length)
        variance = sigmas**2 + scatter[:, None, :] ** 2 + _TINY**2
        variance = np.where(here[:, :, None], variance, 0.0)
        scale = np.sqrt(variance.sum(axis=1) / length[:, None])
        weight = (variance / scale[:, None, :] ** 2).mean(axis=2)
        root = np.sqrt(np.divide(1.0, weight, out=np.zeros_like(weight), where=here))
        Y = np.where(here[:, :, None], values / scale[:, None, :], 0.0)
        return _Batch(length, np.where(here, day, 0.0), lines, root, Y, scale, scatter)

    def steps(self) -> tuple[_Rows, Array]:
        """Rows of the steps (D, steps) in order, N where there is none, and their gains of chi2."""
        D, N, k = self.Y.shape
        rows, gains = np.full((D, _MOST_STEPS), N), np.zeros((D, _MOST_STEPS))
        points = (self.root > 0.0).sum(axis=1)
        limit = chdtri(k, _CHANCE / np.maximum(points, 1))
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


def _padded(parts: Sequence[Array], here: NDArray[np.bool_]) -> Array:
    """(D, N): one beside the other, nan behind the last of each."""
    out = np.full(here.shape, np.nan)
    out[here] = np.concatenate(parts)
    return out


def _scatter(values: Array, sigmas: Array, degrees: Array, length: _Rows) -> Array:
    """(D, k) beyond the sigmas, from each point to the next; what follows the temperature is not.

    values, sigmas (D, N, k): nan behind the last
    """
    step, warmer = np.diff(values, axis=1), np.diff(degrees, axis=1)
    warmer = np.where(np.isnan(step[:, :, 0]), 0.0, warmer)
    power = (warmer**2).sum(axis=1)[:, None]
    common = np.einsum("dn,dnk->dk", warmer, np.nan_to_num(step))
    slope = np.divide(common, power, out=np.zeros_like(common), where=power > 0.0)
    step -= warmer[:, :, None] * slope[:, None, :]
    seen = (_MAD * _medians(np.abs(step), length - 1)) ** 2 / 2.0
    told = np.sqrt(np.maximum(seen - _medians(sigmas**2, length), 0.0))
    return np.where(length[:, None] < FEWEST, 0.0, told)


def _medians(values: Array, length: _Rows) -> Array:
    """(D, k) of the first `length` (D,) of values (D, N, k), which are nan behind them."""
    ordered = np.sort(values, axis=1)
    places = np.maximum(np.stack([(length - 1) // 2, length // 2], axis=1), 0)
    middle: Array = np.take_along_axis(ordered, places[:, :, None], 1).mean(axis=1)
    return middle


def _lines(day: Array, warm: Array, length: _Rows) -> Array:
    """(D, N, 3): constant, years, degrees, about their means; 0 where a series does not tell."""
    out = np.zeros((*day.shape, 3))
    out[:, :, 0] = ~np.isnan(day)
    years = (day - np.nansum(day, axis=1)[:, None] / length[:, None]) / 365.25
    out[:, :, 1] = np.where(length[:, None] > FEWEST, np.nan_to_num(years), 0.0)
    known = np.isfinite(warm)
    number = np.maximum(known.sum(axis=1), 1)
    warmer = np.where(known, warm, 0.0) - (np.where(known, warm, 0.0).sum(axis=1) / number)[:, None]
    warmer = np.where(known, warmer, 0.0)
    spread = np.sqrt((warmer**2).sum(axis=1) / number)
    tells = (length >= 2 * FEWEST) & (known.sum(axis=1) >= _KNOWN * length) & (spread > _SPREAD_C)
    out[:, :, 2] = np.where(tells[:, None], warmer, 0.0)
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


# -- Devices of a fleet ----------------------------------------------------------------------------


_HORIZONTAL = 0.5  # of the field, where it dips by 60 deg as in middle latitudes
_DAY_MS = 86400e3
_IRON, _BIAS = slice(0, 3), slice(3, 6)
_VALUES, _SIGMAS = (
    [
        f"{name}_{part}{axis}_{unit}"
        for name, unit in (("hard_iron", "gauss"), ("gyro_bias", "rad_s"))
        for axis in AXES
    ]
    for part in ("", "sigma_")
)
#: what `drifts` is given: a row for each calibration, in any order
CALIBRATIONS = f"""
    select device, vehicle, key, epoch_ms(recorded_utc) as at_ms,
           coalesce(recorded_by = 'the file''s date', false) as by_file_date,
           temperature_c, field_gauss, heading_sigma_deg, {", ".join([*_VALUES, *_SIGMAS])}
    from results where converged and recorded_utc is not null and device is not null"""


@dataclass(frozen=True, slots=True, eq=False)
class DeviceDrift:
    """Calibrations of one device over time and temperature.

    by_file_date: recordings of which only the file says when they were made
    heading_sigma_deg: of the newest calibration; heading_kept_deg: by how much headings would be
    off now with the first calibration, where the field dips by 60 deg
    iron, bias: drift and steps, gauss and rad/s; series: what they are fitted to
    """

    device: str
    vehicle: str | None
    recordings: int
    first_day: float
    last_day: float
    by_file_date: int
    heading_sigma_deg: float
    heading_kept_deg: float
    iron: Trend
    bias: Trend
    series: Series

    def json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "device": self.device,
            "vehicle": self.vehicle,
            "recordings": self.recordings,
            "first_utc": _date(self.first_day),
            "last_utc": _date(self.last_day),
            "by_file_date": self.by_file_date,
            "heading_sigma_deg": finite(self.heading_sigma_deg),
            "heading_kept_deg": finite(self.heading_kept_deg),
            "hard_iron": _trend_json(self.iron, "gauss"),
            "gyro_bias": _trend_json(self.bias, "rad_s"),
        }


def drifts(table: Any) -> list[DeviceDrift]:  # noqa: ANN401 - Arrow's
    """Every device with two calibrations or more; the largest heading error first."""
    if not table.num_rows:
        return []
    names, device = _numbered(table["device"])
    at_ms = table["at_ms"].to_numpy()
    order = _by_time(table["key"], device, at_ms)
    ends = np.cumsum(np.bincount(device))
    starts = ends - np.bincount(device)
    firsts, lasts = order[starts], order[ends - 1]
    bins = Bins.of(device, order)
    day = bins.means([at_ms / _DAY_MS])[:, 0]
    warm = bins.known_means(table["temperature_c"].to_numpy())
    values = bins.means([table[name].to_numpy() for name in _VALUES])
    sigmas = bins.sigmas([table[name].to_numpy() for name in _SIGMAS])
    several = np.flatnonzero(ends - starts > 1)
    points = [slice(bins.start[i], bins.start[i + 1]) for i in several]
    irons, biases = (
        trends([Series(day[p], warm[p], values[p, k], sigmas[p, k]) for p in points])
        for k in (_IRON, _BIAS)
    )
    vehicles = _vehicles(table["vehicle"], device, len(names))
    by_file = np.bincount(device, table["by_file_date"].to_numpy())
    field, sigma = (table[name].to_numpy() for name in ("field_gauss", "heading_sigma_deg"))
    found = []
    for i, p, iron, bias in zip(several, points, irons, biases, strict=True):
        moved = np.linalg.norm(values[p, _IRON][-1] - values[p, _IRON][0])
        first, last = firsts[i], lasts[i]
        found.append(
            DeviceDrift(
                device=names[i],
                vehicle=vehicles[i],
                recordings=int(ends[i] - starts[i]),
                first_day=float(at_ms[first] / _DAY_MS),
                last_day=float(at_ms[last] / _DAY_MS),
                by_file_date=int(by_file[i]),
                heading_sigma_deg=float(sigma[last]),
                heading_kept_deg=float(np.degrees(np.arctan2(moved, _HORIZONTAL * field[last]))),
                iron=iron,
                bias=bias,
                series=Series(day[p], warm[p], values[p], sigmas[p]),
            )
        )
    return sorted(found, key=lambda one: -np.nan_to_num(one.heading_kept_deg))


def _numbered(texts: Any) -> tuple[list[str], _Rows]:  # noqa: ANN401 - a column of Arrow
    """The different texts in order, and of each row the number of its own; -1 where it is null."""
    coded = texts.dictionary_encode().combine_chunks()
    found = coded.dictionary.to_pylist()
    names = sorted(found)
    place = {name: number for number, name in enumerate(names)}
    numbers = np.array([place[name] for name in found] + [-1])  # behind the last: where it is null
    return names, numbers[coded.indices.fill_null(len(found)).to_numpy()]


def _by_time(keys: Any, device: _Rows, at_ms: _Rows) -> _Rows:  # noqa: ANN401 - a column of Arrow
    """Rows by device, then time, then key."""
    since, span = at_ms - at_ms.min(), int(np.ptp(at_ms)) + 1
    if span * int(device.max() + 1) < 2**63:  # one number tells both: half of the time
        order = np.argsort(device * span + since)
    else:
        order = np.lexsort((at_ms, device))
    same = (np.diff(at_ms[order]) == 0) & (np.diff(device[order]) == 0)
    tied = np.flatnonzero(np.r_[same, False] | np.r_[False, same])  # keys are asked for these alone
    rows = order[tied]
    key = np.array(keys.take(rows).to_pylist(), dtype=np.str_)
    order[tied] = rows[np.lexsort((key, at_ms[rows], device[rows]))]
    return order


def _vehicles(texts: Any, device: _Rows, devices: int) -> list[str | None]:  # noqa: ANN401
    """The vehicle of each device; of several the last by name."""
    names, vehicle = _numbered(texts)
    last = np.full(devices, -1)
    np.maximum.at(last, device, vehicle)
    return [names[one] if one >= 0 else None for one in last]


def _date(day: float) -> str:
    return str(np.datetime64(round(day * 86400.0), "s"))


def _numbers(values: Array) -> list[float | None]:
    return [finite(value) for value in values]


def _trend_json(found: Trend, unit: str) -> dict[str, Any]:
    return {
        "days": found.days,
        f"per_year_{unit}": _numbers(found.per_year),
        f"per_year_sigma_{unit}": _numbers(found.per_year_sigma),
        f"per_degc_{unit}": _numbers(found.per_degree),
        f"per_degc_sigma_{unit}": _numbers(found.per_degree_sigma),
        f"scatter_{unit}": _numbers(found.scatter),
        "changes": [
            {
                "after_utc": _date(change.before_day),
                "until_utc": _date(change.after_day),
                f"size_{unit}": _numbers(change.size),
                f"sigma_{unit}": _numbers(change.sigma),
                "chi2": change.chi2,
            }
            for change in found.changes
        ],
    }
