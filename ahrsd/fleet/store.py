"""Where rows are: a spool of one file a recording, durable at once, then Parquet by serial number.

::

    OUT/spool/KEY.json               written, fsynced, renamed: whole or not there
    OUT/parts/serial=N/HASH.parquet  the same; HASH is of its bytes
    OUT/parts.json                   the parts that count, replaced by a rename
    OUT/lock, OUT/run.json           who is at work, and how far

Exactly once: a row's name is its key, and `compact` moves it in one step, the rename of
`parts.json`. A stop before it leaves parts that nobody counts, and a stop behind it spool files of
rows that are in a part already: a row in the spool stands for the one in a part. Parts that are
not in the list are removed at the next `compact`.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.parquet
from numpy.typing import NDArray

from ahrsd.errors import EXIT_BUSY, AhrsdError
from ahrsd.fleet.row import ANSWERED, COLUMNS, Row

_FORMAT = "ahrsd.fleet/1"
_SMALL_ROWS = 4096  # a part with fewer takes the next rows of its device
_UNKNOWN = "unknown"
_RACES = 20  # times that the list of parts may change while they are read

_TYPES: dict[str, Any] = {
    "text": pyarrow.string(),
    "number": pyarrow.float64(),
    "whole": pyarrow.int64(),
    "yes": pyarrow.bool_(),
    "time": pyarrow.timestamp("ms"),  # UTC, as the column's name says
    "numbers": pyarrow.list_(pyarrow.float64()),
    "texts": pyarrow.list_(pyarrow.string()),
    "findings": pyarrow.list_(
        pyarrow.struct(
            [
                ("effect", pyarrow.string()),
                ("probability", pyarrow.float64()),
                ("frame", pyarrow.string()),
                ("words", pyarrow.string()),
            ]
        )
    ),
}
SCHEMA = pyarrow.schema([(name, _TYPES[kind]) for name, kind in COLUMNS.items()])
#: columns whose texts come again and again; of any other a dictionary is larger than its values
_REPEATED = [
    *("version", "options", "outcome", "error", "remedy", "vehicle", "place", "recorded_by"),
    *("verdict", "warnings.list.element"),
    *(f"findings.list.element.{name}" for name in ("effect", "frame", "words")),
]
_TIMES = [name for name, kind in COLUMNS.items() if kind == "time"]


class Store:
    """The folder of a fleet's rows."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.spool, self._list = root / "spool", root / "parts.json"

    def create(self) -> None:
        """Make the folder where it is not one yet.  AhrsdError."""
        try:
            if self.root.exists() and not self._list.exists() and any(self.root.iterdir()):
                raise AhrsdError(f"{self.root}: holds other files; give a folder of its own")
            self.spool.mkdir(parents=True, exist_ok=True)
            if not self._list.exists():
                self._publish([])
        except OSError as error:
            raise AhrsdError(f"{self.root}: cannot be made: {error.strerror}") from error

    def check(self) -> None:
        """Raise AhrsdError where this is no folder of a fleet."""
        if not self._list.is_file():
            raise AhrsdError(f"{self.root}: holds no rows of a fleet; make some: ahrsd fleet run")

    # -- Rows one by one -----------------------------------------------------------------------

    def put(self, row: Row) -> None:
        """Make a row durable, in the place of one with its key."""
        target = self.spool / f"{row['key']}.json"
        scratch = self.spool / f".{row['key']}.{os.getpid()}"
        with scratch.open("w", encoding="ascii") as file:
            json.dump(row, file, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        scratch.rename(target)

    def has(self, key: str, *, failures: bool) -> bool:
        """Whether a row with this key is there; without `failures` only one with an answer."""
        if (self.spool / f"{key}.json").exists():
            return True
        for _ in range(_RACES):
            parts = tuple(self.parts())
            try:
                return bool(parts) and _known(parts, "key", failures).holds(key)
            except FileNotFoundError:  # the driver has just replaced one: the list has changed
                continue
        raise AhrsdError(f"{self._list}: names parts that are not there; give another folder")

    def spooled(self) -> Iterator[Row]:
        """The rows that are in no part yet; one that is moved meanwhile is left out."""
        for path in self._spool_files():
            try:
                yield json.loads(path.read_text(encoding="ascii"))
            except FileNotFoundError:
                continue

    def _spool_files(self) -> list[Path]:
        return sorted(self.spool.glob("*.json"))

    # -- All rows ------------------------------------------------------------------------------

    def parts(self) -> list[Path]:
        """The parts that count."""
        listed = json.loads(self._list.read_text(encoding="utf-8"))
        if listed.get("schema") != _FORMAT:
            raise AhrsdError(f"{self._list}: is not {_FORMAT}; a later ahrsd may have made it")
        return [self.root / "parts" / name for name in listed["parts"]]

    def known(self, column: str, *, failures: bool) -> Known:
        """All texts of a column, of the spool and of the parts; without `failures` those of rows
        with an answer."""
        spooled = [row[column] for row in self.spooled() if failures or row["outcome"] in ANSWERED]
        return Known([*spooled, *_column(tuple(self.parts()), column, failures)])

    def rows(self) -> tuple[pyarrow.Table, list[Path]]:
        """The rows of the spool as a table, and the parts with all others."""
        self.check()
        spooled = _table(list(self.spooled()))  # before the list: a row that moves is in both
        return spooled, self.parts()

    # -- Compacting ----------------------------------------------------------------------------

    def compact(self) -> int:
        """Move the spool's rows into parts; how many. Only for who holds `alone`."""
        for scratch in self.spool.glob(".*"):
            if not _alive(scratch.suffix[1:]):
                scratch.unlink(missing_ok=True)
        files = self._spool_files()
        listed = self.parts()
        self._remove_others(listed)
        if not files:
            return 0
        table = _table([json.loads(path.read_text(encoding="ascii")) for path in files])
        replaced = {part for part in listed if _holds_any(part, table["key"])}
        names = {_folder(serial) for serial in table["serial_number"].to_pylist()}
        touched = {
            part
            for part in listed
            if part in replaced or (part.parent.name in names and _rows(part) < _SMALL_ROWS)
        }
        kept = [_without(part, table["key"]) for part in sorted(touched)]
        everything = pyarrow.concat_tables([*kept, table])
        made = [self._part(everything, name) for name in _folders(everything)]
        self._publish([*(part for part in listed if part not in touched), *made])
        for path in files:
            path.unlink()
        self._remove_others(self.parts())
        return len(files)

    def add_part(self, table: pyarrow.Table) -> None:
        """Rows that were made elsewhere, all of one device; only for who holds `alone`."""
        listed = self.parts()
        self._publish([*listed, *(self._part(table, name) for name in _folders(table))])

    def relabel(self, labels: Mapping[str, Row]) -> int:
        """Give rows, by stamp, another vehicle, place or serial number; how many have one now.

        What is empty changes nothing, and no serial number that a row has is replaced: the
        recording may have said it. The spool must be empty; only for who holds `alone`.
        """
        parts, changed = [], 0
        for part in self.parts():
            table, of_part = _relabelled(_read(part), labels)
            parts += [self._part(table, n) for n in _folders(table)] if of_part else [part]
            changed += of_part
        if changed:
            self._publish(parts)
            self._remove_others(parts)
        return changed

    def _part(self, table: pyarrow.Table, name: str) -> Path:
        serial = None if name == _folder(None) else int(name.partition("=")[2])
        column = table["serial_number"]
        own = table.filter(
            pyarrow.compute.is_null(column)
            if serial is None
            else pyarrow.compute.equal(column, serial)
        )
        folder = self.root / "parts" / name
        folder.mkdir(parents=True, exist_ok=True)
        sink = pyarrow.BufferOutputStream()
        pyarrow.parquet.write_table(own, sink, compression="zstd", use_dictionary=_REPEATED)
        data = sink.getvalue().to_pybytes()
        path = folder / f"{hashlib.sha256(data).hexdigest()[:16]}.parquet"
        write_whole(path, data)
        return path

    def _publish(self, parts: list[Path]) -> None:
        names = sorted(str(part.relative_to(self.root / "parts")) for part in parts)
        text = json.dumps({"schema": _FORMAT, "parts": names}, indent=1)
        write_whole(self._list, text.encode())

    def _remove_others(self, listed: list[Path]) -> None:
        """Parts that do not count, and what a stop left half written."""
        keep = set(listed)
        for path in (self.root / "parts").glob("*/*"):
            if path not in keep:
                path.unlink(missing_ok=True)

    # -- Who is at work ------------------------------------------------------------------------

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Nobody else runs or compacts meanwhile.  AhrsdError where somebody does."""
        with (self.root / "lock").open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise _Busy(f"{self.root}: another `ahrsd fleet` is at work here") from None
            yield

    def at_work(self) -> bool:
        """Whether somebody runs or compacts."""
        try:
            with self.alone():
                return False
        except _Busy:
            return True

    def tell(self, progress: dict[str, object]) -> None:
        """How far a run is, for `status`."""
        write_whole(self.root / "run.json", json.dumps(progress).encode())

    def told(self) -> dict[str, Any]:
        """What the last run told; empty where there was none."""
        try:
            found: dict[str, Any] = json.loads((self.root / "run.json").read_text())
        except FileNotFoundError:
            return {}
        return found


class _Busy(AhrsdError):
    exit_code = EXIT_BUSY


class Known:
    """A set of keys or stamps in 32 bytes each."""

    def __init__(self, texts: list[str]) -> None:
        self._sorted: NDArray[np.bytes_] = np.unique(np.array(texts, "S32"))

    def __len__(self) -> int:
        return len(self._sorted)

    def holds(self, text: str) -> bool:
        """Whether it is in the set."""
        word = np.bytes_(text.encode("ascii"))
        place = int(np.searchsorted(self._sorted, word))
        return place < len(self._sorted) and bool(self._sorted[place] == word)


def write_whole(path: Path, data: bytes) -> None:
    """A file that is there as a whole, and durable, or not at all."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    with scratch.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    scratch.rename(path)


@lru_cache(1)
def _known(parts: tuple[Path, ...], column: str, failures: bool) -> Known:
    return Known(_column(parts, column, failures))


def _column(parts: tuple[Path, ...], column: str, failures: bool) -> list[str]:
    out: list[str] = []
    for part in parts:
        table = _read(part, [column, "outcome"])
        if not failures:
            answered = pyarrow.array(ANSWERED)
            table = table.filter(pyarrow.compute.is_in(table["outcome"], answered))
        out += table[column].to_pylist()
    return out


def _read(part: Path, columns: list[str] | None = None) -> pyarrow.Table:
    # without the folder's name becoming a column
    return pyarrow.parquet.read_table(part, columns=columns, partitioning=None)


def _rows(part: Path) -> int:
    return int(pyarrow.parquet.read_metadata(part).num_rows)


def _relabelled(table: pyarrow.Table, labels: Mapping[str, Row]) -> tuple[pyarrow.Table, int]:
    """The table with the labels, and how many of its rows they change."""
    names = ("vehicle", "place", "serial_number")
    before = list(zip(*(table[name].to_pylist() for name in names), strict=True))
    after = []
    for stamp, (vehicle, place, serial) in zip(table["stamp"].to_pylist(), before, strict=True):
        given = labels.get(stamp, {})
        number = given.get("serial_number") if serial is None else serial
        after.append((given.get("vehicle") or vehicle, given.get("place") or place, number))
    for name, values in zip(names, zip(*after, strict=True), strict=False):
        column = pyarrow.array(values, SCHEMA.field(name).type)
        table = table.set_column(table.schema.get_field_index(name), name, column)
    return table, sum(one != other for one, other in zip(before, after, strict=True))


def _holds_any(part: Path, keys: pyarrow.ChunkedArray) -> bool:
    found = pyarrow.compute.is_in(_read(part, ["key"])["key"], keys.combine_chunks())
    return bool(pyarrow.compute.any(found).as_py())


def _without(part: Path, keys: pyarrow.ChunkedArray) -> pyarrow.Table:
    table = _read(part)
    moved = pyarrow.compute.is_in(table["key"], keys.combine_chunks())
    return table.filter(pyarrow.compute.invert(moved))


def _folder(serial: int | None) -> str:
    return f"serial={_UNKNOWN if serial is None else serial}"


def _folders(table: pyarrow.Table) -> list[str]:
    return sorted({_folder(serial) for serial in table["serial_number"].to_pylist()})


def _table(rows: list[Row]) -> pyarrow.Table:
    for row in rows:
        for name in _TIMES:
            if row[name] is not None:
                row[name] = datetime.fromisoformat(row[name]).astimezone(UTC).replace(tzinfo=None)
    return pyarrow.Table.from_pylist(rows, SCHEMA)


def _alive(process: str) -> bool:
    return process.isdigit() and Path(f"/proc/{process}").exists()
