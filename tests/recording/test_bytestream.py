"""Byte streams: the bytes as they are, and one line where the file is damaged."""

from __future__ import annotations

import gzip

import pytest

from ahrsd.errors import RecordingError
from ahrsd.inputs import Received
from ahrsd.recording.bytestream import CHUNK_BYTES, read_chunks, read_received, read_stream

STREAM = bytes(range(256)) * 100


@pytest.mark.parametrize("name", ["a.vnraw", "a.vnraw.gz"])
def test_bytes_are_read_unchanged_without_host_time(tmp_path, name):
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
        (lambda data: data[:3], "truncated after 0"),
        (lambda data: data[:10] + b"\xff" * 9, "damaged after 0"),
        (lambda data: gzip.compress(b""), "is empty"),
        (lambda data: b"", "is empty"),
    ],
)
def test_a_file_without_a_byte_ends_in_one_line(tmp_path, damage, words):
    path = tmp_path / "a.vnraw.gz"
    path.write_bytes(damage(gzip.compress(STREAM)))
    with pytest.raises(RecordingError, match=words) as caught:
        list(read_chunks(path))
    assert "\n" not in str(caught.value)
    assert "a.vnraw" in str(caught.value)


@pytest.mark.parametrize(
    ("level", "damage", "words", "least"),
    [
        (0, lambda data: data[:-9000], "the gzip file is truncated after", len(STREAM) // 2),
        (6, lambda data: data[:-4], "the gzip file is truncated after 25600 unpacked", len(STREAM)),
        (6, lambda data: data[:-8] + b"\0\1\2\3" + data[-4:], "is damaged after", 16_000),
        (6, lambda data: data + b"and more", "what follows it is no gzip", len(STREAM)),
    ],
)
def test_bytes_before_damage_are_read_with_a_note(tmp_path, level, damage, words, least):
    path = tmp_path / "a.vnraw.gz"
    path.write_bytes(damage(gzip.compress(STREAM, compresslevel=level)))
    notes: list[str] = []
    found = b"".join(read_chunks(path, notes=notes))
    assert len(found) >= least
    assert STREAM.startswith(found)
    assert len(notes) == 1
    assert words in notes[0]


def test_members_and_padding_of_a_gzip_file_are_one_stream(tmp_path):
    path = tmp_path / "a.vnraw.gz"
    path.write_bytes(gzip.compress(STREAM) + bytes(512) + gzip.compress(STREAM[:99]) + bytes(512))
    notes: list[str] = []
    assert b"".join(read_chunks(path, notes=notes)) == STREAM + STREAM[:99]
    assert notes == []


LINE = b"$VNYMR,+010.071,+000.278*64\r\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ((LINE * 400).replace(b"\r\n", b"\r\r\n"), "lines end in CR CR LF"),
        ((LINE * 400).decode().encode("utf-16"), "the text is UTF-16"),
        ((LINE * 400).decode().encode("utf-16-be"), "the text is UTF-16"),
        (b"".join(repr(LINE).encode() + b"\n" for _ in range(400)), "bytes as Python prints them"),
        (b"".join(f"12:00 INFO {LINE!r}\n".encode() for _ in range(400)), "bytes as Python"),
        ((LINE * 400).replace(b"\r\n", b"\\r\\n\n"), "the written characters"),
    ],
)
@pytest.mark.parametrize("zipped", [False, True])
def test_line_changes_of_a_text_file_are_undone(tmp_path, content, words, zipped):
    path = tmp_path / ("a.txt" + ".gz" * zipped)
    path.write_bytes(gzip.compress(content) if zipped else content)
    notes: list[str] = []
    found = b"".join(read_stream(path, notes=notes))
    assert found.replace(b"\r\n\n", b"\r\n") == LINE * 400
    assert len(notes) == 1
    assert words in notes[0]


def test_bytes_literals_of_packets_and_cut_ones(tmp_path):
    packet = b"\xfa\x14\x3e'\"\x00"
    lines = [repr(packet), repr(packet)[:-4], "no literal", repr(LINE)]
    (tmp_path / "a.txt").write_text("\n".join(lines) + "\n")
    assert b"".join(read_stream(tmp_path / "a.txt")) == packet + LINE


def test_binary_streams_are_never_touched(tmp_path):
    content = (b"\xfa\x14\r\r\n\x00" + LINE) * 300
    (tmp_path / "a.bin").write_bytes(content)
    notes: list[str] = []
    assert b"".join(read_stream(tmp_path / "a.bin", notes=notes)) == content
    assert notes == []


def test_nul_bytes_at_the_end_are_reported(tmp_path):
    (tmp_path / "a.vnraw").write_bytes(LINE * 400 + bytes(70_000))
    notes: list[str] = []
    assert b"".join(read_stream(tmp_path / "a.vnraw", notes=notes)).startswith(LINE * 400)
    assert notes == ["it ends in 70000 NUL bytes: the recorder lost its power"]
