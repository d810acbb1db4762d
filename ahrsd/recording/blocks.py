"""The MCAP layout of a capture, block by block; the only module that knows the format.

A file (https://mcap.dev/spec)::

    magic, Header("ahrsd"), Metadata "ahrsd.capture"     who, when, which device
    Chunk (zstd, CRC32): Channel records, Message*       each can be read alone
    Metadata "ahrsd.end", DataEnd, Footer, magic         absent after a kill or a power cut

There is no index, so nothing in memory grows with the file and nothing is lost with its end;
MCAP tools read such files from front to back.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import overload

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from ahrsd import __version__
from ahrsd.errors import RecordingError
from ahrsd.printable import printable
from ahrsd.recording.limits import BLOCK_BYTES

SEQUENCES = 2**32  # `sequence` wraps here
_MAGIC = b"\x89MCAP0\r\n"
_PROFILE = "ahrsd"
_HEAD_BYTES = 64 * 1024
_PREFIX = struct.Struct("<BQ")  # of every MCAP record: opcode, length
_TIMES = struct.Struct("<QQ")  # how a chunk begins: of its first and of its last message
Wanted = Callable[[int, int], bool]

_ENCODINGS = {
    "rx": "application/octet-stream",
    "tx": "application/octet-stream",
    "input": "json",
    "event": "json",
    "registers": "json",
    "covariate": "json",
}
_IDS = {topic: number for number, topic in enumerate(_ENCODINGS, start=1)}
_TOPICS = {number: topic for topic, number in _IDS.items()}


@dataclass(frozen=True, slots=True)
class Entry:
    """One record of a capture: `sequence` counts everything that was handed to the writer."""

    topic: str
    sequence: int
    host_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Damage:
    """A part of the file that cannot be read; `unclosed`: only its end is missing."""

    what: str
    unclosed: bool = False


def is_mcap(start: bytes) -> bool:
    """Whether a file that begins so is MCAP."""
    return start.startswith(_MAGIC)


def head(metadata: Mapping[str, str]) -> bytes:
    """How a file begins."""
    return _MAGIC + _records(
        Header(profile=_PROFILE, library=f"ahrsd {__version__}"),
        Metadata(name="ahrsd.capture", metadata=dict(metadata)),
    )


def end(metadata: Mapping[str, str]) -> bytes:
    """How a file ends that was closed."""
    return (
        _records(
            Metadata(name="ahrsd.end", metadata=dict(metadata)),
            DataEnd(data_section_crc=0),
            Footer(summary_start=0, summary_offset_start=0, summary_crc=0),
        )
        + _MAGIC
    )


def _records(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _channel(number: int) -> Channel:
    topic = _TOPICS[number]
    encoding = _ENCODINGS[topic]
    return Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=0)


def _message(entry: Entry) -> Message:
    return Message(
        channel_id=_IDS[entry.topic],
        log_time=entry.host_ns,
        publish_time=entry.host_ns,
        data=entry.data,
        sequence=entry.sequence,
    )


def chunk(batch: list[Entry]) -> bytes:
    """Entries as one block, the channels that they use in front."""
    numbers = sorted({_IDS[entry.topic] for entry in batch})
    content = _records(
        *(_channel(number) for number in numbers),
        *(_message(entry) for entry in batch),
    )
    times = [entry.host_ns for entry in batch]
    return _records(
        Chunk(
            compression="zstd",
            data=zstandard.compress(content),
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
    )


def read_head(path: Path) -> dict[str, str]:
    """The metadata in front.  Raises RecordingError where there is none of ours."""
    not_ours = RecordingError(
        path, "is not a capture of ahrsd", "give the file that `ahrsd capture` or `run` wrote"
    )
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}", "check the path") from error
    if not head:
        raise RecordingError(path, "is empty (0 bytes)", "record again")
    if not head.startswith(_MAGIC):
        raise not_ours
    try:
        reader = StreamReader(BytesIO(head), record_size_limit=_HEAD_BYTES)
        for record in itertools.islice(reader.records, 2):
            if isinstance(record, Header) and record.profile != _PROFILE:
                raise _of_another(path, record.profile, not_ours)
            if isinstance(record, Metadata):
                return dict(record.metadata)
    except (McapError, struct.error, ValueError) as error:
        raise RecordingError(path, "ends within its header", "record again") from error
    raise not_ours


def _of_another(path: Path, profile: str, not_ours: RecordingError) -> RecordingError:
    """What an MCAP file of another program is."""
    from ahrsd.recording.foreign.recognised import ROS

    number = {"ros1": "1", "ros2": "2"}.get(profile)
    if number is not None:
        return RecordingError(path, f"is a ROS {number} recording (MCAP)", ROS)
    if profile:
        what = f"is an MCAP file of another program (profile {printable(profile, 30)})"
        return RecordingError(path, what, not_ours.remedy)
    return not_ours


@overload
def read_entries(path: Path) -> Iterator[Entry | Damage]: ...


@overload
def read_entries(path: Path, wanted: Wanted) -> Iterator[Entry | Damage | None]: ...


def read_entries(path: Path, wanted: Wanted | None = None) -> Iterator[Entry | Damage | None]:
    """Everything in a file in recorded order, and what could not be read of it.

    wanted: asked with the first and the last time of a block, in ns; None comes for each that is
    left out
    """
    for data in _read_chunks(path):
        if isinstance(data, Damage):
            yield data
        elif wanted is None or len(data) < _TIMES.size or wanted(*_TIMES.unpack_from(data)):
            yield from _unpack(data)
        else:
            yield None


def _read_chunks(path: Path) -> Iterator[bytes | Damage]:
    opcode, left = 0, path.stat().st_size - len(_MAGIC)
    with path.open("rb") as file:
        file.seek(len(_MAGIC))
        while left >= _PREFIX.size and opcode != Opcode.FOOTER:
            opcode, length = _PREFIX.unpack(file.read(_PREFIX.size))
            left -= _PREFIX.size
            if length > left:
                break
            left -= length
            if opcode != Opcode.CHUNK or length > BLOCK_BYTES:
                file.seek(length, 1)
                if opcode == Opcode.CHUNK:
                    yield Damage(f"a block of {length} bytes, over the limit, was left out")
                continue
            yield file.read(length)
    if opcode != Opcode.FOOTER:
        tail = f"; its last {left} bytes are half a block" if left else ""
        yield Damage(f"was not closed (killed, or cut short){tail}", unclosed=True)


def _unpack(data: bytes) -> list[Entry | Damage]:
    """The entries of a chunk; of channels that this version does not know, none."""
    try:
        block = _plain(Chunk.read(ReadDataStream(BytesIO(data))))
        records = breakup_chunk(block, validate_crc=True)
    except _BlockTooLargeError as error:
        return [Damage(f"a block that unpacks to {error} bytes, over the limit, was left out")]
    except (CRCValidationError, McapError, zstandard.ZstdError, struct.error, ValueError):
        return [Damage(f"a damaged block of {len(data)} bytes was left out")]
    return [
        Entry(_TOPICS[record.channel_id], record.sequence, record.log_time, record.data)
        for record in records
        if isinstance(record, Message) and record.channel_id in _TOPICS
    ]


class _BlockTooLargeError(Exception):
    """A block that says that it unpacks to so many bytes, or does."""


def _plain(block: Chunk) -> Chunk:
    """The same block unpacked; looks at every size before anything is allocated.

    ValueError where it is damaged, _BlockTooLargeError where it is beyond the limit.
    """
    if block.uncompressed_size > BLOCK_BYTES:
        raise _BlockTooLargeError(block.uncompressed_size)
    if block.compression == "zstd":
        said = zstandard.frame_content_size(block.data)
        if said > BLOCK_BYTES:
            raise _BlockTooLargeError(said)
        content = zstandard.ZstdDecompressor(max_window_size=BLOCK_BYTES).decompress(
            block.data, max_output_size=max(block.uncompressed_size, 1)
        )
    elif block.compression == "lz4":
        try:
            decoder = lz4.frame.LZ4FrameDecompressor()
            content = decoder.decompress(block.data, max_length=block.uncompressed_size + 1)
        except RuntimeError as error:  # whatever it does not like
            raise ValueError(str(error)) from error
    elif block.compression:
        raise ValueError(f"unknown compression {block.compression!r}")
    else:
        content = block.data
    if len(content) != block.uncompressed_size:
        raise ValueError("the block is not as long as it says")
    return replace(block, compression="", data=content)
