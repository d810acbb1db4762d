"""What a recording of another program holds: one stream per sensor, each with times of its own.

`merged` makes the rows of a table of them, one per magnetometer reading. The gyro and the force of
a row are the means over the step that ends there wherever they come faster than the magnetometer;
interpolating them would feign half a step of lag. Everything else is interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received
from ahrsd.printable import counted
from ahrsd.recording.column_names import ACCEL, GYRO, MAG, NO_MAP, TIME, UNITS, ColumnMap, Source
from ahrsd.recording.limits import TABLE_ROWS, refuse_beyond
from ahrsd.samples import Array

FEWEST = 20  # readings of a sensor
STILL = 0.1  # of another gyro's rates, below which the two did not make the same motion
_FASTER = 1.5  # times the magnetometer's rate, from which on means over its steps are taken
_FRESH = 0.67  # share of new readings below which the magnetometer is logged faster than it reads
#: units of a magnetometer with their factor to gauss, and what a vector's size may be in gauss
_MAG_UNITS = {"T": 1e4, "mT": 10.0, "gauss": 1.0, "mG": 1e-3, "uT": 1e-2, "nT": 1e-5}
_MAG_SIZES = ((0.2, 0.8), (0.05, 3.0))  # of the Earth's field; with much iron about it
_FASTEST_RAD_S = 20.0  # which nothing turns in the median
_LARGEST = 1e9  # what no sensor reads in any unit
_EARTH_M = 6371008.8
_SATELLITES_SINCE_S, _UNTIL_S = 9.5e8, 4.1e9  # 2000 to 2099: a receiver that knows the time
_SENSORS = {"mag": MAG, "gyro": GYRO, "accel": ACCEL}


@dataclass(frozen=True, slots=True, eq=False)
class SensorSeries:
    """time_s (N,), on the clock of all the recording's streams; values (N, k)."""

    time_s: Array
    values: Array

    @property
    def rate_hz(self) -> float:
        """By the median step; 0 where there is none."""
        step_s = float(np.median(np.diff(self.time_s))) if len(self.time_s) > 2 else 0.0
        return 1.0 / step_s if step_s > 0.0 else 0.0


@dataclass(slots=True)
class Sensors:
    """The sensors of a recording, in its own axes and units.

    units:  of mag, gyro and accel, as `--columns` writes them
    names:  what the recording calls each of them
    more:   covariates by the contract's names, each (N, 1); held: those that are not interpolated
    angles: those in degrees that wrap around
    facts:  for the metadata of a converted table: frame, clock, undone, ...
    """

    mag: SensorSeries | None = None
    gyro: SensorSeries | None = None
    accel: SensorSeries | None = None
    units: dict[str, str] = field(
        default_factory=lambda: {"mag": "gauss", "gyro": "rad/s", "accel": "m/s^2"}
    )
    names: dict[str, str] = field(default_factory=dict)
    more: dict[str, SensorSeries] = field(default_factory=dict)
    angles: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)


@dataclass(slots=True)
class RawBytes:
    """What the device sent, message by message, with the time at which the recorder had it."""

    received: list[Received]
    notes: list[str]
    facts: dict[str, str]


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user picks where a recording holds several.

    topics: names of messages to use; compass: number of the magnetometer, from 0; columns: units,
    signs and order of axes, each column being called as its short name: mag_y=-mag_y:G
    """

    topics: tuple[str, ...] = ()
    compass: int | None = None
    columns: ColumnMap = NO_MAP


NO_CHOICE = Choice()


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """Columns of a table by their canonical names, notes, and facts for its metadata."""

    columns: dict[str, Array]
    notes: list[str]
    facts: dict[str, str]


def merged(path: object, found: Sensors, columns: ColumnMap = NO_MAP) -> Merged:
    """One row per reading of the magnetometer.  Raises RecordingError naming what is missing."""
    notes, facts = list(found.notes), dict(found.facts)
    missing = [name for name, one in (("magnetometer", found.mag), ("gyro", found.gyro)) if not one]
    if found.mag is None or found.gyro is None:
        raise RecordingError(
            path,
            f"holds no {' and no '.join(missing)}",
            "`ahrsd convert FILE --list` says what it holds; record the magnetometer and the gyro",
        )
    rows = by_readings(path, found.mag, found.gyro, found, notes)
    out = {TIME: rows.time_s - rows.time_s[0]}
    for kind, values in rows.vectors.items():
        out |= _scaled(path, kind, values, found, columns, facts)
    out |= rows.more
    facts.setdefault("frame", "the sensor's own axes, as recorded")
    if (up := upward(out)) is not None:
        facts["frame"] += f"; {up}"
    facts["start"] = f"{rows.time_s[0]:.9f} s on that clock is 0 in time_s"
    return Merged(out, notes, facts)


@dataclass(frozen=True, slots=True, eq=False)
class ByReadings:
    """One row per reading of the magnetometer: time_s (N,), vectors (N, 3) by kind, more (N,)."""

    time_s: Array
    vectors: dict[str, Array]
    more: dict[str, Array]


def by_readings(
    path: object, mag: SensorSeries, gyro: SensorSeries, found: Sensors, notes: list[str]
) -> ByReadings:
    """The sensors of `found`, in its units, at the readings of its magnetometer.

    notes: what was done is added. Raises RecordingError.
    """
    mag = _tidy(path, mag, _called("magnetometer", found, "mag"), notes)
    gyro = _tidy(path, gyro, _called("gyro", found, "gyro"), notes)
    mag = _overlapping(path, _fresh(mag, notes), gyro)
    vectors = {"mag": mag.values, "gyro": _at_steps(mag.time_s, gyro, "gyro", notes)}
    if found.accel is not None and len(found.accel.time_s) >= FEWEST:
        accel = _tidy(path, found.accel, _called("accelerometer", found, "accel"), notes)
        vectors["accel"] = _at_steps(mag.time_s, accel, "accelerometer", notes)
    more = {
        name: values
        for name, stream in found.more.items()
        if (values := _covariate(mag.time_s, stream, name in found.angles)) is not None
    }
    return ByReadings(mag.time_s, vectors, more)


def positions(
    time_s: Array, lat_deg: Array, lon_deg: Array, height_m: Array
) -> dict[str, SensorSeries]:
    """Fixes as covariates: m north, east and down of the first one; none without a fix."""
    known = np.isfinite(lat_deg) & np.isfinite(lon_deg) & ((lat_deg != 0.0) | (lon_deg != 0.0))
    known &= (np.abs(lat_deg) <= 90.0) & (np.abs(lon_deg) <= 360.0)
    time_s, lat, lon, height = time_s[known], lat_deg[known], lon_deg[known], height_m[known]
    if len(time_s) < 2:
        return {}
    east = np.radians((lon - lon[0] + 180.0) % 360.0 - 180.0) * np.cos(np.radians(lat[0]))
    columns = {
        "position_north_m": np.radians(lat - lat[0]) * _EARTH_M,
        "position_east_m": east * _EARTH_M,
        "position_down_m": height[0] - height,
    }
    return {name: SensorSeries(time_s, values[:, None]) for name, values in columns.items()}


def recorded_utc(time_s: Array, unix_s: Array, first_s: float) -> dict[str, str]:
    """When a recording began, as a fact, by the satellites' time in some of its rows; nothing where
    no row has one.

    time_s, unix_s (N,): the same moments on the recording's clock and in s since 1970, nan where
    unknown; first_s: the first sample's time on the recording's clock
    """
    began = (unix_s - time_s + first_s)[(unix_s > _SATELLITES_SINCE_S) & (unix_s < _UNTIL_S)]
    if not len(began):
        return {}
    at = datetime.fromtimestamp(float(np.median(began)), UTC)
    return {"recorded_utc": at.isoformat(timespec="milliseconds")}


def _called(what: str, found: Sensors, key: str) -> str:
    name = found.names.get(key)
    return f"the {what} ({name})" if name else f"the {what}"


def _tidy(path: object, stream: SensorSeries, name: str, notes: list[str]) -> SensorSeries:
    """In order of time, finite, each time once."""
    refuse_beyond(path, len(stream.time_s), TABLE_ROWS, f"readings of {name}", "cut it in parts")
    known = np.isfinite(stream.time_s) & (np.abs(stream.values) < _LARGEST).all(axis=1)
    if count := int(np.count_nonzero(~known)):
        notes.append(
            f"left out of {name}: {counted(count, 'reading')} that no sensor gives (nan, or beyond)"
        )
    time_s, values = stream.time_s[known], stream.values[known]
    if np.any(np.diff(time_s) < 0.0):
        _refuse_clock_set_back(path, time_s, name)
        order = np.argsort(time_s, kind="stable")
        notes.append(f"{name}: its readings are out of order, sorted by time")
        time_s, values = time_s[order], values[order]
    new = np.concatenate([[True], np.diff(time_s) > 0.0])[: len(time_s)]
    if count := int(np.count_nonzero(~new)):
        if count > 0.5 * len(new):
            raise RecordingError(
                path, f"{name} has no time: {count} of {len(new)} readings share one with another",
                "record again with a clock",
            )  # fmt: skip
        notes.append(
            f"left out of {name}: {counted(count, 'reading')} with the time of the one before"
        )
    time_s, values = time_s[new], values[new]
    if len(time_s) < FEWEST:
        raise RecordingError(
            path,
            f"{name} has {counted(len(time_s), 'reading')}, {FEWEST} are needed",
            "record longer",
        )
    return SensorSeries(time_s, values)


def _refuse_clock_set_back(path: object, time_s: Array, name: str) -> None:
    """Readings that lie behind an earlier one for long are no late ones: the clock was set back.

    Sorted by time, readings of two times would be mixed.
    """
    newest = np.maximum.accumulate(time_s)
    edges = np.diff(np.concatenate([[False], time_s < newest, [False]]).astype(np.int8))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    longest = int(np.argmax(ends - begins))
    if ends[longest] - begins[longest] < FEWEST:
        return
    at = int(begins[longest])
    raise RecordingError(
        path,
        f"{name}: its time goes back by {newest[at] - time_s[at]:.4g} s after "
        f"{counted(at, 'reading')}: the clock was set, or the recording repeats itself",
        "cut it in parts there",
    )


def _fresh(mag: SensorSeries, notes: list[str]) -> SensorSeries:
    """A magnetometer that is logged faster than it reads repeats itself: the first of each."""
    fresh = np.concatenate([[True], (np.diff(mag.values, axis=0) != 0.0).any(axis=1)])
    count = int(np.count_nonzero(fresh))
    if count >= _FRESH * len(fresh) or count < FEWEST:
        return mag
    notes.append(
        f"{len(fresh) - count} of {len(fresh)} magnetometer readings repeat the one before: "
        "left out, it is logged faster than it reads"
    )
    return SensorSeries(mag.time_s[fresh], mag.values[fresh])


def _overlapping(path: object, mag: SensorSeries, gyro: SensorSeries) -> SensorSeries:
    slack_s = 1.0 / gyro.rate_hz if gyro.rate_hz else 0.0
    inside = (mag.time_s >= gyro.time_s[0] - slack_s) & (mag.time_s <= gyro.time_s[-1] + slack_s)
    if np.count_nonzero(inside) < FEWEST:
        raise RecordingError(
            path,
            f"magnetometer ({mag.time_s[0]:.3f} to {mag.time_s[-1]:.3f} s) and gyro "
            f"({gyro.time_s[0]:.3f} to {gyro.time_s[-1]:.3f} s) hardly overlap",
            "their clocks differ: record both with one clock",
        )
    return SensorSeries(mag.time_s[inside], mag.values[inside])


def _at_steps(time_s: Array, source: SensorSeries, name: str, notes: list[str]) -> Array:
    """(N, k) values for the rows: as they are, means over the steps, or interpolated."""
    if len(source.time_s) >= len(time_s):
        at = np.minimum(np.searchsorted(source.time_s, time_s), len(source.time_s) - 1)
        if np.array_equal(source.time_s[at], time_s) and len(source.time_s) < _FASTER * len(time_s):
            return source.values[at]
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    if source.rate_hz > _FASTER * rate_hz:
        notes.append(
            f"the {name} comes at {source.rate_hz:.4g} Hz, the magnetometer at {rate_hz:.4g} Hz: "
            "means over its steps"
        )
        return step_means(time_s, source)
    if source.rate_hz * _FASTER < rate_hz:
        notes.append(
            f"the {name} comes at {source.rate_hz:.4g} Hz, slower than the magnetometer at "
            f"{rate_hz:.4g} Hz: interpolated"
        )
    return np.column_stack([np.interp(time_s, source.time_s, column) for column in source.values.T])


def step_means(time_s: Array, source: SensorSeries) -> Array:
    """(N, k) mean of a faster stream over each step (time_s[k-1], time_s[k]], by its integral."""
    t_s, values = source.time_s, source.values
    slices = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    area = np.vstack([np.zeros(values.shape[1]), np.cumsum(slices, axis=0)])
    # within a slice the integral of a straight line is a parabola
    at = np.clip(np.searchsorted(t_s, time_s, side="right") - 1, 0, len(t_s) - 2)
    width = (t_s[at + 1] - t_s[at])[:, None]
    part = np.clip((time_s - t_s[at])[:, None], 0.0, width)
    slope = (values[at + 1] - values[at]) / width
    integral = area[at] + part * (values[at] + 0.5 * slope * part)
    first = np.array([[np.interp(time_s[0], t_s, column) for column in values.T]])
    return np.vstack([first, np.diff(integral, axis=0) / np.diff(time_s)[:, None]])


def _covariate(time_s: Array, stream: SensorSeries, angle: bool) -> Array | None:
    known = np.isfinite(stream.time_s) & np.isfinite(stream.values[:, 0])
    t_s, values = stream.time_s[known], stream.values[known, 0]
    order = np.argsort(t_s, kind="stable")
    t_s, values = t_s[order], values[order]
    if len(t_s) < 2:
        return None
    if angle:
        turned: Array = np.interp(time_s, t_s, np.degrees(np.unwrap(np.radians(values))))
        return (turned + 180.0) % 360.0 - 180.0
    held: Array = np.interp(time_s, t_s, values)
    return held


def _scaled(
    path: object, kind: str, values: Array, found: Sensors, given: ColumnMap, facts: dict[str, str]
) -> dict[str, Array]:
    """Columns in our units: in the unit of the format unless the user says another."""
    unit = found.units[kind]
    factor = _MAG_UNITS[unit] if kind == "mag" else UNITS[kind][unit]
    own = {f"{kind}_{axis}": column for axis, column in zip("xyz", values.T, strict=True)}
    out: dict[str, Array] = {}
    said: list[str] = []
    for name, short in zip(_SENSORS[kind], own, strict=True):
        source = given.sources.get(name)
        if source is None:
            out[name] = factor * own[short]
            continue
        out[name] = _given(path, name, source, own)
        said.append(f"{short} = {source.factor:g} x {source.column.lstrip('-')}")
    if not said:
        _check_unit(path, kind, values, unit, found)
    facts[f"{kind} source"] = found.names.get(kind, kind)
    facts[f"{kind} unit"] = f"by --columns: {', '.join(said)}" if said else f"{unit} in the file"
    return out


def _given(path: object, name: str, source: Source, own: Mapping[str, Array]) -> Array:
    column = source.column.removeprefix("-")
    sign = -1.0 if source.column.startswith("-") else 1.0
    if column not in own:
        raise RecordingError(
            path, f"has no column {column} (--columns, for {name})",
            f"such a recording has {', '.join(own)} for it",
        )  # fmt: skip
    return sign * source.factor * own[column]


def _check_unit(path: object, kind: str, values: Array, unit: str, found: Sensors) -> None:
    size = float(np.median(np.linalg.norm(values, axis=1)))
    name = found.names.get(kind, kind)
    if kind == "gyro" and size > _FASTEST_RAD_S and unit == "rad/s":
        raise RecordingError(
            path, f"{name}: the gyro turns by {size:.4g} rad/s in the median, it looks like deg/s",
            _option("gyro", "deg/s"),
        )  # fmt: skip
    if kind != "mag" or _MAG_SIZES[1][0] <= size * _MAG_UNITS[unit] <= 10.0:
        return
    looks = next(
        (
            other
            for low, high in _MAG_SIZES
            for other, factor in _MAG_UNITS.items()
            if low <= size * factor <= high
        ),
        None,
    )
    if size == 0.0:
        raise RecordingError(
            path, f"{name} reads 0 throughout: it is dead, or was not logged", "take another one"
        )
    words = f"it looks like {looks}" if looks else "it is another unit or a dead sensor"
    raise RecordingError(
        path, f"{name}: the median field is {size:.4g} {unit}, {words}",
        _option("mag", looks or "UNIT"),
    )  # fmt: skip


def _option(kind: str, unit: str) -> str:
    pairs = ",".join(f"{kind}_{axis}={kind}_{axis}:{unit}" for axis in "xyz")
    return f"say so: --columns {pairs}"


def upward(columns: Mapping[str, Array]) -> str | None:
    """Which axis points up by gravity, where one does in the mean."""
    if ACCEL[0] not in columns:
        return None
    mean = np.array([np.mean(columns[name]) for name in ACCEL])
    size = float(np.median(np.linalg.norm(np.column_stack([columns[n] for n in ACCEL]), axis=1)))
    axis = int(np.argmax(np.abs(mean)))
    if not 5.0 < size < 15.0 or abs(mean[axis]) < 0.8 * size:
        return None
    return f"by gravity its {'xyz'[axis]} points {'up' if mean[axis] > 0.0 else 'down'}"
