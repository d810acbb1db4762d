"""Tables of samples: CSV (plain or gzipped) and Parquet, checked before anything uses them.

Columns: time_s, mag_{x,y,z}_gauss, gyro_{x,y,z}_rad_s, optional accel_{x,y,z}_m_s2 (specific
force); every other numeric column is a covariate and keeps its name, text columns are left out.

A gap is a step longer than 1.6 times the 95th percentile of all steps. Host-stamped streams
alternate between two step lengths, one up to 1.7 times the other, so the median will not do; on
the real recordings this finds exactly the samples that the damaged sentences cost. The step
behind a gap is unknown (`dt_s` nan) and a block never spans one.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.csv
from numpy.typing import NDArray

from ahrsd.errors import RecordingError
from ahrsd.recording.bytestream import read_chunks
from ahrsd.samples import Array, SampleBlock

BLOCK_ROWS = 1024
MINIMUM_ROWS = 20
GAP_FACTOR = 1.6
GAP_PERCENTILE = 95.0

_MAG = ("mag_x_gauss", "mag_y_gauss", "mag_z_gauss")
_GYRO = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")
_ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
_REQUIRED = ("time_s", *_MAG, *_GYRO)


@dataclass(frozen=True, slots=True)
class _Range:
    """Where the median magnitude of a vector must lie, and what it looks like elsewhere."""

    columns: tuple[str, str, str]
    minimum: float
    maximum: float
    unit: str
    above: tuple[tuple[float, str], ...]  # from this magnitude on it looks like that unit


# Above 10 G no VN-100 reads (2.5 G full scale); 20 rad/s is a sustained 1150 deg/s.
_RANGES = (
    _Range(_MAG, 0.01, 10.0, "gauss", ((5000.0, "nT"), (200.0, "mG"), (10.0, "uT"))),
    _Range(_GYRO, 0.0, 20.0, "rad/s", ((20.0, "deg/s"),)),
)
_STEP_S = (1e-4, 2.0)  # 10 kHz ... 0.5 Hz: other units of time end outside


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


def read_table(path: Path, *, check_units: bool = True) -> Table:
    """Read and check a table.  Raises RecordingError naming the row, the column and a remedy.

    check_units: refuse magnitudes that look like another unit
    """
    parquet = path.suffix == ".parquet"
    table = _read_parquet(path) if parquet else _read_csv(path)
    _check_length(path, table.num_rows)
    first_row = 1 if parquet else 2  # a CSV's header is row 1, as editors count
    columns = {name: _numbers(path, table, name, first_row) for name in _REQUIRED}
    doubles = _doubles(list(columns.values()))
    if doubles.any():
        table = table.filter(pyarrow.array(~doubles))
        columns = {name: values[~doubles] for name, values in columns.items()}
        _check_length(path, table.num_rows)
    covariates, text = _covariates(table)
    notes = [f"column {name} is text and was left out" for name in text]
    if doubles.any():
        words = f"{np.count_nonzero(doubles)} rows repeat the row before them, time and all"
        notes.append(f"{words}: left out, first row {np.flatnonzero(doubles)[0] + first_row}")
    accel, missing = _accel(covariates, table.num_rows)
    if missing and len(missing) < len(_ACCEL):
        notes.append(f"column {missing[0]} is missing, so the acceleration was left out")
    time_s = columns["time_s"]
    _check_time(path, time_s, np.flatnonzero(~doubles) + first_row)
    mag, gyro = (np.column_stack([columns[name] for name in names]) for names in (_MAG, _GYRO))
    for vectors, limits in zip((mag, gyro), _RANGES if check_units else (), strict=check_units):
        _check_units(path, vectors, limits)
    dt_s, starts = _steps(time_s)
    rows = SampleBlock(
        time_s=time_s,
        dt_s=dt_s,
        host_s=time_s,
        raw_b_gauss=mag,
        gyro_b_rad_s=gyro,
        accel_b_m_s2=accel,
        covariates=covariates,
    )
    return Table(rows, starts, tuple(notes))


def _read_csv(path: Path) -> pyarrow.Table:
    data = b"".join(read_chunks(path, 1 << 20))
    _check_text(path, data)
    try:
        content = pyarrow.BufferReader(data)
        table = pyarrow.csv.read_csv(content, pyarrow.csv.ReadOptions(use_threads=False))
        table = table.rename_columns([name.strip() for name in table.column_names])
        _check_names(path, table.column_names)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowKeyError, UnicodeDecodeError) as error:
        words = str(error).splitlines()[0]
        raise RecordingError(path, f"is no CSV table: {words}", "repair that row") from error
    return table


def _check_text(path: Path, data: bytes) -> None:
    """Refuse what no reader of comma-separated UTF-8 can read, by what it is."""
    if "time_s" in data[:2000].decode("utf-16", "ignore"):
        raise RecordingError(path, "is UTF-16 text", "save it as UTF-8")
    head = data[: data.find(b"\n") + 1] or data
    if b"," not in head and (b";" in head or b"\t" in head):
        word = "semicolons" if b";" in head else "tabs"
        raise RecordingError(
            path,
            f"has its columns separated by {word}",
            "write it with commas between the columns and points in the numbers",
        )


def _read_parquet(path: Path) -> pyarrow.Table:
    from pyarrow import parquet  # most tables are text, and every import is paid at every start

    try:
        table = parquet.read_table(path)
    except FileNotFoundError as error:
        raise RecordingError(path, "does not exist", "check the path") from error
    except (pyarrow.ArrowInvalid, OSError) as error:
        words = str(error).splitlines()[0]
        raise RecordingError(path, f"is no Parquet table: {words}", "write it again") from error
    _check_names(path, table.column_names)
    return table


def _check_names(path: Path, names: list[str]) -> None:
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise RecordingError(path, f"has the column {double[0]} twice", "rename one of them")
    missing = [name for name in _REQUIRED if name not in names]
    if not missing:
        return
    others = [name for name in names if name not in _REQUIRED]
    alike = difflib.get_close_matches(missing[0], others, n=1, cutoff=0.5)
    hint = f" (is {alike[0]} meant? convert and rename it)" if alike else ""
    raise RecordingError(
        path,
        f"has no column {', '.join(missing)}",
        f"a table needs {', '.join(_REQUIRED)}{hint}",
    )


def _numbers(path: Path, table: pyarrow.Table, name: str, first_row: int) -> Array:
    """A required column.  Raises RecordingError at its first cell that is no finite number."""
    values = _as_floats(table[name])
    if values is None:
        texts = table[name].cast(pyarrow.string()).to_pylist()
        row = next(k for k, text in enumerate(texts) if text is None or not _is_number(text))
        cell = "" if texts[row] is None else texts[row]
        raise RecordingError(
            path, f"row {row + first_row}, column {name}: {cell!r} is no number", "correct the cell"
        )
    wrong = np.flatnonzero(~np.isfinite(values))
    if len(wrong):
        raise RecordingError(
            path,
            f"row {wrong[0] + first_row}, column {name}: empty, nan or infinite "
            f"({len(wrong)} rows in all)",
            "leave such rows out; a missing row is a gap, which is understood",
        )
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _as_floats(column: pyarrow.ChunkedArray) -> Array | None:
    kind = column.type
    if pyarrow.types.is_null(kind):
        return np.full(len(column), np.nan)
    if pyarrow.types.is_boolean(kind):
        column = column.cast(pyarrow.int8())
        kind = column.type
    if not (pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind)):
        return None
    # numpy casts: Arrow's own functions take a twentieth of a second to load
    return np.array(column.to_numpy(), dtype=np.float64)


def _covariates(table: pyarrow.Table) -> tuple[dict[str, Array], list[str]]:
    """All further numeric columns, and the names of those that are text."""
    columns = {
        name: _as_floats(table[name]) for name in table.column_names if name not in _REQUIRED
    }
    numeric = {name: values for name, values in columns.items() if values is not None}
    return numeric, [name for name in columns if name not in numeric]


def _accel(covariates: dict[str, Array], rows: int) -> tuple[Array, list[str]]:
    """Take the acceleration out of `covariates`: (N, 3), nan unless all three axes are there."""
    found = {name: covariates.pop(name) for name in _ACCEL if name in covariates}
    missing = [name for name in _ACCEL if name not in found]
    if missing:
        return np.full((rows, 3), np.nan), missing
    return np.column_stack([found[name] for name in _ACCEL]), []


def _check_length(path: Path, rows: int) -> None:
    if rows < MINIMUM_ROWS:
        raise RecordingError(path, f"has {rows} rows, {MINIMUM_ROWS} are needed", "record longer")


def _doubles(columns: list[Array]) -> NDArray[np.bool]:
    """(N,) rows that have the same time and readings as the row before."""
    same = np.ones(len(columns[0]), dtype=bool)
    same[0] = False
    for values in columns:
        same[1:] &= values[1:] == values[:-1]
    return same


def _check_time(path: Path, time_s: Array, numbers: NDArray[np.intp]) -> None:
    """numbers (N,): of the rows in the file."""
    step_s = np.diff(time_s)
    wrong = np.flatnonzero(step_s <= 0.0)
    if len(wrong):
        row = int(wrong[0])
        word = "stands still" if step_s[row] == 0.0 else "goes back"
        raise RecordingError(
            path,
            f"row {numbers[row + 1]}, column time_s: time {word} "
            f"({time_s[row]:g} to {time_s[row + 1]:g} s; {len(wrong)} such rows)",
            "sort by time and remove double rows, or split the file where the clock was reset",
        )
    median_s = float(np.median(step_s))
    if not _STEP_S[0] <= median_s <= _STEP_S[1]:
        raise RecordingError(
            path,
            f"column time_s: {median_s:g} s from row to row is no sensor's rate",
            "give the time in seconds",
        )


def _check_units(path: Path, vectors: Array, limits: _Range) -> None:
    median = float(np.median(np.linalg.norm(vectors, axis=1)))
    if limits.minimum <= median <= limits.maximum:
        return
    guess = next((unit for level, unit in limits.above if median > level), None)
    words = f"it looks like {guess}" if guess else "it looks like another unit or a dead sensor"
    raise RecordingError(
        path,
        f"columns {limits.columns[0]} ... : median magnitude {median:.4g} {limits.unit}, {words}",
        f"convert it to {limits.unit}",
    )


def _steps(time_s: Array) -> tuple[Array, tuple[int, ...]]:
    """Step lengths (N,), nan where unknown, and the rows where a stretch without gap begins."""
    step_s = np.diff(time_s)
    gap = step_s > GAP_FACTOR * np.percentile(step_s, GAP_PERCENTILE)
    dt_s = np.concatenate([[np.nan], np.where(gap, np.nan, step_s)])
    return dt_s, (0, *(np.flatnonzero(gap) + 1).tolist())
