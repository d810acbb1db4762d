"""Byte streams: what a port sent, in a file, plain or gzipped; no host time in it."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received

CHUNK_BYTES = 4096


def is_gzip(path: Path) -> bool:
    """By its first two bytes, whatever its name."""
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def unpacked_size(path: Path) -> int:
    """Bytes of the content: of a gzip file what its last four bytes say, modulo 4 GiB."""
    size = path.stat().st_size
    if size < 4 or not is_gzip(path):
        return size
    with path.open("rb") as file:
        file.seek(-4, 2)
        return int.from_bytes(file.read(4), "little")


def read_chunks(path: Path, chunk_bytes: int = CHUNK_BYTES) -> Iterator[bytes]:
    """The file's content, unzipped where it is gzip.  Raises RecordingError where it ends early."""
    position = 0
    try:
        with gzip.open(path) if is_gzip(path) else path.open("rb") as file:
            while chunk := file.read(chunk_bytes):
                position += len(chunk)
                yield chunk
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise RecordingError(
            path,
            f"the gzip file is truncated or damaged after {position} unpacked bytes",
            f"save what is there with `gzip -dc {path.name} > {path.stem}` and use that",
        ) from error
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}", "check the path") from error
    if position == 0:
        raise RecordingError(path, "is empty (0 bytes)", "record again")


def read_received(path: Path) -> Iterator[Received]:
    """The bytes as inputs; `host_ns` is 0 throughout, the file knows no host time."""
    for chunk in read_chunks(path):
        yield Received(0, chunk)
