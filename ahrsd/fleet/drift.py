"""Drift of every device out of all calibrations at once: columns of the whole fleet, sorted by
device and time, averaged to points, and given to `trend`.

What is not of a device (nobody knows whose it is) or has no time is no part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ahrsd.fleet.row import AXES, finite
from ahrsd.fleet.trend import Bins, Series, Trend, trends
from ahrsd.samples import Array

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
    from recordings where converged and recorded_utc is not null and device is not null"""

_Rows = NDArray[np.int64]


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
