"""Byte streams: what a port sent, in a file, plain or gzipped.

There is no host time in them, but where a terminal program or a shell put it in front of each line
(`stamped`): then it is the lines' arrival.

`read_chunks` gives a file's bytes as they are, unzipped, never more than a chunk at a time.
`read_stream` also undoes what terminal programs and loggers do to text on the way into a file:
UTF-16, lines that end in CR CR LF, lines that Python printed as b'...', packets of which a text
mode made CR LF of each LF.  A file that ends too early
(a gzip cut off, damaged) is read as far as it goes; `notes` says what is missing.
"""

from __future__ import annotations

import ast
import codecs
import datetime
import re
import zlib
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received
from ahrsd.recording.clock_fit import is_bunched, regular_clock, unwrapped
from ahrsd.recording.limits import STREAM_BYTES, TABLE_ROWS, refuse_beyond
from drivers.vn100.deframer import Deframer

CHUNK_BYTES = 4096
_GZIP = b"\x1f\x8b"
_ANY_HEADER = 31  # zlib's word for gzip with the largest window
_LOOK_BYTES = 64 * 1024  # from which it is told what was done to a text
_PIECE_BYTES = 16 * 1024
_LONGEST_LINE = 64 * 1024
_FEWEST_NULS = 64  # at the end; less may belong to a packet
#: of UTF-32 first: its mark begins as that of UTF-16
_WIDE_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
_EUROPEAN = re.compile(rb"[\t\n\r -~\xa0-\xff]+")
#: a time in front of a line, and what stands between: 1712.5 $VN, [2024-05-01 12:00:00.123] $VN,
#: 12:00:00.123 > $VN, 1712500000123,"$VN, May  5 12:00:00 host program: $VN, 1712.5,0.01,imu,"$VN
_STAMPED = re.compile(
    rb"""[\s\[("'<]*(?:(?P<number>\d+(?:\.\d+)?)(?=[\s\])>,;:|"'-])(?:[^$\n\w]*|[,;\t][^$\n]*)|"""
    rb"(?:(?P<date>\d{4}[-/.]\d\d?[-/.]\d\d?)[T _,]+|[A-Z][a-z]{2} [ \d]\d )?"
    rb"(?P<h>\d\d?):(?P<m>\d\d):(?P<s>\d\d)(?:[.,:](?P<fraction>\d+))?(?!\d)[^$\n]*)(?=\$VN)"
)
_FEWEST_STAMPS, _STAMPED_SHARE = 20, 0.8  # lines with a time, of those that have a message
_LONGEST_STEP_S = 5.0  # between two messages
_FAR_FUTURE_S = 1e10  # since 1970: the year 2286
_DAY_OF_1970 = 719163
_FEWEST_FEEDS = 20
_QUOTED_END = re.compile(rb"\$VN[^$\n]*\*[0-9A-Fa-f]{2,4}\"\r?\n")
_LITERAL = re.compile(rb"""b'(?:[^'\\]|\\.)*'|b"(?:[^"\\]|\\.)*\"""")


def is_gzip(path: Path) -> bool:
    """By its first two bytes, whatever its name."""
    with path.open("rb") as file:
        return file.read(2) == _GZIP


def unpacked_size(path: Path) -> int:
    """Bytes of the content: of a gzip file what its last four bytes say, modulo 4 GiB."""
    size = path.stat().st_size
    if size < 4 or not is_gzip(path):
        return size
    with path.open("rb") as file:
        file.seek(-4, 2)
        return int.from_bytes(file.read(4), "little")


def read_chunks(
    path: Path, chunk_bytes: int = CHUNK_BYTES, notes: list[str] | None = None
) -> Iterator[bytes]:
    """The file's content, unzipped where it is gzip, in chunks of this size.

    notes: gets a line where the gzip file ends early. Raises RecordingError where nothing can be
    read, or more than a stream may hold.
    """
    position = 0
    told: list[str] = []
    try:
        with path.open("rb") as file:
            zipped = file.read(2) == _GZIP
            file.seek(0)
            for chunk in (
                _unzipped(file, chunk_bytes, told) if zipped else _plain(file, chunk_bytes)
            ):
                position += len(chunk)
                refuse_beyond(path, position, STREAM_BYTES, "bytes and more", "cut it in parts")
                yield chunk
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}", "check the path") from error
    if position == 0 and told:
        raise RecordingError(path, f"{told[0]} after 0 unpacked bytes", "copy or record it again")
    if position == 0:
        raise RecordingError(path, "is empty (0 bytes)", "record again")
    if notes is not None:
        notes += [f"{words} after {position} unpacked bytes: read up to there" for words in told]


def _plain(file: BinaryIO, chunk_bytes: int) -> Iterator[bytes]:
    while chunk := file.read(chunk_bytes):
        yield chunk


def _unzipped(file: BinaryIO, chunk_bytes: int, told: list[str]) -> Iterator[bytes]:
    """Chunks of all members of a gzip file; what is wrong with it goes into `told`."""
    ready = bytearray()
    decoder, packed = zlib.decompressobj(_ANY_HEADER), b""
    size = max(chunk_bytes, _PIECE_BYTES)  # what a damaged end costs at most
    while True:
        if not packed and not (packed := file.read(_LOOK_BYTES)):
            if not decoder.eof and (held := decoder.decompress(b"", size)):
                ready += held  # what the last call had no room for
                continue
            told += [] if decoder.eof else ["the gzip file is truncated"]
            break
        if decoder.eof:  # another member, or padding
            packed = packed.lstrip(b"\0")
            if not packed:
                continue
            if not packed.startswith(_GZIP):
                told.append("the gzip file ends, and what follows it is no gzip,")
                break
            decoder = zlib.decompressobj(_ANY_HEADER)
        try:
            ready += decoder.decompress(packed, size)
        except zlib.error:
            told.append("the gzip file is damaged")
            break
        packed = decoder.unused_data if decoder.eof else decoder.unconsumed_tail
        if len(ready) >= chunk_bytes:
            whole = len(ready) // chunk_bytes * chunk_bytes
            for at in range(0, whole, chunk_bytes):
                yield bytes(ready[at : at + chunk_bytes])
            del ready[:whole]
    if ready:
        yield from (bytes(ready[k : k + chunk_bytes]) for k in range(0, len(ready), chunk_bytes))


def wide_text_of(start: bytes) -> str | None:
    """The encoding where text begins like UTF-16 or UTF-32.

    By its mark, or by bytes that are 0 where those of European text are in between.
    """
    for mark, encoding in _WIDE_MARKS:
        if start.startswith(mark):
            return encoding
    sample = start[:400]
    if len(sample) < 8:
        return None
    for width, encoding in ((4, "utf-32"), (2, "utf-16")):
        for place, order in ((0, "le"), (width - 1, "be")):
            letters = sample[place::width]
            zeros = [sample[k::width] for k in range(width) if k != place]
            if all(part.count(0) > 0.9 * len(part) for part in zeros) and _EUROPEAN.fullmatch(
                letters
            ):
                return f"{encoding}-{order}"
    return None


def wide_text_note(encoding: str) -> str:
    """What is said of such text."""
    return f"the text is {encoding[:6].upper()}: read as such"


def read_stream(
    path: Path, chunk_bytes: int = CHUNK_BYTES, notes: list[str] | None = None
) -> Iterator[bytes]:
    """The bytes that the port sent: `read_chunks` without what was done to them in a text file."""
    told = [] if notes is None else notes
    chunks = read_chunks(path, chunk_bytes, told)
    first: list[bytes] = []
    for chunk in chunks:
        first.append(chunk)
        if sum(map(len, first)) >= _LOOK_BYTES:
            break
    start = b"".join(first)
    stream: Iterable[bytes] = _chained(first, chunks)
    if (encoding := wide_text_of(start)) is not None:
        told.append(wide_text_note(encoding))
        stream = _recoded(stream, encoding)
        start = start.decode(encoding, "ignore").encode("utf-8")
    if any(mark in start for mark in (b"b'$VN", b'b"$VN', b"b'\\xfa")):
        told.append("the lines are bytes as Python prints them (b'...'): decoded")
        stream = _literals(stream)
    elif _is_translated(start):
        told.append("a text mode turned each LF of the packets into CR LF: undone")
        stream = _untranslated(stream)
    elif b"\r\r\n" in start and start.isascii():
        told.append("the lines end in CR CR LF: read as CR LF")
        stream = _single_returns(stream)
    elif _QUOTED_END.search(start):
        told.append("the lines are in quotes: the quotes were removed")
        stream = (line.replace(b'"', b"") for line in _lines(stream))
    elif b"\\r\\n" in start and start.isascii():
        told.append("the lines end in the written characters \\r\\n: read as line ends")
        stream = _written_ends(stream)
    yield from _counting_nuls(stream, told)


def read_received(path: Path, notes: list[str] | None = None) -> Iterator[Received]:
    """The bytes as inputs; `host_ns` is 0 throughout where the file knows no host time."""
    told = [] if notes is None else notes
    chunks = read_stream(path, notes=told)
    first: list[bytes] = []
    for chunk in chunks:
        first.append(chunk)
        if sum(map(len, first)) >= _LOOK_BYTES:
            break
    unit_s = stamped(b"".join(first))
    if unit_s is None:
        for chunk in _chained(first, chunks):
            yield Received(0, chunk)
        return
    told.append("each line begins with a time of the host: used as its time of arrival")
    yield from _arrivals(path, unit_s)


def stamped(start: bytes) -> float | None:
    """The unit in s of the times in front of a stream's lines; None where there are none.

    A count of lines is none, and of times that go back most of the way none is left.
    """
    found = [_STAMPED.match(line) for line in start.split(b"\n") if b"$VN" in line]
    times = [one for one in map(_time_in, found) if one is not None]
    if len(times) < _FEWEST_STAMPS or len(times) < _STAMPED_SHARE * len(found):
        return None
    steps = sorted(b - a for a, b in pairwise(times))
    mean = (times[-1] - times[0]) / (len(times) - 1)
    if steps[len(steps) // 10] < 0.0 or not mean > 0.0 or (steps[0] == steps[-1] == 1.0):
        return None
    # since 1970 there have been 1e9 s; smaller numbers tell by how far apart they are
    size, longest = times[0], _LONGEST_STEP_S
    return next(
        (
            unit
            for unit in (1.0, 1e-3, 1e-6, 1e-9)
            if mean * unit <= longest and (size * unit < _FAR_FUTURE_S)
        ),
        None,
    )


def _time_in(found: re.Match[bytes] | None) -> float | None:
    """The number of a stamp; a date and time of a day as seconds."""
    if found is None:
        return None
    if found["number"] is not None:
        return float(found["number"])
    day = 0
    if found["date"] is not None:
        year, month, date = (int(part) for part in re.split(rb"[-/.]", found["date"]))
        try:
            day = datetime.date(year, month, date).toordinal() - _DAY_OF_1970
        except ValueError:
            return None
    clock = int(found["h"]) * 3600 + int(found["m"]) * 60 + int(found["s"])
    return day * 86400.0 + clock + float(b"0." + (found["fraction"] or b"0"))


def _arrivals(path: Path, unit_s: float) -> Iterator[Received]:
    """Each line without its stamp, at its time; what has none at the time of the line before."""
    at_s = _regular_times(path, unit_s)
    host_ns = stamps = 0
    for line in _lines(read_stream(path)):
        found = _STAMPED.match(line)
        if (time := _time_in(found)) is not None and found is not None:
            host_ns = round((time * unit_s if at_s is None else at_s[stamps]) * 1e9)
            yield Received(host_ns, line[found.end() :])
            stamps += 1
        else:
            yield Received(host_ns, line)


def _regular_times(path: Path, unit_s: float) -> NDArray[np.float64] | None:
    """The regular clock behind stamps that came in bunches or in whole seconds; None: as they are.

    A time of a day that began again counts on.
    """
    found = map(_time_in, map(_STAMPED.match, _lines(read_stream(path))))
    times = [time for time in found if time is not None]
    if len(times) > TABLE_ROWS:
        return None
    stamps_s, again, _ = unwrapped(unit_s * np.array(times))
    if is_bunched(stamps_s) and np.all(np.diff(stamps_s) >= 0.0):
        fitted = regular_clock(stamps_s)
        return stamps_s if fitted is None else fitted.time_s
    return stamps_s if len(again) else None


def _is_translated(start: bytes) -> bool:
    """Whether a text mode put CR in front of each LF of a stream of packets.

    Then hardly a packet with a byte LF is whole, and all of them are without those CR.
    """
    feeds = start.count(b"\n")
    if b"\xfa" not in start or feeds < _FEWEST_FEEDS or start.count(b"\r\n") < feeds:
        return False
    packets = []
    for data in (start, start.replace(b"\r\n", b"\n")):
        deframer = Deframer()
        deframer.feed(data)
        packets.append(deframer.counters.packets)
    return packets[1] > packets[0]


def _untranslated(chunks: Iterable[bytes]) -> Iterator[bytes]:
    rest = b""
    for chunk in chunks:
        data = rest + chunk
        rest = b"\r" if data.endswith(b"\r") else b""
        yield data[: len(data) - len(rest)].replace(b"\r\n", b"\n")
    if rest:
        yield rest


def _chained(first: list[bytes], rest: Iterator[bytes]) -> Iterator[bytes]:
    yield from first
    yield from rest


def _recoded(chunks: Iterable[bytes], encoding: str) -> Iterator[bytes]:
    decoder = codecs.getincrementaldecoder(encoding)("replace")
    for chunk in chunks:
        if text := decoder.decode(chunk).encode("utf-8"):
            yield text


def _lines(chunks: Iterable[bytes]) -> Iterator[bytes]:
    """Whole lines with their ends; a line without an end is cut after a while."""
    rest = b""
    for chunk in chunks:
        *whole, rest = (rest + chunk).split(b"\n")
        for line in whole:
            yield line + b"\n"
        if len(rest) > _LONGEST_LINE:
            yield rest
            rest = b""
    if rest:
        yield rest


def _literals(chunks: Iterable[bytes]) -> Iterator[bytes]:
    for line in _lines(chunks):
        parts = []
        for found in _LITERAL.findall(line):
            try:
                parts.append(ast.literal_eval(found.decode("ascii")))
            except (ValueError, SyntaxError):  # cut or damaged: whatever is whole counts
                parts.append(b"\n")
        if data := b"".join(part for part in parts if isinstance(part, bytes)):
            yield data if data.endswith(b"\n") or b"\xfa" in data else data + b"\r\n"


def _single_returns(chunks: Iterable[bytes]) -> Iterator[bytes]:
    for line in _lines(chunks):
        yield line.rstrip(b"\r\n") + b"\r\n" if line.endswith(b"\n") else line


def _written_ends(chunks: Iterable[bytes]) -> Iterator[bytes]:
    for line in _lines(chunks):
        yield line.replace(b"\\r\\n", b"\r\n")


def _counting_nuls(chunks: Iterable[bytes], told: list[str]) -> Iterator[bytes]:
    nuls = 0
    for chunk in chunks:
        kept = len(chunk.rstrip(b"\0"))
        nuls = len(chunk) - kept + (nuls if kept == 0 else 0)
        yield chunk
    if nuls >= _FEWEST_NULS:
        told.append(f"it ends in {nuls} NUL bytes: the recorder lost its power")
