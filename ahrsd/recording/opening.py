"""One way to open any recording: what kind it is, its inputs in order, and what is to be known.

The name decides the kind; where it says nothing or the content is another kind beyond doubt, the
content does. Every recording yields what the core takes and ends in `Stop`, so that `replay` is
`run` with another source. `listed` says in lines for a person what is in one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np

from ahrsd.errors import RecordingError
from ahrsd.inputs import Input, Received, Samples, Stop
from ahrsd.printable import counted, printable
from ahrsd.recording.bytestream import (
    is_gzip,
    read_chunks,
    read_received,
    read_stream,
    stamped,
    unpacked_size,
    wide_text_of,
)
from ahrsd.recording.column_names import ACCEL, GYRO, MAG, NO_MAP, TIME, ColumnMap
from ahrsd.recording.foreign.formats import Format, format_of, ready
from ahrsd.recording.foreign.recognised import recognised
from ahrsd.recording.foreign.sensors import NO_CHOICE, Choice, RawBytes, merged
from ahrsd.recording.table import PARQUET, Table, read_table, starts_a_table, table_of
from drivers.vn100.decode import ErrorReply, Measurement, Unused, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.messages import Reply

_END = "end of recording"
_HEAD_BYTES = 4096
_LINES_BYTES = 64 * 1024  # of a table, by which it is told whether it holds a device's lines
_OF_SAMPLES = ("mag_", "gyro_")  # how the names begin of what a sample needs


class RecordingKind(Enum):
    """Where the samples of a recording come from."""

    CAPTURE = "capture"
    BYTES = "byte stream"
    TABLE = "table"


_SUFFIXES = {
    ".mcap": RecordingKind.CAPTURE,
    **dict.fromkeys((".vnraw", ".vnbin", ".bin", ".log", ".txt"), RecordingKind.BYTES),
    **dict.fromkeys((".csv", ".parquet"), RecordingKind.TABLE),
}


@dataclass(slots=True)
class Recording:
    """An opened recording.

    rate_hz: rate to assume where a byte stream has no device time; None: there is none
    header:  a capture's metadata
    notes:   what is missing or was left out; a capture adds to it while its inputs are read
    sent:    what the device sent, in a recording of another program that kept it
    facts:   of a recording of another program: format, source, unit, frame, clock, undone
    """

    path: Path
    kind: RecordingKind
    rate_hz: float | None = None
    header: Mapping[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    table: Table | None = None
    sent: Sequence[Received] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The file's name, for reports."""
        return printable(self.path.name, 200)

    def inputs(self) -> Iterator[Input]:
        """Everything that the core takes, in order, ending in `Stop`; RecordingError as found."""
        if self.table is not None:
            return _table_inputs(self.table)
        if self.sent:
            return iter((*self.sent, Stop(self.sent[-1].host_ns, _END)))
        if self.kind is RecordingKind.CAPTURE:
            return self._capture_inputs()
        return _byte_inputs(self)

    def bytes_of_file(self) -> Callable[[Input], int]:
        """How many bytes of the file an input is: of what is packed its part of the whole.

        Of a capture the bytes that were received, as nobody knows what else is in the file.
        """
        scale = 1.0
        on_disk = self.path.stat().st_size
        if self.kind is RecordingKind.TABLE and self.table is not None:
            scale = on_disk / max(len(self.table.rows), 1)
        elif self.kind is RecordingKind.BYTES:
            scale = on_disk / max(unpacked_size(self.path), 1)

        def share(item: Input) -> int:
            match item:
                case Received(data=data):
                    return round(scale * len(data))
                case Samples(block=block):
                    return round(scale * len(block))
            return 0

        return share

    def told_rate(self) -> tuple[float, str] | None:
        """Rate in Hz that a byte stream itself tells, and by what; None: it tells none."""
        from ahrsd.stream.streams_without_time import rate_of

        return rate_of(read_stream(self.path))

    def _capture_inputs(self) -> Iterator[Input]:
        from ahrsd.recording.capture import CaptureReader, Sent

        reader = CaptureReader(self.path)
        last: Input | None = None
        received = 0
        for item in reader:
            if isinstance(item, Sent):
                continue
            received += isinstance(item, Received | Samples)
            last = item
            yield item
        self.notes[:] = reader.notes
        if not received:
            raise RecordingError(
                self.path, "holds nothing that a device sent", "record again with the device on"
            )
        if last is not None and not isinstance(last, Stop):
            yield Stop(last.host_ns, _END)


def _byte_inputs(recording: Recording) -> Iterator[Input]:
    told: list[str] = []
    host_ns = 0
    for item in read_received(recording.path, told):
        if told:  # as soon as it is known, and once however often the inputs are read
            recording.notes += [note for note in told if note not in recording.notes]
            told.clear()
        host_ns = item.host_ns
        yield item
    recording.notes += [note for note in told if note not in recording.notes]
    yield Stop(host_ns, _END)


def _table_inputs(table: Table) -> Iterator[Input]:
    host_ns = 0
    for block in table.blocks():
        host_ns = round(float(block.host_s[-1]) * 1e9)
        yield Samples(host_ns, block)
    yield Stop(host_ns, _END)


def open_recording(
    path: Path,
    rate_hz: float | None = None,
    *,
    check_units: bool = True,
    columns: ColumnMap = NO_MAP,
    choice: Choice = NO_CHOICE,
) -> Recording:
    """Open a capture, a byte stream, a table, or a recording of another program.

    rate_hz is for byte streams without a device clock and is not used otherwise; check_units and
    columns as in `read_table`, for tables only. choice: what of a recording that holds several.
    Raises RecordingError, one line, where the file is none of them.
    """
    if rate_hz is not None and not rate_hz > 0.0:
        raise RecordingError(path, f"the rate {rate_hz:g} Hz is not positive", "give --rate in Hz")
    if path.is_dir() and (other := format_of(path, b"")) is not None:
        return _of_another(path, other, replace(choice, columns=columns), rate_hz)
    if not path.is_file():
        there = "is no regular file" if path.exists() else "does not exist"
        what = "is a folder" if path.is_dir() else there
        raise RecordingError(path, what, "give the path of a recording")
    suffix = path.with_suffix("").suffix if path.suffix == ".gz" else path.suffix
    start = next(read_chunks(path, _HEAD_BYTES))  # empty or no gzip: say so now
    if (other := format_of(path, start)) is not None:
        return _of_another(path, other, replace(choice, columns=columns), rate_hz)
    if (found := recognised(start)) is not None:
        raise RecordingError(path, found.what, found.remedy)
    named = _SUFFIXES.get(suffix.lower())
    kind = _in_spite_of_its_name(path, start, named) or named or _by_content(path, start)
    if (
        kind is RecordingKind.TABLE
        and not columns
        and b"$VN" in start
        and _keeps_what_was_sent(path)
    ):
        kind = RecordingKind.BYTES
    unused = (
        ["--columns is not used: it is for tables"]
        if columns and kind is not RecordingKind.TABLE
        else []
    )
    if kind is RecordingKind.BYTES:
        return Recording(path, kind, rate_hz, notes=unused)
    if rate_hz is not None:
        unused.append(f"--rate is not used: a {kind.value} has its own time")
    if kind is RecordingKind.CAPTURE:
        from ahrsd.recording.capture import CaptureReader  # a table needs no reader of captures

        header = CaptureReader(path).header
        return Recording(path, kind, header=header, notes=unused)
    table = read_table(path, check_units=check_units, columns=columns)
    return Recording(path, kind, notes=[*unused, *table.notes], table=table)


def _of_another(path: Path, other: Format, choice: Choice, rate_hz: float | None) -> Recording:
    """A recording of another program: a table of its sensors, or what the device sent."""
    ready(path, other)
    for option, given in (("topic", choice.topics), ("compass", choice.compass is not None)):
        if given and option != other.picks:
            raise RecordingError(
                path, f"{other.what}: --{option} is not for it", f"--{other.picks} is"
            )
    notes = [] if rate_hz is None else ["--rate is not used: the recording has its own time"]
    try:
        found = other.read(path, choice)
        if isinstance(found, RawBytes):
            if choice.columns:
                notes.append("--columns is not used: the recording holds what the device sent")
            notes += [f"{other.what.removeprefix('is ')}: {note}" for note in found.notes]
            facts = {"format": other.what.removeprefix("is "), **found.facts}
            return Recording(
                path, RecordingKind.CAPTURE, notes=notes, sent=found.received, facts=facts
            )
        rows = merged(path, found, choice.columns)
    except MemoryError as error:
        raise RecordingError(
            path, "does not fit into this computer's memory", "cut it in parts"
        ) from error
    facts = {"format": other.what.removeprefix("is "), **rows.facts}
    table = table_of(path, rows.columns, [*rows.notes, _source_text(facts)])
    return Recording(
        path, RecordingKind.TABLE, notes=[*notes, *table.notes], table=table, facts=facts
    )


def _source_text(facts: Mapping[str, str]) -> str:
    """The one line about what was taken of a recording of another program."""
    return (
        f"{facts['format']}: field of {facts['mag source']} ({facts['mag unit']}), rates of "
        f"{facts['gyro source']}; frame: {facts['frame']}; undone: {facts['undone']}"
    )


def _in_spite_of_its_name(
    path: Path, start: bytes, named: RecordingKind | None
) -> RecordingKind | None:
    """What a file is beyond doubt whatever it is called.  RecordingError where it is packed."""
    from ahrsd.recording import blocks

    if blocks.is_mcap(start) or start.startswith(PARQUET):
        if is_gzip(path):
            raise RecordingError(path, "is packed with gzip", f"unpack it: gunzip {path.name}")
        return RecordingKind.CAPTURE if blocks.is_mcap(start) else RecordingKind.TABLE
    if starts_a_table(start):
        return RecordingKind.TABLE
    if named is RecordingKind.TABLE and b"$VN" in _as_utf8(start).lstrip().partition(b"\n")[0]:
        return RecordingKind.BYTES
    return None


def _keeps_what_was_sent(path: Path) -> bool:
    """Whether the rows of a table each hold a time and, in a cell, what a VN-100 sent then.

    Then that is the device's own word, with its digits and its checksum. Without field and rate in
    it the table's other columns are all there is.
    """
    look = b""
    for chunk in read_stream(path):
        look += chunk
        if len(look) >= _LINES_BYTES:
            break
    deframer = Deframer()
    told = [decode(frame) for frame in deframer.feed(look)]
    names = {c.name for one in told if isinstance(one, Measurement) for c in one.layout.columns}
    quantities = [any(name.startswith(word) for name in names) for word in _OF_SAMPLES]
    return all(quantities) and stamped(look) is not None


def _as_utf8(start: bytes) -> bytes:
    encoding = wide_text_of(start)
    return start if encoding is None else start.decode(encoding, "ignore").encode("utf-8")


def _by_content(path: Path, start: bytes) -> RecordingKind:
    if b"$VN" in start or b"\xfa" in start:
        return RecordingKind.BYTES
    raise RecordingError(
        path,
        "is no recording by its name nor by its content",
        f"name it by its kind: {' '.join(_SUFFIXES)}",
    )


# -- What it holds ---------------------------------------------------------------------------------


def listed(path: Path) -> list[str]:
    """What is in a recording, one line for each thing.  Raises RecordingError."""
    start = b"" if path.is_dir() or not path.is_file() else next(read_chunks(path, _HEAD_BYTES))
    kind = format_of(path, start)
    if kind is not None:
        ready(path, kind)
        return [f"{path.name} {kind.what}", *kind.list(path)]
    recording = open_recording(path)
    lines = [f"{recording.name} is a {recording.kind.value}"]
    if recording.table is not None:
        rows = recording.table.rows
        lines.append(f"rows: {len(rows)}, {rows.time_s[-1] - rows.time_s[0]:.1f} s")
        accel = ACCEL if np.isfinite(rows.accel_b_m_s2).any() else ()
        names = (TIME, *MAG, *GYRO, *accel, *sorted(rows.covariates))
        return lines + [f"column {name}" for name in names]
    return lines + _messages(recording)


def _messages(recording: Recording) -> list[str]:
    """One line per kind of message that a device sent, and what came to nothing."""
    deframer = Deframer()
    counts: Counter[str] = Counter()
    columns: dict[str, tuple[str, ...]] = {}
    for item in recording.inputs():
        if not isinstance(item, Received):
            continue
        for frame in deframer.feed(item.data):
            match decode(frame):
                case Measurement(layout=layout):
                    counts[layout.name] += 1
                    columns[layout.name] = tuple(column.name for column in layout.columns)
                case Reply(word=word):
                    counts[f"{word}, a reply"] += 1
                case ErrorReply():
                    counts["VNERR, an error"] += 1
                case Unused(name=name):
                    counts[f"{name}, not used"] += 1
    told = deframer.counters
    lines = [
        f"{printable(name)}  {counted(count, 'message')}"
        + (f"  {', '.join(columns[name])}" if name in columns else "")
        for name, count in counts.most_common()
    ]
    left = told.fed_bytes - told.valid_bytes
    return [
        *lines,
        f"{left:,} of {counted(told.fed_bytes, 'byte', ',')} belong to no whole message",
    ]
