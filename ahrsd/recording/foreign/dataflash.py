"""ArduPilot's DataFlash log into numpy columns, self-describing.

The file is a row of messages `A3 95 TYPE body`. Type 128 (FMT) names the types, their lengths, the
codes of their fields and the fields. Where a header does not stand where it should, the next one is
searched and the bytes in between are counted as damage.
"""

from __future__ import annotations

import mmap
from array import array
from collections.abc import Container
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ahrsd.errors import RecordingError
from ahrsd.recording.limits import TABLE_CELLS, refuse_beyond
from ahrsd.samples import Array

_HEADER = b"\xa3\x95"
_FMT, _FMT_BYTES = 128, 89
_CODES: dict[str, str] = {
    "a": "(32,)<i2", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2", "e": "<i4",
    "E": "<u4", "L": "<i4", "M": "u1", "q": "<i8", "Q": "<u8", "g": "<f2",
}  # fmt: skip
_SCALES = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}


@dataclass(slots=True)
class _Type:
    """A kind of message: what it holds, how many there are, and where they begin if wanted."""

    name: str
    length: int
    fields: tuple[str, ...]
    codes: str
    layout: np.dtype[np.void] | None
    places: array[int] | None = None
    count: int = 0


@dataclass(slots=True)
class Log:
    """rows by message name; counts of all messages, wanted or not; bytes that are no message."""

    rows: dict[str, NDArray[np.void]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    codes: dict[str, dict[str, str]] = field(default_factory=dict)
    damaged_bytes: int = 0

    def has(self, message: str, *fields: str) -> bool:
        """Whether the log has rows of this message with these fields."""
        return message in self.rows and set(fields) <= set(self.codes[message])

    def column(self, message: str, name: str) -> Array:
        """(N,) in the field's unit; KeyError where there is none."""
        scale = _SCALES.get(self.codes[message][name], 1.0)
        with np.errstate(invalid="ignore"):  # signalling nan of damaged bytes
            return np.asarray(self.rows[message][name], dtype=np.float64) * scale

    def texts(self, message: str, name: str) -> list[str]:
        """The strings of a field."""
        if not self.has(message, name):
            return []
        raw = self.rows[message][name].tolist()
        return [bytes(one).split(b"\0")[0].decode("ascii", "replace") for one in raw]


def read_log(path: Path, wanted: Container[str]) -> Log:
    """The messages of these names.  Raises RecordingError."""
    log = Log()
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        types = _indexed(path, data, wanted, log)
    for kind in types.values():
        if not kind.count:
            continue
        log.counts[kind.name] = log.counts.get(kind.name, 0) + kind.count
        if kind.places and kind.layout is not None:
            log.rows[kind.name] = _rows(path, kind.places, kind.length, kind.layout)
            log.codes[kind.name] = dict(zip(kind.fields, kind.codes, strict=False))
    return log


def _rows(
    path: Path, places: array[int], length: int, layout: np.dtype[np.void]
) -> NDArray[np.void]:
    """The bodies of the messages that begin at these places."""
    bodies = np.frombuffer(places, np.int64)[:, None] + np.arange(3, length)
    rows: NDArray[np.void] = np.memmap(path, np.uint8, "r")[bodies].view(layout)[:, 0]
    return rows


def _indexed(path: Path, data: mmap.mmap, wanted: Container[str], log: Log) -> dict[bytes, _Type]:
    """The kinds of messages by their first three bytes, with their places."""
    formats = _HEADER + bytes([_FMT])
    types = {formats: _Type("FMT", _FMT_BYTES, (), "", None)}
    end, at = len(data), 0
    while at + 3 <= end:
        start = data[at : at + 3]
        kind = types.get(start)
        if kind is not None and at + kind.length <= end:
            kind.count += 1
            if kind.places is not None:
                kind.places.append(at)
            elif start == formats:
                _learn(data[at + 3 : at + _FMT_BYTES], types, wanted)
            at += kind.length
            continue
        following = data.find(_HEADER, at + 1)
        following = end if following < 0 else following
        log.damaged_bytes += following - at
        at = following
    log.damaged_bytes += end - at
    numbers = sum(len(kind.places) * len(kind.fields) for kind in types.values() if kind.places)
    refuse_beyond(path, numbers, TABLE_CELLS, "numbers", "cut it in parts")
    return types


def _learn(body: bytes, types: dict[bytes, _Type], wanted: Container[str]) -> None:
    """A format message; one whose codes do not give its length is skipped over as it is."""
    number, length = body[0], body[1]
    start = _HEADER + bytes([number])
    name, codes, names = (
        body[a:b].split(b"\0")[0].decode("ascii", "replace") for a, b in ((2, 6), (6, 22), (22, 86))
    )
    if number == _FMT or length < 3 or (start in types and types[start].count):
        return
    fields = tuple(part for part in names.split(",") if part)
    layout = None
    if len(fields) == len(codes) == len(set(fields)) and set(codes) <= set(_CODES):
        layout = np.dtype([(one, _CODES[code]) for one, code in zip(fields, codes, strict=True)])
    if layout is not None and layout.itemsize != length - 3:
        layout = None
    places = array("q") if name in wanted and layout is not None else None
    types[start] = _Type(name, length, fields, codes, layout, places)


def refuse_empty(path: Path, log: Log) -> None:
    """Raise RecordingError where nothing but formats is in the log."""
    if not set(log.counts) - {"FMT", "FMTU", "UNIT", "MULT", "PARM"}:
        raise RecordingError(
            path, "is an ArduPilot log without a measurement", "arm, or set LOG_DISARMED, and log"
        )
