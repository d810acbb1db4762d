"""Capture files: MCAP, written before any parser sees a byte, read back in the same order.

Channels: `rx`, `tx` raw bytes; `input`, `event`, `registers`, `covariate` JSON.  log_time is the
host's monotonic clock in ns; `sequence` counts every record that was handed over, so that a gap in
it is a record that was lost.  The layout of the file is in `blocks`.

Writing is a thread's work.  The caller appends to a queue that is bounded in bytes; when the disk
is slow or full the queue fills, then records are dropped and counted, and the file goes on where
it stopped as soon as the disk takes bytes again.  No write ever raises into the caller.

The `input` channel holds inputs as JSON, exactly: `input_from_json(input_to_json(x)) == x` for
every input but `Received`, whose bytes are stored as they are; arrays of `Samples` travel as lists,
NaN as the JSON extension `NaN` that Python reads and writes. A file may hold anything: each field
is checked against the type that the input's class declares, sizes against what a run writes.

**Names** (`new_capture_path`, `prune`): how the daemon names its captures, and how many it keeps.
Only files that carry the daemon's own name pattern are ever removed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import threading
import time
import types
import typing
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from functools import cache
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd import __version__
from ahrsd.errors import CaptureError, RecordingError
from ahrsd.inputs import (
    ClientLeft,
    ClientSent,
    Columns,
    EarlierRun,
    EarlierSamples,
    Examined,
    Input,
    Interlock,
    Journalled,
    JournalOpened,
    LimitsChanged,
    LinkLost,
    LinkOpened,
    Operator,
    Received,
    RegistersKnown,
    Samples,
    Stop,
    TermsKnown,
    Tick,
    WallClock,
)
from ahrsd.printable import counted
from ahrsd.recording import blocks
from ahrsd.recording.blocks import SEQUENCES, Damage, Entry
from ahrsd.samples import SampleBlock
from ahrsd.writeback.journal_history import RecordKind, StoredRecord

# -- Inputs as JSON --------------------------------------------------------------------------------


_TYPES = {
    kind.__name__: kind
    for kind in (
        Tick,
        WallClock,
        LinkOpened,
        LinkLost,
        Interlock,
        Columns,
        TermsKnown,
        Operator,
        ClientSent,
        ClientLeft,
        RegistersKnown,
        Samples,
        EarlierSamples,
        EarlierRun,
        JournalOpened,
        Journalled,
        Examined,
        LimitsChanged,
        Stop,
    )
}
_MOST = 2**63  # of any whole number
_MOST_REGISTER, _MOST_VALUES = 255, 64
_COMPENSATING = {23: 12, 25: 12, 26: 9, 44: 2, 47: 12, 84: 12}  # register: values at least
_SINGULAR = 1e-12
_MOST_ROWS = 1_000_000  # of a block
_VECTORS = ("raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")
_ARRAYS = ("time_s", "dt_s", "host_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")


def to_json(value: object) -> bytes:
    """Compact JSON of any fact; arrays become lists and what JSON has no word for its text."""
    return json.dumps(value, default=_plain, separators=(",", ":")).encode()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, SampleBlock):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return str(value)


def input_to_json(item: Input) -> bytes:
    """One input, its type's name first."""
    body = {field.name: getattr(item, field.name) for field in fields(item)}
    return to_json({"type": type(item).__name__, **body})


def input_from_json(data: bytes) -> Input:
    """Undo `encode`.  Raises ValueError where the bytes are no input."""
    try:
        body: dict[str, Any] = json.loads(data)
        kind = _TYPES[body.pop("type")]
        if kind is RegistersKnown:
            body["values"] = {int(k): _row(v) for k, v in body["values"].items()}
        elif kind is EarlierRun:
            body["registers"] = {int(k): _row(v) for k, v in body["registers"].items()}
            body["compensated"] = _row(body["compensated"])
        elif kind in (Samples, EarlierSamples):
            body["block"] = _block(body["block"])
        _check(kind, body)
        return kind(**body)
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(f"not a recorded input: {error}") from error


def _row(values: object) -> tuple[Any, ...]:
    if not isinstance(values, list):
        raise TypeError(f"a register holds {_short(values)}")
    return tuple(values)


def _block(body: dict[str, Any]) -> SampleBlock:
    for name in _ARRAYS:
        body[name] = np.array(body[name], dtype=np.float64)
    covariates = {k: np.array(v, dtype=np.float64) for k, v in body.pop("covariates").items()}
    rows = len(body["time_s"])
    if not 0 < rows <= _MOST_ROWS:
        raise ValueError(f"a block of {rows} samples")
    shapes = {name: (rows, 3) if name in _VECTORS else (rows,) for name in _ARRAYS}
    found = {name: body[name].shape for name in _ARRAYS} | {
        k: v.shape for k, v in covariates.items()
    }
    for name, shape in found.items():
        if shape != shapes.get(name, (rows,)):
            raise ValueError(f"{name} of a block of {rows} samples has the shape {shape}")
    sound = np.isfinite(body["time_s"]).all() and np.all(np.diff(body["time_s"]) > 0.0)
    readings = np.isfinite(body["raw_b_gauss"]).all() and np.isfinite(body["gyro_b_rad_s"]).all()
    if not (sound and readings):
        raise ValueError("a block whose times do not increase, or whose readings are not finite")
    if not np.all((body["dt_s"] > 0.0) | np.isnan(body["dt_s"])):
        raise ValueError("a block with steps that are not positive")
    _check(SampleBlock, {k: v for k, v in body.items() if k not in _ARRAYS})
    return SampleBlock(**body, covariates=covariates)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _check(kind: type, body: dict[str, Any]) -> None:
    """Raise ValueError for a field that is not of its declared type, or beyond what runs write."""
    for name, value in body.items():
        if name in (hints := _hints(kind)) and not _is(value, hints[name]):
            raise ValueError(f"{name} of {kind.__name__} is {_short(value)}")
    if not 0 <= body.get("host_ns", 0) < _MOST:
        raise ValueError(f"host_ns of {kind.__name__} is {_short(body['host_ns'])}")
    if not math.isfinite(body.get("wall_s", 0.0)):
        raise ValueError(f"wall_s of {kind.__name__} is {body['wall_s']}")
    if kind in (RegistersKnown, EarlierRun):
        for number, values in body.get("values", body.get("registers", {})).items():
            if not 0 <= number <= _MOST_REGISTER or len(values) > _MOST_VALUES:
                raise ValueError(f"register {_short(number)} of {len(values)} values")
            _check_register(number, values)
    elif kind is JournalOpened and not body.get("error"):
        for record in body.get("records", []):
            StoredRecord.of(record)
    elif kind is Journalled:
        RecordKind(body["kind"])


def _check_register(number: int, values: tuple[Any, ...]) -> None:
    """Those that samples are un-mapped through must be numbers, and a matrix that can be undone."""
    if number not in _COMPENSATING:
        return
    least = _COMPENSATING[number]
    if len(values) < least or not all(_is(v, float) and math.isfinite(v) for v in values):
        raise ValueError(f"register {number} is not {least} numbers: {_short(values)}")
    if least >= 9 and abs(np.linalg.det(np.array(values[:9], float).reshape(3, 3))) < _SINGULAR:
        raise ValueError(f"register {number} holds a matrix that cannot be undone")


def _short(value: object) -> str:
    text = repr(value)
    return f"{text[:40]}..." if len(text) > 40 else text


def _is(value: object, hint: object) -> bool:
    """Whether a decoded value is what an annotation says; a float may be a whole number."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_is(value, part) for part in parts)
    if origin is dict:
        return isinstance(value, dict) and all(
            _is(k, parts[0]) and _is(v, parts[1]) for k, v in value.items()
        )
    if origin in (list, tuple):
        return isinstance(value, origin) and all(_is(part, parts[0]) for part in value)
    if hint in (int, float):
        whole = isinstance(value, int) and not isinstance(value, bool) and -_MOST < value < _MOST
        return whole or (hint is float and isinstance(value, float))
    return hint is object or not isinstance(hint, type) or isinstance(value, hint)


# -- The file --------------------------------------------------------------------------------------


SCHEMA = "ahrsd.capture/1"
FLUSH_S = 0.25  # a chunk is on its way to the kernel at most this long after its first record
SYNC_S = 5.0  # a power cut costs at most this much, a kill only FLUSH_S
CLOSE_S = 5.0  # how long `close` waits for a disk that hangs, unless told
QUEUE_BYTES = 16 * 1024 * 1024  # about two minutes of stream at 800 Hz
WAKE_BYTES = 256 * 1024  # a chunk is not larger than this and one record
_OVERHEAD = 200  # bytes that a queued record costs besides its data


@dataclass(frozen=True, slots=True)
class Sent:
    """Bytes that went to the device."""

    host_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class CaptureStatus:
    """How the writing goes. `error` is "" while the disk takes everything."""

    error: str
    records: int
    queued_bytes: int
    lost_records: int
    lost_bytes: int

    @property
    def complete(self) -> bool:
        """Whether everything handed over so far is or will be in the file."""
        return self.lost_records == 0


def _cost(entry: Entry) -> int:
    return len(entry.data) + _OVERHEAD


def _create(path: Path) -> FileIO:
    """For its owner alone, whatever the umask: a capture holds where the vehicle was."""
    return FileIO(path, "xb", opener=_private)


def _private(path: str, flags: int) -> int:
    descriptor = os.open(path, flags, 0o600)
    os.fchmod(descriptor, 0o600)
    return descriptor


class _File:
    """Appends whole blocks: after an error the next attempt overwrites what was half written."""

    def __init__(self, raw: FileIO) -> None:
        self._raw = raw
        self._synced_s = time.monotonic()
        self.size = 0

    def append(self, block: bytes) -> None:
        """Raises OSError; `size` then still is the end of the last whole block."""
        self._raw.seek(self.size)
        self._raw.truncate(self.size)
        view = memoryview(block)
        while view:
            view = view[self._raw.write(view) or 0 :]
        self.size += len(block)
        if time.monotonic() - self._synced_s > SYNC_S:
            self.sync()

    def sync(self) -> None:
        """Survive a power cut up to here (a kill needs no help)."""
        os.fsync(self._raw.fileno())
        self._synced_s = time.monotonic()

    def close(self) -> None:
        self._raw.close()


def part_path(path: Path, part: int) -> Path:
    """The file of part 1, 2, ... of a capture: `x.mcap`, `x.part2.mcap`, ..."""
    return path if part == 1 else path.with_name(f"{path.stem}.part{part}{path.suffix}")


class CaptureWriter:
    """Records inputs, sent bytes and facts in exactly the order of the calls; see the module.

    path:       created; a file that exists is never overwritten (CaptureError)
    header:     strings for the file's metadata, for example the device's identity
    part_bytes: a new part file starts beyond this size; None: one file
    keep_bytes: the daemon's oldest captures in the folder go beyond this sum; None: all stay
    create:     opens a new file; tests pass one that fails
    """

    def __init__(
        self,
        path: Path,
        header: Mapping[str, str],
        *,
        part_bytes: int | None = None,
        keep_bytes: int | None = None,
        queue_bytes: int = QUEUE_BYTES,
        create: Callable[[Path], FileIO] = _create,
    ) -> None:
        self.path = path
        self._header = dict(header)
        self._part_bytes = part_bytes
        self._keep_bytes = keep_bytes
        self._queue_bytes = queue_bytes
        self._create = create
        self._part = 1
        self._lock = threading.Lock()
        self._queue: deque[Entry] = deque()
        self._queued = 0
        self._sequence = 0
        self._stored = 0
        self._lost_records = 0
        self._lost_bytes = 0
        self._error = ""
        self._wake = threading.Event()
        self._closing = False
        try:
            self._file: _File | None = _File(create(path))
        except FileExistsError as error:
            raise CaptureError(f"{path}: exists already; name another file") from error
        except OSError as error:
            raise CaptureError(f"{path}: cannot be created: {error.strerror}") from error
        self._thread = threading.Thread(target=self._work, name="capture", daemon=True)
        self._thread.start()

    def resize(self, part_bytes: int, keep_bytes: int) -> None:
        """Other sizes from the next part on."""
        self._part_bytes, self._keep_bytes = part_bytes, keep_bytes

    def write(self, item: Input) -> None:
        """Record an input; call it before the core sees the input."""
        if isinstance(item, Received):
            self._put("rx", item.host_ns, item.data)
        else:
            self._put("input", item.host_ns, input_to_json(item))

    def write_sent(self, host_ns: int, data: bytes) -> None:
        """Record bytes that were written to the port."""
        self._put("tx", host_ns, data)

    def write_event(self, host_ns: int, fact: Mapping[str, object]) -> None:
        """Record something that happened, for people and tools; a replay does not need it."""
        self._put("event", host_ns, to_json(fact))

    def write_registers(self, host_ns: int, snapshot: Mapping[str, object]) -> None:
        """Record a snapshot of the device's registers."""
        self._put("registers", host_ns, to_json(snapshot))

    @property
    def status(self) -> CaptureStatus:
        """Counters of this instant."""
        with self._lock:
            return CaptureStatus(
                error=self._error,
                records=self._stored,
                queued_bytes=self._queued,
                lost_records=self._lost_records,
                lost_bytes=self._lost_bytes,
            )

    def close(self, timeout_s: float = CLOSE_S) -> CaptureStatus:
        """Store what is queued and end the file; gives up on a disk that hangs for so long."""
        self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        with self._lock:
            lost = len(self._queue), sum(len(entry.data) for entry in self._queue)
        status = self.status
        return replace(
            status,
            queued_bytes=0,
            lost_records=status.lost_records + lost[0],
            lost_bytes=status.lost_bytes + lost[1],
        )

    def __enter__(self) -> CaptureWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, topic: str, host_ns: int, data: bytes) -> None:
        with self._lock:
            entry = Entry(topic, self._sequence, host_ns, data)
            self._sequence = (self._sequence + 1) % SEQUENCES
            if self._queued + _cost(entry) > self._queue_bytes or self._closing:
                self._lost_records += 1
                self._lost_bytes += len(entry.data)
                self._error = self._error or "the disk is slower than the stream"
                return
            before, self._queued = self._queued, self._queued + _cost(entry)
            self._queue.append(entry)
        if before < WAKE_BYTES <= before + _cost(entry):
            self._wake.set()

    def _work(self) -> None:
        closing = False
        while not closing:
            self._wake.wait(FLUSH_S)
            self._wake.clear()
            closing = self._closing  # read before the queue is emptied for the last time
            try:
                self._store()
                if closing:
                    self._end()
            except OSError as error:
                with self._lock:
                    self._error = f"{error.strerror or error}"
        if self._file:
            self._file.close()

    def _store(self) -> None:
        """Append everything queued; records leave the queue only when they are in the file."""
        while batch := self._batch():
            self._ready().append(blocks.chunk(batch))
            with self._lock:
                for entry in batch:
                    self._queue.popleft()
                    self._queued -= _cost(entry)
                self._stored += len(batch)
                self._error = ""

    def _batch(self) -> list[Entry]:
        batch: list[Entry] = []
        size = 0
        with self._lock:
            for entry in self._queue:
                batch.append(entry)
                size += _cost(entry)
                if size > WAKE_BYTES:
                    break
        return batch

    def _ready(self) -> _File:
        """The file to append to: begun, and not beyond the size of a part."""
        if self._file and self._part_bytes and self._file.size >= self._part_bytes:
            self._end()
            self._part += 1
        if self._file is None:
            self._file = _File(self._create(part_path(self.path, self._part)))
        if self._file.size == 0:
            if self._keep_bytes is not None:
                prune(self.path.parent, self._keep_bytes, part_path(self.path, self._part))
            self._file.append(self._head())
        return self._file

    def _head(self) -> bytes:
        facts = {
            "schema": SCHEMA,
            "part": str(self._part),
            "wall_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "monotonic_ns": str(time.monotonic_ns()),
            "ahrsd": __version__,
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        }
        return blocks.head({**facts, **self._header})

    def _end(self) -> None:
        """Close the current part; a file without this end is a file of a killed process."""
        if self._file is None:
            return
        if self._file.size == 0:
            self._file.append(self._head())
        status = self.status
        counts = {"lost_records": status.lost_records, "lost_bytes": status.lost_bytes}
        self._file.append(blocks.end({key: str(value) for key, value in counts.items()}))
        self._file.sync()
        self._file.close()
        self._file = None


class CaptureReader:
    """A capture, part after part, in recorded order; damage is noted, never guessed over.

    Raises RecordingError where the file is no capture of ours.  `header` is the metadata of the
    first part; `notes` says, once an iteration is through, what is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.header = blocks.read_head(path)

    def __iter__(self) -> Iterator[Input | Sent]:
        """Every input and everything sent, in the order in which the core saw it."""
        for entry in self._entries():
            if entry.topic == "rx":
                yield Received(entry.host_ns, entry.data)
            elif entry.topic == "tx":
                yield Sent(entry.host_ns, entry.data)
            elif entry.topic == "input":
                yield self._decode(entry.data)

    def _decode(self, data: bytes) -> Input:
        try:
            return input_from_json(data)
        except ValueError as error:
            writer = self.header.get("ahrsd", "of unknown version")
            raise RecordingError(
                self.path, f"{error} (written by ahrsd {writer})", "read it with that version"
            ) from error

    def facts(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        """(host_ns, fact) of a JSON channel: "event" or "registers"."""
        for entry in self._entries():
            if entry.topic != topic:
                continue
            try:
                fact = json.loads(entry.data)
            except (ValueError, RecursionError) as error:
                raise RecordingError(
                    self.path, f"a record of {topic} is no JSON: {error}", "record again"
                ) from error
            if isinstance(fact, dict):
                yield entry.host_ns, fact

    def _entries(self) -> Iterator[Entry]:
        self.notes = []
        expected: int | None = None
        part = self.header.get("part", "1")
        for path in _parts(self.path, int(part) if part.isdecimal() and len(part) < 7 else 1):
            for entry in blocks.read_entries(path):
                if isinstance(entry, Damage):
                    self.notes.append(f"{path.name}: {entry.what}")
                    continue
                missing = 0 if expected is None else (entry.sequence - expected) % SEQUENCES
                if missing:
                    self.notes.append(f"{path.name}: missing: {counted(missing, 'record')}")
                expected = (entry.sequence + 1) % SEQUENCES
                yield entry


def _parts(path: Path, part: int) -> Iterator[Path]:
    """The file and the parts that follow it."""
    stem = path.stem.removesuffix(f".part{part}")
    first = path.with_name(stem + path.suffix)
    yield path
    while part_path(first, part + 1).exists():
        part += 1
        yield part_path(first, part)


# -- Names, and how many are kept ------------------------------------------------------------------


_PATTERN = "ahrsd-*.mcap"


def new_capture_path(directory: Path, now: datetime | None = None) -> Path:
    """A name that sorts by time: `ahrsd-20261103T120000Z.mcap`, with a number where it is taken."""
    stamp = (now or datetime.now(UTC)).strftime("%Y%m%dT%H%M%SZ")
    path = directory / f"ahrsd-{stamp}.mcap"
    number = 2
    while path.exists():
        path = directory / f"ahrsd-{stamp}-{number}.mcap"
        number += 1
    return path


def make_private_folder(folder: Path) -> None:
    """The folder and what is missing above it, for their owner alone. Raises OSError.

    One that exists stays as it is.
    """
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    for one in reversed(missing):
        with contextlib.suppress(FileExistsError):
            one.mkdir(mode=0o700)
            one.chmod(0o700)  # whatever the umask


def prune(directory: Path, keep_bytes: int, keep: Path) -> list[Path]:
    """Remove the oldest captures until all fit into `keep_bytes`; `keep` always stays.

    Returns what was removed. A file that cannot be removed is no reason to stop recording.
    """
    files = []
    for path in directory.glob(_PATTERN):
        with contextlib.suppress(OSError):
            status = path.stat()
            files.append((status.st_mtime_ns, path, status.st_size))
    total = sum(size for _, _, size in files)
    removed = []
    for _, path, size in sorted(files):
        if total <= keep_bytes:
            break
        if path != keep:
            with contextlib.suppress(OSError):
                path.unlink()
                removed.append(path)
                total -= size
    return removed
