"""Byte streams: what a port sent, in a file, plain or gzipped; no host time in it.

`read_chunks` gives a file's bytes as they are, unzipped, never more than a chunk at a time.
`read_stream` also undoes what terminal programs and loggers do to text on the way into a file:
UTF-16, lines that end in CR CR LF, lines that Python printed as b'...'.  A file that ends too early
(a gzip cut off, damaged) is read as far as it goes; `notes` says what is missing.
"""

from __future__ import annotations

import ast
import codecs
import re
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received
from ahrsd.recording.limits import STREAM_BYTES, refuse_beyond

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
        told.append("the lines are bytes as Python prints them (b'...'): taken out of that")
        stream = _literals(stream)
    elif b"\r\r\n" in start and start.isascii():
        told.append("the lines end in CR CR LF: read as CR LF")
        stream = _single_returns(stream)
    elif b"\\r\\n" in start and start.isascii():
        told.append("the lines end in the written characters \\r\\n: read as line ends")
        stream = _written_ends(stream)
    yield from _counting_nuls(stream, told)


def read_received(path: Path, notes: list[str] | None = None) -> Iterator[Received]:
    """The bytes as inputs; `host_ns` is 0 throughout, the file knows no host time."""
    for chunk in read_stream(path, notes=notes):
        yield Received(0, chunk)


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
