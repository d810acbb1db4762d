"""Byte streams: the bytes as they are, and one line where the file is damaged."""

from __future__ import annotations

import gzip

import pytest

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received
from ahrsd.recording.bytestream import CHUNK_BYTES, read_chunks, read_received

STREAM = bytes(range(256)) * 100


@pytest.mark.parametrize("name", ["a.vnraw", "a.vnraw.gz"])
def test_the_bytes_come_as_they_are_without_host_time(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(gzip.compress(STREAM) if name.endswith(".gz") else STREAM)
    items = list(read_received(path))
    assert b"".join(item.data for item in items) == STREAM
    assert all(item == Received(0, item.data) for item in items)
    assert {len(item.data) for item in items[:-1]} == {CHUNK_BYTES}


def test_gzip_is_known_by_its_content(tmp_path):
    (tmp_path / "a.vnraw").write_bytes(gzip.compress(STREAM))
    assert b"".join(read_chunks(tmp_path / "a.vnraw")) == STREAM


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: data[: len(data) // 2], "truncated or damaged after"),
        (lambda data: data[:-4], "truncated or damaged after"),
        (lambda data: data[:3], "truncated or damaged after 0"),
        (lambda data: data[:60] + b"\xff\xff\xff\xff" + data[64:], "truncated or damaged"),
        (lambda data: gzip.compress(b""), "is empty"),
        (lambda data: b"", "is empty"),
    ],
)
def test_a_damaged_file_ends_in_one_line(tmp_path, damage, words):
    path = tmp_path / "a.vnraw.gz"
    path.write_bytes(damage(gzip.compress(STREAM)))
    with pytest.raises(RecordingError, match=words) as caught:
        list(read_chunks(path))
    assert "\n" not in str(caught.value)
    assert "a.vnraw" in str(caught.value)


def test_what_comes_before_a_truncation_is_not_lost(tmp_path):
    path = tmp_path / "a.vnraw.gz"
    path.write_bytes(gzip.compress(STREAM, compresslevel=0)[:-9000])
    found = bytearray()
    with pytest.raises(RecordingError, match=r"gzip -dc a\.vnraw\.gz > a\.vnraw"):
        for chunk in read_chunks(path):
            found += chunk
    assert len(found) > len(STREAM) // 2
    assert STREAM.startswith(found)
