"""Tables of samples: CSV (plain or gzipped) and Parquet, written, and checked where they are read.

Columns: time_s, mag_{x,y,z}_gauss, gyro_{x,y,z}_rad_s, optional accel_{x,y,z}_m_s2 (specific
force); every other numeric column is a covariate and keeps its name, text columns are left out.
`column_names` says which other names and units are understood, `text_table` which texts.

A gap is a step longer than 1.6 times the 95th percentile of all steps. Host-stamped streams
alternate between two step lengths, one up to 1.7 times the other, so the median will not do; on
the real recordings this finds exactly the samples that the damaged sentences cost. The step
behind a gap is unknown (`dt_s` nan) and a block never spans one. Stamps that a host gave to bunches
of samples are put on the regular clock behind them (`clock_fit`); where the host's clock was set,
there is a gap.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.errors import RecordingError
from ahrsd.printable import counted, printable
from ahrsd.recording.clock_fit import (
    clock_jumps,
    is_bunched,
    regular_clock,
    ties_spread,
    unwrapped,
)
from ahrsd.recording.column_names import (
    ACCEL,
    GRAVITY_M_S2,
    GYRO,
    MAG,
    NO_MAP,
    RANGES,
    REQUIRED,
    TIME,
    ColumnError,
    ColumnMap,
    Resolved,
    Source,
    other_unit,
    resolve,
)
from ahrsd.recording.foreign.sensors import Sensors, SensorSeries, by_readings, upward
from ahrsd.recording.limits import (
    SPAN_S,
    TABLE_BYTES,
    TABLE_CELLS,
    TABLE_COLUMNS,
    TABLE_ROWS,
    refuse_beyond,
)
from ahrsd.samples import Array, SampleBlock, in_periods, known_force
from ahrsd.stream.alternating_sensors import describe_alternation

PARQUET = b"PAR1"  # how such a file begins
NOTES_KEY = "ahrsd.notes"  # in the metadata of a converted table
BLOCK_ROWS = 1024
MINIMUM_ROWS = 20
GAP_FACTOR = 1.6
GAP_PERCENTILE = 95.0


_STEP_S = (1e-4, 2.0)  # 10 kHz ... 0.5 Hz: other units of time end outside
_TIME_UNITS = (
    ("d", 86400.0),
    ("h", 3600.0),
    ("min", 60.0),
    ("ms", 1e-3),
    ("us", 1e-6),
    ("ns", 1e-9),
)
_USUAL_STEP_S = (1e-3, 0.5)  # 2 Hz to 1 kHz, by which another unit is told
_ACCEL_UNITS = (("g", GRAVITY_M_S2), ("mg", 1e-3 * GRAVITY_M_S2))
_GRAVITY = (0.7, 1.4)  # times gravity, between which a median force is taken for it
#: a date in any order of its numbers, if there is one, and a time of a day
_TIME_TEXT = re.compile(
    r"(?:(?P<a>\d{1,4})(?P<date_mark>[-/.]?)(?P<b>\d{1,2})(?P=date_mark)(?P<c>\d{1,4})[T _,]+)?"
    r"(?P<hour>\d{1,2}):?(?P<minute>\d\d):?(?P<second>\d\d)(?:[.,:](?P<fraction>\d+))?"
    r" ?(?:(?P<half>[AaPp])\.?[Mm]\.?)?(?P<zone> ?(?:[Zz]|UTC|[+-]\d\d(?::?\d\d)?))?"
)
_Date = tuple[str, str, str]  # its three numbers as they are written
_NO_DATE: _Date = ("", "", "")
_YEAR, _MONTHS = 4, 12  # digits of a year; a number above is a day
_LONGEST_PAUSE_S = 86400.0  # a longer one, and a step back, is a clock that was set
_SPARSE_SHARE = 0.3  # of the rows without a field: a slower magnetometer, not a fault
_NOTES = 30  # that are repeated of a converted table
_FEWEST_TIMES, _ROWS_A_TIME = 5, 100  # fewer times for more rows each are no stamps
_SENSORS_LOOK, _MOST_SENSORS = 1000, 8  # rows that are asked for sensors that take turns
_TAKE_TURNS, _APART = 0.75, 5.0  # share of rows of the same one behind another; times their step
_IMPOSSIBLE_SHARE = 0.01  # of the rows
_FEWEST_HOLDS, _EVENLY = 20, 0.8  # readings, and share of them held equally long, to be a hold
_TOGETHER = 0.98  # share of rows in which magnetometer and gyro are new together
_HOLE_S = 10.0  # without acceleration, over which the gyro carries it from both sides
_HOLES_SHARE = 0.2  # of the rows, which are left out where the holes are longer


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A checked table: SampleBlock's fields for all rows at once, and where the gaps are.

    starts: row numbers (0-based) of the first row and of each row behind a gap
    notes:  what a person should know and what does not stop a calibration
    """

    rows: SampleBlock
    starts: tuple[int, ...]
    notes: tuple[str, ...]

    def blocks(self, block_rows: int = BLOCK_ROWS) -> Iterator[SampleBlock]:
        """Blocks of at most `block_rows` rows, none of which spans a gap."""
        ends = (*self.starts[1:], len(self.rows))
        for start, end in zip(self.starts, ends, strict=True):
            for row in range(start, end, block_rows):
                yield self._cut(slice(row, min(row + block_rows, end)), row == start)

    def _cut(self, rows: slice, gap_before: bool) -> SampleBlock:
        whole = self.rows
        return SampleBlock(
            time_s=whole.time_s[rows],
            dt_s=whole.dt_s[rows],
            host_s=whole.host_s[rows],
            raw_b_gauss=whole.raw_b_gauss[rows],
            gyro_b_rad_s=whole.gyro_b_rad_s[rows],
            accel_b_m_s2=whole.accel_b_m_s2[rows],
            covariates={name: column[rows] for name, column in whole.covariates.items()},
            gap_before=gap_before,
        )


def read_table(path: Path, *, check_units: bool = True, columns: ColumnMap = NO_MAP) -> Table:
    """Read and check a table.  Raises RecordingError naming the row, the column and a remedy.

    check_units: refuse magnitudes that look like another unit; columns: what the user says of them
    """
    try:
        return _read(path, check_units, columns)
    except MemoryError as error:
        raise RecordingError(
            path, "does not fit into this computer's memory", "cut it in parts"
        ) from error


def _read(path: Path, check_units: bool, given: ColumnMap) -> Table:
    if _is_parquet(path):
        table, first_row = _read_parquet(path, given), 1
        notes = _noted(table)
    else:
        from ahrsd.recording.text_table import read_text_table

        text = read_text_table(path)
        table, first_row, notes = text.table, text.first_row, list(text.notes)
    found = _resolved(path, table.column_names, given)
    table = _of_different_names(table, notes)
    _check_length(path, table.num_rows)
    refuse_beyond(path, table.num_rows, TABLE_ROWS, "rows", "cut it in parts")
    values = {
        name: _numbers(path, table, name, found.sources[name], first_row) for name in REQUIRED
    }
    covariates, text_names = _covariates(table, found)
    notes += [*found.notes, *(f"column {name} is text and was left out" for name in text_names)]
    numbers = np.arange(len(table)) + first_row
    words = {name: _few_words(table[found.covariates[name]]) for name in text_names}
    rows = _TableRows(path, values, covariates, numbers, notes, sources=found.sources)
    rows.words = {name: few for name, few in words.items() if few is not None}
    rows.refuse_missing()
    return _checked(rows, check_units)


def starts_a_table(start: bytes) -> bool:
    """Whether the first bytes of a file are those of a table of text, whatever it is called."""
    from ahrsd.recording.text_table import is_table_text

    return is_table_text(start)


def table_of(path: Path, columns: dict[str, Array], notes: list[str]) -> Table:
    """The same checks for columns, by canonical names, that another reader made of a file."""
    _check_length(path, len(columns[TIME]))
    refuse_beyond(path, len(columns[TIME]), TABLE_ROWS, "rows", "cut it in parts")
    cells = len(columns) * len(columns[TIME])
    refuse_beyond(path, cells, TABLE_CELLS, "numbers", "cut it in parts")
    values = {name: columns[name] for name in REQUIRED}
    covariates = {name: column for name, column in columns.items() if name not in REQUIRED}
    rows = _TableRows(path, values, covariates, np.arange(len(columns[TIME])) + 1, list(notes))
    return _checked(rows, True)


def _checked(columns: _TableRows, check_units: bool) -> Table:
    path = columns.path
    columns.drop_zero_fields()
    if columns.hold_one_sensor_each():
        columns.join_sensors()
    columns.hold_readings()
    columns.draw_rates()
    columns.drop_doubles()
    columns.undo_repeats()
    columns.refuse_several_sensors()
    columns.drop_impossible()
    columns.note_alternating_sensors()
    columns.set_clock()
    if check_units:
        for limits in RANGES:
            size = float(np.median(np.linalg.norm(columns.vectors(limits.columns), axis=1)))
            if wrong := other_unit(size, limits, columns.sources):
                raise RecordingError(path, *wrong)
    accel = columns.acceleration()
    _check_length(path, len(accel))
    columns.note_upward_axes(accel)
    return columns.table(accel)


@dataclass(slots=True)
class _TableRows:
    """A table's columns on their way to samples: what is dropped here is dropped in all of them.

    numbers (N,): of the rows in the file; sources: the file's columns by canonical name; words:
    text columns of few different words
    """

    path: Path
    values: dict[str, Array]
    covariates: dict[str, Array]
    numbers: NDArray[np.intp]
    notes: list[str]
    starts: tuple[int, ...] = ()
    sources: Mapping[str, Source] = field(default_factory=dict)
    words: dict[str, _FewWords] = field(default_factory=dict)

    def vectors(self, names: tuple[str, str, str]) -> Array:
        """(N, 3) of three columns."""
        return np.column_stack([self.values[name] for name in names])

    def _keep(self, rows: NDArray[np.bool]) -> None:
        self.values = {name: values[rows] for name, values in self.values.items()}
        self.covariates = {name: values[rows] for name, values in self.covariates.items()}
        self.words = {name: few.rows(rows) for name, few in self.words.items()}
        self.numbers = self.numbers[rows]

    def drop_zero_fields(self) -> None:
        """A field of exactly 0 on all axes is none: a reading that failed, or has not come yet.

        Where they come evenly they are the rows between the readings of a slower magnetometer.
        """
        none: NDArray[np.bool] = np.asarray((self.vectors(MAG) == 0.0).all(axis=1))
        count = int(np.count_nonzero(none))
        if count in (0, len(none)):
            return
        if _hold_of(~none) is not None:
            self.values |= {name: np.where(none, np.nan, self.values[name]) for name in MAG}
            return
        self.notes.append(
            f"left out because the magnetometer reads 0 0 0, which is no field: "
            f"{counted(count, 'row')}, first row {self.numbers[np.argmax(none)]}"
        )
        self._keep(~none)
        _check_length(self.path, len(self.numbers))

    def hold_one_sensor_each(self) -> bool:
        """Whether rows with a field and no rates, and such with rates and no field, are usual."""
        mag, gyro = (np.isfinite(self.vectors(names)).all(axis=1) for names in (MAG, GYRO))
        alone = ((mag & ~gyro, mag), (gyro & ~mag, gyro))
        return all(
            0 < _SPARSE_SHARE * np.count_nonzero(all_of) <= np.count_nonzero(without_other)
            for without_other, all_of in alone
        )

    def refuse_missing(self) -> None:
        """Raise RecordingError at the first cell of a needed column that is no number."""
        one_each = self.hold_one_sensor_each()
        for name, values in self.values.items():
            wrong = np.flatnonzero(~np.isfinite(values))
            slower = one_each or _SPARSE_SHARE * len(values) <= len(wrong) < len(values)
            if len(wrong) and (name == TIME or not slower):
                column = self.sources.get(name, Source(name)).column
                raise RecordingError(
                    self.path,
                    f"row {self.numbers[wrong[0]]}, column {printable(column)}: empty, nan or "
                    f"infinite ({counted(len(wrong), 'row')} in all)",
                    "leave such rows out; a missing row is a gap, which is understood",
                )

    def join_sensors(self) -> None:
        """Rows of one sensor each become one row per reading of the magnetometer."""
        series = {"mag": self._series(self.vectors(MAG)), "gyro": self._series(self.vectors(GYRO))}
        if all(name in self.covariates for name in ACCEL):
            force = np.column_stack([self.covariates[name] for name in ACCEL])
            series["accel"] = self._series(force)
        more = {
            name: self._series(values[:, None])
            for name, values in self.covariates.items()
            if name not in ACCEL
        }
        rows: NDArray[np.bool] = np.asarray(np.isfinite(self.vectors(MAG)).all(axis=1))
        order = np.argsort(self.values[TIME][rows], kind="stable")
        stamps_s, numbers = series["mag"].time_s[order], self.numbers[rows][order]
        self.notes.append(
            f"each row holds one sensor: {np.count_nonzero(rows)} of {len(rows)} the "
            f"magnetometer, {len(series['gyro'].time_s)} the gyro; one row per reading of the "
            "magnetometer is used"
        )
        angles = frozenset(name for name in more if name.endswith("_deg"))
        found = Sensors(accel=series.get("accel"), more=more, angles=angles)
        joined = by_readings(self.path, series["mag"], series["gyro"], found, self.notes)
        self.values = {TIME: joined.time_s}
        self.covariates = dict(joined.more)
        for kind, names in (("mag", MAG), ("gyro", GYRO), ("accel", ACCEL)):
            if kind in joined.vectors:
                into = self.covariates if kind == "accel" else self.values
                into |= dict(zip(names, joined.vectors[kind].T, strict=True))
        self.numbers = numbers[np.searchsorted(stamps_s, joined.time_s)]
        self.words = {}

    def _series(self, values: Array) -> SensorSeries:
        """Readings (N, k) of one sensor, in the rows that have one, on a clock that counts on."""
        rows = np.isfinite(values).all(axis=1)
        return SensorSeries(unwrapped(self.values[TIME][rows])[0], values[rows])

    def hold_readings(self) -> None:
        """Rows between the readings of a slower magnetometer repeat the last one."""
        known: NDArray[np.bool] = np.asarray(np.isfinite(self.vectors(MAG)).all(axis=1))
        if known.all():
            return
        count = int(np.count_nonzero(known))
        _check_length(self.path, count)
        self.notes.append(
            f"the magnetometer has a reading in {count} of {len(known)} rows: the rows between "
            "repeat the last one"
        )
        rows = np.arange(len(known))
        last = np.maximum.accumulate(np.where(known, rows, 0))
        self.values |= {name: self.values[name][last] for name in MAG}
        self._keep(rows >= np.argmax(known))

    def draw_rates(self) -> None:
        """Rates of a slower gyro, whose cells are empty in between, are drawn straight."""
        known: NDArray[np.bool] = np.asarray(np.isfinite(self.vectors(GYRO)).all(axis=1))
        if known.all():
            return
        count = int(np.count_nonzero(known))
        _check_length(self.path, count)
        self.notes.append(
            f"the gyro has a reading in {count} of {len(known)} rows: between them its rates are "
            "interpolated linearly"
        )
        self._draw(np.flatnonzero(known))

    def undo_repeats(self) -> None:
        """What a recorder wrote again and again until the next reading came, time after time.

        Whole rows count once; rates of a gyro alone are drawn straight between its readings. A
        magnetometer's are left: which of them are new is for those who use them.
        """
        gyro = _fresh(self.vectors(GYRO))
        usual = _hold_of(gyro)
        if usual is None:
            return
        if np.mean(gyro == _fresh(np.hstack([self.vectors(MAG), self.vectors(GYRO)]))) > _TOGETHER:
            self.notes.append(
                f"every reading is repeated in {counted(usual, 'row')}: each is used once, "
                f"{int(np.count_nonzero(gyro))} of {len(gyro)} rows"
            )
            self._keep(gyro)
            _check_length(self.path, len(self.numbers))
            return
        self.notes.append(
            f"the gyro has a new reading only every {usual} rows: between them its rates are "
            "interpolated linearly"
        )
        self._draw(np.flatnonzero(gyro))

    def _draw(self, rows: NDArray[np.intp]) -> None:
        """Rates between those of these rows, and no row outside of them."""
        place = np.arange(rows[0], rows[-1] + 1)
        drawn = {name: np.interp(place, rows, self.values[name][rows]) for name in GYRO}
        kept = np.zeros(len(self.numbers), dtype=bool)
        kept[place] = True
        self._keep(kept)
        self.values |= drawn

    def drop_doubles(self) -> None:
        """Rows that have the same time and readings as the row before."""
        doubles = _doubles(list(self.values.values()))
        if doubles.any():
            count = counted(int(np.count_nonzero(doubles)), "row")
            first = self.numbers[np.flatnonzero(doubles)[0]]
            self.notes.append(f"left out as repeated, time and all: {count}, first row {first}")
            self._keep(~doubles)
            _check_length(self.path, len(self.numbers))

    def refuse_several_sensors(self) -> None:
        """Rows of several sensors that take turns, told apart by a column of few words or numbers.

        What they read differs between them, and hardly from one row of a sensor to its next.
        """
        rows = self.vectors(MAG)
        columns = {name: few.of_row for name, few in self.words.items()} | self.covariates
        for name, column in columns.items():
            head = column[:_SENSORS_LOOK]
            kinds = np.unique(head[np.isfinite(head)])
            if not 2 <= len(kinds) <= _MOST_SENSORS or not np.all(kinds == np.rint(kinds)):
                continue
            same = column[1:] == column[:-1]
            if np.mean(same) > _TAKE_TURNS:
                continue
            across = np.median(np.linalg.norm(np.diff(rows, axis=0)[~same], axis=1))
            own = [np.diff(rows[column == kind], axis=0) for kind in kinds]
            within = np.median(np.linalg.norm(np.vstack(own), axis=1))
            if across > _APART * within:
                few = self.words.get(name)
                shown = [f"{kind:g}" if few is None else few.names[int(kind)] for kind in kinds]
                raise RecordingError(
                    self.path,
                    f"holds the rows of {len(kinds)} sensors in turn, by its column "
                    f"{printable(name)} ({', '.join(map(printable, shown))})",
                    "keep the rows of one of them",
                )

    def note_alternating_sensors(self) -> None:
        """A note on a field that is the same again after a few rows, and another one in between.

        Without a column that tells the sensors apart it may be one sensor near a current, too.
        """
        rows = self.vectors(MAG)
        if len(rows) < MINIMUM_ROWS:
            return
        if words := describe_alternation(rows):
            self.notes.append(words)

    def drop_impossible(self) -> None:
        """Rows with a reading that no such sensor can have among good ones: marks, damaged cells.

        They are left out and make a gap, as rows do that are not there.
        """
        wrong = np.zeros(len(self.numbers), dtype=bool)
        for limits in RANGES:
            sizes = np.max(np.abs(self.vectors(limits.columns)), axis=1)
            if np.median(sizes) <= limits.maximum:  # else all of it is in another unit
                wrong |= sizes > limits.impossible
        count = int(np.count_nonzero(wrong))
        if not 0 < count <= _IMPOSSIBLE_SHARE * len(wrong):
            return
        row = int(np.argmax(wrong))
        values = [
            f"{printable(name)} {self.values[name][row]:g}"
            for limits in RANGES
            for name in limits.columns
            if abs(self.values[name][row]) > limits.impossible
        ]
        self.notes.append(
            f"left out because of an impossible reading: {counted(count, 'row')}, first row "
            f"{self.numbers[row]} ({values[0]})"
        )
        self._keep(~wrong)
        _check_length(self.path, len(self.numbers))

    def set_clock(self) -> None:
        """Clocks that were set, stamps of bunches; refuses a time that is none."""
        self._refuse_few_times()
        counted_on, again, period = unwrapped(self.values[TIME])
        if len(again):
            more = f" and {counted(len(again) - 1, 'more time')}" if len(again) > 1 else ""
            self.notes.append(
                f"the time began again after {period} at row {self.numbers[again[0]]}{more}: "
                "counted on"
            )
        self.values[TIME] = counted_on
        time_s, jumps = clock_jumps(counted_on, _LONGEST_PAUSE_S)
        if len(jumps):
            self._refuse_repeated(jumps)
            row = jumps[0]
            a, b = counted_on[row - 1], counted_on[row]
            times = "once, " if len(jumps) == 1 else f"{len(jumps)} times, first "
            self.notes.append(
                f"the clock was set {times}at row {self.numbers[row]} "
                f"({_plain(a)} to {_plain(b)} s): a gap of unknown length, and later times count on"
            )
        if not np.any(np.diff(time_s) < 0.0) and is_bunched(time_s):
            time_s = self._evened(time_s)
        if ties := int(np.count_nonzero(np.diff(time_s) == 0.0)):
            spread = ties_spread(time_s)
            if spread is not None:
                self.notes.append(
                    f"time moved on after a row of the same time: {counted(ties, 'row')}"
                )
                time_s = spread
        _check_time(self.path, time_s, self.numbers)
        refuse_beyond(
            self.path, time_s[-1] - time_s[0], SPAN_S, "s from its first to its last row",
            "cut it in parts",
        )  # fmt: skip
        self.starts = tuple(sorted({*self.starts, *jumps.tolist()}))
        self.values[TIME] = time_s

    def _refuse_few_times(self) -> None:
        """A time whose digits were lost on the way into the file is no host's stamp."""
        times = np.unique(self.values[TIME])
        if len(times) >= _FEWEST_TIMES or len(self.numbers) < _ROWS_A_TIME * len(times):
            return
        shown = ", ".join(f"{value:.10g}" for value in times[:3])
        raise RecordingError(
            self.path,
            f"column time_s: {counted(len(times), 'different time')} in "
            f"{counted(len(self.numbers), 'row')} ({shown}): the digits that tell the rows apart "
            "were lost when it was written",
            "write the time again with all its digits, or from 0 on",
        )

    def _refuse_repeated(self, jumps: NDArray[np.intp]) -> None:
        """Time goes back where a file was appended to itself, too: the same rows count once."""
        rows = np.column_stack([self.values[name] for name in REQUIRED])
        row = int(jumps[0])
        back = rows[row, 0] < rows[row - 1, 0]
        same = np.flatnonzero((rows[:row] == rows[row]).all(axis=1))
        if back and len(same):
            raise RecordingError(
                self.path,
                f"row {self.numbers[row]} and those behind it repeat row {self.numbers[same[0]]}",
                "the same rows are in the file twice: leave one copy out",
            )

    def _evened(self, time_s: Array) -> Array:
        fitted = regular_clock(time_s)
        if fitted is None:
            return time_s
        self.starts = fitted.starts
        scatter_ms = float(f"{1e3 * fitted.scatter_s:.2g}")
        self.notes.append(
            f"the time stamps are a host's, they scatter by {scatter_ms:g} ms about a "
            f"regular clock of {1.0 / fitted.step_s:.4g} Hz: its times are used"
        )
        return fitted.time_s

    def acceleration(self) -> Array:
        """(N, 3) m/s^2, nan unless all three axes are there; short holes filled."""
        found = {name: self.covariates.pop(name) for name in ACCEL if name in self.covariates}
        missing = [name for name in ACCEL if name not in found]
        if missing:
            if len(missing) < len(ACCEL):
                self.notes.append(
                    f"column {missing[0]} is missing, so the acceleration was left out"
                )
            return np.full((len(self.numbers), 3), np.nan)
        read = np.column_stack([found[name] for name in ACCEL])
        accel = self._without_holes(known_force(read))
        if np.all(read == 0.0):
            self.notes.append("the acceleration was left out: it is 0 throughout, not even gravity")
        size = float(np.median(np.linalg.norm(accel, axis=1)))
        for unit, factor in _ACCEL_UNITS:
            if _GRAVITY[0] * GRAVITY_M_S2 < size * factor < _GRAVITY[1] * GRAVITY_M_S2:
                self.notes.append(f"the acceleration was in {unit}: taken as m/s^2")
                return accel * factor
        return accel

    def note_upward_axes(self, accel: Array) -> None:
        """A note on axes that are not those of the device, whose registers are for its own."""
        found = upward(dict(zip(ACCEL, accel.T, strict=True))) or ""
        if found.endswith("z points up"):
            self.notes.append(
                f"{found}: these axes are not x forward, y right, z down, or the acceleration has "
                "the other sign; a calibration is for the axes of the recording, and in others "
                "its numbers are wrong"
            )

    def _without_holes(self, accel: Array) -> Array:
        known: NDArray[np.bool] = np.asarray(np.isfinite(accel).all(axis=1))
        count = int(np.count_nonzero(~known))
        if count in (0, len(known)):
            return accel
        time_s = self.values[TIME]
        at = np.flatnonzero(known)
        right = np.searchsorted(at, np.arange(len(known)))
        before, behind = at[np.maximum(right - 1, 0)], at[np.minimum(right, len(at) - 1)]
        far = ~known & (time_s[behind] - time_s[before] > _HOLE_S)
        if np.count_nonzero(far) > _HOLES_SHARE * len(known):
            self.notes.append(
                f"the acceleration was left out: {count} of {len(known)} rows have none"
            )
            return np.full_like(accel, np.nan)
        filled = self._carried(accel, known, far)
        if filling := count - int(np.count_nonzero(far)):
            self.notes.append(
                f"no acceleration in {counted(filling, 'row')}: filled from the rows next to it, "
                "turned by the gyro"
            )
        if far.any():
            self.notes.append(
                f"left out, without acceleration for more than {_HOLE_S:g} s: "
                f"{counted(int(np.count_nonzero(far)), 'row')}"
            )
            kept = ~far
            place = np.cumsum(kept) - 1
            ends = np.flatnonzero(np.diff(kept.astype(np.int8)) > 0) + 1
            begins = [int(place[row]) for row in (*self.starts, *ends.tolist()) if kept[row]]
            self.starts = tuple(sorted(set(begins)))
            self._keep(kept)
            filled = filled[kept]
        return filled

    def _carried(self, accel: Array, known: NDArray[np.bool], far: NDArray[np.bool]) -> Array:
        """The force with its holes filled: gravity of the rows beside, turned as the gyro says.

        known, far (N,): rows that have a force, and rows that are too far from any
        """
        out = accel.copy()
        turn = self.vectors(GYRO)[1:] * np.diff(self.values[TIME])[:, None]
        edges = np.flatnonzero(np.diff(np.concatenate([[True], known, [True]]).astype(np.int8)))
        for first, end in edges.reshape(-1, 2).tolist():
            if far[first]:
                continue
            before, behind = max(first - 1, 0), min(end, len(known) - 1)
            R = so3.products(so3.exp(np.vstack([np.zeros((1, 3)), turn[before:behind]])))
            weight = np.linspace(0.0, 1.0, len(R))[:, None]
            sides = ((0, before), (-1, behind))
            force = [np.einsum("nji,j->ni", R, R[k] @ accel[row]) for k, row in sides]
            weight = np.where(known[before], weight if known[behind] else 0.0, 1.0)
            mixed = np.where(weight < 1.0, (1.0 - weight) * force[0], 0.0)
            mixed += np.where(weight > 0.0, weight * force[1], 0.0)
            out[first:end] = mixed[first - before : end - before]
        return out

    def table(self, accel: Array) -> Table:
        """What is left as samples."""
        time_s = self.values[TIME]
        dt_s, starts = _steps(time_s, self.starts)
        rows = SampleBlock(
            time_s=time_s,
            dt_s=dt_s,
            host_s=time_s,
            raw_b_gauss=self.vectors(MAG),
            gyro_b_rad_s=_over_steps(self.vectors(GYRO), dt_s),
            accel_b_m_s2=accel,
            covariates=self.covariates,
        )
        return Table(rows, starts, tuple(printable(note, 300) for note in self.notes))


def _is_parquet(path: Path) -> bool:
    if path.suffix.lower() == ".parquet":
        return True
    try:
        with path.open("rb") as file:
            return file.read(len(PARQUET)) == PARQUET
    except OSError:  # said with its reason by the reader of text
        return False


def _plain(value: float) -> str:
    return f"{value:.3f}".rstrip("0").rstrip(".")


def _resolved(path: Path, names: list[str], given: ColumnMap) -> Resolved:
    try:
        return resolve(names, given)
    except ColumnError as error:
        raise RecordingError(path, error.what, error.remedy) from None


def _read_parquet(path: Path, given: ColumnMap) -> pyarrow.Table:
    """Numbers and times only, after a look at the sizes."""
    from pyarrow import parquet  # most tables are text, and every import is paid at every start

    try:
        file = parquet.ParquetFile(path)
        kinds = {field.name: field.type for field in file.schema_arrow}
        groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
        size = sum(group.total_byte_size for group in groups)
        for count, limit, what in (
            (len(file.schema_arrow), TABLE_COLUMNS, "columns"),
            (file.metadata.num_rows, TABLE_ROWS, "rows"),
            (size, TABLE_BYTES, "bytes of columns"),
        ):
            refuse_beyond(path, count, limit, what, "cut it in parts")
        needed = {
            source.column
            for source in _resolved(path, file.schema_arrow.names, given).sources.values()
        }
        wanted = [
            name
            for name, kind in kinds.items()
            if _is_plain(kind) or _is_text(kind) or name in needed
        ]
        cells = file.metadata.num_rows * len(wanted)
        refuse_beyond(path, cells, TABLE_CELLS, "numbers", "cut it in parts")
        table = file.read(columns=wanted, use_threads=False)
    except FileNotFoundError as error:
        raise RecordingError(path, "does not exist", "check the path") from error
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        words = printable(str(error).splitlines()[0] if str(error) else type(error).__name__, 200)
        raise RecordingError(path, f"is no Parquet table: {words}", "write it again") from error
    others = [name for name in kinds if name not in wanted]
    for name in others:  # as empty text, so that it is said that they were left out
        table = table.append_column(name, pyarrow.nulls(table.num_rows).cast(pyarrow.string()))
    return table


def _of_different_names(table: pyarrow.Table, notes: list[str]) -> pyarrow.Table:
    """The first of the columns that share a name; those that are needed are never among them."""
    first = {name: k for k, name in reversed(list(enumerate(table.column_names)))}
    if len(first) == table.num_columns:
        return table
    names = table.column_names
    twice = sorted({name for name in first if names.count(name) > 1 and name.strip()})
    if twice:
        shown = ", ".join(printable(name) for name in twice[:3]) + ", ..." * (len(twice) > 3)
        notes.append(f"of columns with the same name the first counts: {shown}")
    return table.select(sorted(first.values()))


def _noted(table: pyarrow.Table) -> list[str]:
    """What was said of the recording that `ahrsd convert` made the table of."""
    kept = (table.schema.metadata or {}).get(NOTES_KEY.encode(), b"")
    lines = bytes(kept).decode("utf-8", "replace").splitlines()
    return [f"converted: {line}" for line in lines[:_NOTES] if line]


def _is_plain(kind: pyarrow.DataType) -> bool:
    types = pyarrow.types
    return bool(
        types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
        or types.is_temporal(kind) or types.is_decimal(kind) or types.is_null(kind)
    )  # fmt: skip


def _is_text(kind: pyarrow.DataType) -> bool:
    types = pyarrow.types
    if types.is_dictionary(kind):
        kind = kind.value_type
    return bool(types.is_string(kind) or types.is_large_string(kind))


def _numbers(path: Path, table: pyarrow.Table, name: str, source: Source, first_row: int) -> Array:
    """A required column, nan where a cell is empty.  Raises RecordingError where it is text."""
    column = table[source.column]
    values = _seconds(column) if name == TIME else None
    factor = 1.0 if values is not None else source.factor
    if values is None:
        values = _as_floats(column, from_first=name == TIME and source.factor != 1.0)
    if values is None:
        _refuse_text(path, column, source.column, first_row)
    return values if factor == 1.0 else values * factor


def _refuse_text(path: Path, column: pyarrow.ChunkedArray, name: str, first_row: int) -> NoReturn:
    try:
        texts = column.cast(pyarrow.string()).to_pylist()
    except pyarrow.ArrowException:
        raise RecordingError(
            path, f"column {printable(name)} holds {column.type}, no numbers", "write numbers"
        ) from None
    row = next((k for k, text in enumerate(texts) if text is None or not _is_number(text)), 0)
    cell = "" if texts[row] is None else printable(texts[row])
    raise RecordingError(
        path,
        f"row {row + first_row}, column {printable(name)}: {cell!r} is no number",
        "correct the cell",
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _seconds(column: pyarrow.ChunkedArray) -> Array | None:
    """Dates and times as seconds since the first row's day began; None where it holds numbers."""
    kind = column.type
    types = pyarrow.types
    if types.is_string(kind) or types.is_large_string(kind):
        column = _parsed_times(column)
        if column is None:
            return None
        kind = column.type
    if types.is_timestamp(kind):
        unit = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        counts = column.cast(pyarrow.int64())
    elif types.is_time(kind) or types.is_duration(kind):
        unit = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        counts = column.cast(pyarrow.int32() if types.is_time32(kind) else pyarrow.int64())
    else:
        return None
    ticks = counts.to_numpy()
    if counts.null_count:
        return np.asarray(ticks, dtype=np.float64) * unit
    day = round(86400 / unit)
    first = int(ticks[0]) // day * day if types.is_timestamp(kind) else 0
    return np.asarray(ticks.astype(np.int64) - first, dtype=np.float64) * unit


def _parsed_times(column: pyarrow.ChunkedArray) -> pyarrow.ChunkedArray | None:
    """Dates and times of a day, with or without a zone, where all cells are that."""
    texts = [str(text).strip() for text in column.to_pylist()]
    iso = _in_iso_order(texts)
    if iso is None:
        return None
    try:
        times = np.array([_without_zone(text) for text in iso], dtype="datetime64[ns]")
        shift_ns = np.array([_zone_ns(text) for text in iso], dtype="timedelta64[ns]")
    except (ValueError, TypeError):
        return None
    return pyarrow.chunked_array([pyarrow.array(times - shift_ns)])


def _in_iso_order(texts: list[str]) -> list[str] | None:
    """The same times as YYYY-MM-DDTHH:MM:SS; None where they are none, or could be two.

    The order of a date's numbers is told by the year's four digits, by dots, or by a number above
    12. Where all rows are of one day it does not matter.
    """
    found = [_TIME_TEXT.fullmatch(text) for text in texts]
    if not found or any(one is None for one in found):
        return None
    parts = [one.groupdict("") for one in found if one is not None]
    dates = {(one["a"], one["b"], one["c"]) for one in parts}
    ordered = _dates_of({one["date_mark"] for one in parts}, dates)
    if ordered is None:
        return None
    out = []
    for one in parts:
        hour = int(one["hour"])
        if one["half"]:
            hour = hour % 12 + (12 if one["half"].lower() == "p" else 0)
        time = f"{hour:02d}:{one['minute']}:{one['second']}"
        fraction = f".{one['fraction'][:9]}" if one["fraction"] else ""
        zone = one["zone"].strip().replace("UTC", "Z")
        out.append(f"{ordered[one['a'], one['b'], one['c']]}T{time}{fraction}{zone}")
    return out


def _dates_of(marks: set[str], dates: set[_Date]) -> dict[_Date, str] | None:
    """Each date as YYYY-MM-DD; none at all is the first day of 1970."""
    if dates == {_NO_DATE}:
        return {_NO_DATE: "1970-01-01"}
    if _NO_DATE in dates:
        return None
    if all(len(a) == _YEAR for a, _, _ in dates):
        return {date: f"{date[0]}-{date[1].zfill(2)}-{date[2].zfill(2)}" for date in dates}
    if not all(len(c) == _YEAR for _, _, c in dates):
        return None
    day_first = marks == {"."} or any(int(a) > _MONTHS for a, _, _ in dates)
    if not day_first and len(dates) > 1 and all(int(b) <= _MONTHS for _, b, _ in dates):
        return None
    day, month = (0, 1) if day_first else (1, 0)
    return {date: f"{date[2]}-{date[month].zfill(2)}-{date[day].zfill(2)}" for date in dates}


def _without_zone(text: str) -> str:
    return text[: _zone_at(text)]


def _zone_at(text: str) -> int:
    """Where the zone of a time begins: Z, +02:00, +0200 or +02."""
    clock = text.index("T")
    return next((k for k in range(clock, len(text)) if text[k] in "Zz+-"), len(text))


def _zone_ns(text: str) -> int:
    digits = text[_zone_at(text) :].strip("Zz").replace(":", "")
    if not digits:
        return 0
    minutes = 60 * int(digits[1:3]) + int(digits[3:5] or 0)
    return (-1 if digits[0] == "-" else 1) * minutes * 60_000_000_000


def _as_floats(column: pyarrow.ChunkedArray, from_first: bool = False) -> Array | None:
    """Numbers, None where there are none; from_first: the first row is 0, so that no digit of a
    count of nanoseconds is lost."""
    kind = column.type
    if pyarrow.types.is_null(kind):
        return np.full(len(column), np.nan)
    if pyarrow.types.is_decimal(kind):
        column = column.cast(pyarrow.float64())
        kind = column.type
    if pyarrow.types.is_boolean(kind):
        column = column.cast(pyarrow.int8())
        kind = column.type
    if not (pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind)):
        return None
    # numpy casts: Arrow's own functions take a twentieth of a second to load
    values = column.to_numpy()
    if from_first and len(values) and not column.null_count:
        values = values - values[0]
    return np.array(values, dtype=np.float64)


def _covariates(table: pyarrow.Table, found: Resolved) -> tuple[dict[str, Array], list[str]]:
    """All further numeric columns, and the names of those that are text."""
    numeric: dict[str, Array] = {}
    text = []
    wanted = {name: Source(column) for name, column in found.covariates.items()}
    wanted |= {name: one for name, one in found.sources.items() if name not in REQUIRED}
    for name, source in wanted.items():
        values = _as_floats(table[source.column])
        if values is None:
            text.append(name)
        else:
            numeric[name] = values if source.factor == 1.0 else values * source.factor
    return numeric, text


@dataclass(frozen=True, slots=True, eq=False)
class _FewWords:
    """A text column of few different words: of_row (N,) has the number of each row's in `names`."""

    names: tuple[str, ...]
    of_row: Array

    def rows(self, kept: NDArray[np.bool]) -> _FewWords:
        return _FewWords(self.names, self.of_row[kept])


def _few_words(column: pyarrow.ChunkedArray) -> _FewWords | None:
    """The words of a text column; None where they are many, or it is no text."""
    if not _is_text(column.type):
        return None
    if pyarrow.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if not 2 <= len(set(column[:_SENSORS_LOOK].to_pylist()) - {None}) <= _MOST_SENSORS:
        return None
    number: dict[str | None, int] = {}
    of_row = [number.setdefault(word, len(number)) for word in column.to_pylist()]
    return _FewWords(tuple("" if w is None else w for w in number), np.array(of_row, np.float64))


def _check_length(path: Path, rows: int) -> None:
    if rows < MINIMUM_ROWS:
        raise RecordingError(
            path, f"has {counted(rows, 'row')}, {MINIMUM_ROWS} are needed", "record longer"
        )


def _doubles(columns: list[Array]) -> NDArray[np.bool]:
    """(N,) rows that have the same time and readings as the row before."""
    same = np.ones(len(columns[0]), dtype=bool)
    same[0] = False
    for values in columns:
        same[1:] &= values[1:] == values[:-1]
    return same


def _fresh(readings: Array) -> NDArray[np.bool]:
    """(N,) rows whose readings (N, k) are not those of the row before."""
    out = np.ones(len(readings), dtype=bool)
    out[1:] = np.any(readings[1:] != readings[:-1], axis=1)
    return out


def _hold_of(fresh: NDArray[np.bool]) -> int | None:
    """Rows for which readings are held, time after time; None where they are not.

    Coarse readings at rest repeat as it happens, and not so evenly.
    """
    lengths = np.diff(np.flatnonzero(fresh))
    if len(lengths) < _FEWEST_HOLDS:
        return None
    usual = round(float(np.median(lengths)))
    even = usual >= 2 and np.mean(np.abs(lengths - usual) <= 1) > _EVENLY
    # of two rows, one more or less is anything: then nearly all of them
    return usual if even and (usual > 2 or np.mean(lengths == 2) > _EVENLY) else None


def _check_time(path: Path, time_s: Array, numbers: NDArray[np.intp]) -> None:
    """numbers (N,): of the rows in the file."""
    step_s = np.diff(time_s)
    wrong = np.flatnonzero(step_s <= 0.0)
    if len(wrong):
        row = int(wrong[0])
        back = np.count_nonzero(step_s < 0.0)
        word = "stands still" if step_s[row] == 0.0 else "goes back"
        remedy = (
            "sort by time, or split the file where the clock was set"
            if back
            else "the rows differ, so a host stamped them: give the device's time, or even ones"
        )
        raise RecordingError(
            path,
            f"row {numbers[row + 1]}, column time_s: time {word} "
            f"({time_s[row]:g} to {time_s[row + 1]:g} s; {counted(len(wrong), 'such row')})",
            remedy,
        )
    median_s = float(np.median(step_s))
    if not _STEP_S[0] <= median_s <= _STEP_S[1]:
        low, high = _USUAL_STEP_S
        units = [name for name, factor in _TIME_UNITS if low <= median_s * factor <= high]
        unit = units[-1 if median_s > 1.0 else 0] if units else None
        hint = f"; if it is in {unit}: --columns time=NAME:{unit}" if unit else ""
        raise RecordingError(
            path,
            f"column time_s: {median_s:g} s from row to row is no sensor's rate",
            f"give the time in seconds{hint}",
        )


def _steps(time_s: Array, known: tuple[int, ...] = ()) -> tuple[Array, tuple[int, ...]]:
    """Step lengths (N,), nan where unknown, and the rows where a stretch without gap begins.

    known: rows that begin one whatever their step is
    """
    step_s = np.diff(time_s)
    gap = step_s > GAP_FACTOR * np.percentile(step_s, GAP_PERCENTILE)
    gap[[row - 1 for row in known if row > 0]] = True
    dt_s = np.concatenate([[np.nan], np.where(gap, np.nan, step_s)])
    return dt_s, (0, *(np.flatnonzero(gap) + 1).tolist())


def _over_steps(gyro_b_rad_s: Array, dt_s: Array) -> Array:
    """Rates (N, 3) as means over their steps: a row tells the rate of one period only.

    Where rows are missing within a step, their rates are taken from both sides, linearly. Taken as
    the rate of the whole step, that of its last period comes early, which looks like a lag.
    """
    known = np.isfinite(dt_s)
    periods = in_periods(dt_s[known])
    if periods is None:
        return gyro_b_rad_s
    count = np.ones(len(dt_s))
    count[known] = np.rint(periods)
    long = np.flatnonzero(count > 1.0)
    share = (1.0 - 1.0 / count[long, None]) / 2.0
    out = gyro_b_rad_s.copy()
    out[long] += share * (gyro_b_rad_s[long - 1] - gyro_b_rad_s[long])
    return out


TABLE_SUFFIXES = (".csv", ".csv.gz", ".parquet")


def is_table(path: Path) -> bool:
    """Whether the name asks for a table."""
    return path.name.endswith(TABLE_SUFFIXES)


def write_table(
    path: Path, columns: Mapping[str, Array], facts: Mapping[str, str] | None = None
) -> None:
    """Write columns of equal length, every digit of them.  Raises OSError.

    facts: for the metadata of a Parquet file. The gzip header carries no time, so the same columns
    give the same bytes.
    """
    table = pyarrow.table(dict(columns))
    if facts:
        table = table.replace_schema_metadata(dict(facts))
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(table, path)
        return
    sink = pyarrow.BufferOutputStream()
    sink.write((",".join(columns) + "\n").encode())  # the writer's own header would be quoted
    pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(include_header=False))
    content = sink.getvalue().to_pybytes()
    path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
