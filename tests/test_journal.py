"""The journal: durable or refused, verified or refused, torn only at its end."""

from __future__ import annotations

import errno
import json
import os
import zlib
from pathlib import Path

import pytest

from ahrsd import journal as module
from ahrsd.errors import JournalError
from ahrsd.journal import Journal, journal_path, register_values, wrg_lines

OLD = {"23": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.125, -0.0625, 3e-5]}


def fill(path, count=5):
    journal = Journal.open(path, lambda: "2026-11-03T12:00:00.000+00:00")
    for k in range(count):
        journal.append("PREPARED" if k % 2 == 0 else "RAM_SENT", number=k, old=OLD)
    return journal


def test_records_come_back_with_their_facts(tmp_path):
    path = journal_path(tmp_path / "state", 100012345)
    assert path.name == "journal-100012345.jsonl"
    written = fill(path).records()
    journal = Journal.open(path)
    assert journal.records() == written
    assert [record.seq for record in written] == [1, 2, 3, 4, 5]
    assert journal.last("RAM_SENT").facts["number"] == 3
    assert journal.last("COMMITTED") is None
    assert register_values(journal.last("PREPARED")) == {23: tuple(OLD["23"])}
    assert journal.torn == b""


def test_the_format_is_what_the_module_says(tmp_path):
    fill(tmp_path / "j.jsonl", 1)
    body = json.loads((tmp_path / "j.jsonl").read_text())
    crc = body.pop("crc")
    canonical = json.dumps(body, sort_keys=True, separators=(",", ":")).encode()
    assert crc == f"{zlib.crc32(canonical):08x}"
    assert (body["seq"], body["kind"], body["time"][:4]) == (1, "PREPARED", "2026")


def test_appending_continues_the_sequence(tmp_path):
    fill(tmp_path / "j.jsonl", 2)
    assert Journal.open(tmp_path / "j.jsonl").append("PROVEN").seq == 3
    assert len(Journal.open(tmp_path / "j.jsonl").records()) == 3


def test_reading_creates_nothing(tmp_path):
    assert Journal.open(tmp_path / "j.jsonl").records() == []
    assert list(tmp_path.iterdir()) == []


def test_a_power_cut_at_every_byte_of_the_last_line(tmp_path):
    path = tmp_path / "j.jsonl"
    fill(path, 3)
    whole = path.read_bytes()
    start = whole[:-1].rindex(b"\n") + 1
    for size in range(start, len(whole)):
        path.write_bytes(whole[:size])
        journal = Journal.open(path)
        assert len(journal.records()) == 2
        assert journal.torn == whole[start:size]
        assert journal.append("RAM_SENT").seq == 3
        assert [r.kind for r in Journal.open(path).records()][-1] == "RAM_SENT"


def test_blocks_that_never_reached_the_disk_are_a_torn_line(tmp_path):
    fill(tmp_path / "j.jsonl", 2)
    with (tmp_path / "j.jsonl").open("ab") as file:
        file.write(bytes(80) + b'"seq":3}\n')
    journal = Journal.open(tmp_path / "j.jsonl")
    assert len(journal.records()) == 2
    assert len(journal.torn) == 89


def test_every_changed_byte_is_found(tmp_path):
    path = tmp_path / "j.jsonl"
    fill(path, 2)
    whole = path.read_bytes()
    for k in range(len(whole) - 1):
        damaged = bytearray(whole)
        damaged[k] ^= 0x01
        path.write_bytes(damaged)
        with pytest.raises(JournalError, match=r"line [12] of the journal is damaged"):
            Journal.open(path)


@pytest.mark.parametrize("line", [0, 2, 4])
def test_a_missing_or_doubled_line_is_named(tmp_path, line):
    path = tmp_path / "j.jsonl"
    fill(path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[: line + 1], lines[line], *lines[line + 1 :]]))
    with pytest.raises(JournalError, match=f"line {line + 2} of the journal is damaged"):
        Journal.open(path)
    if line < 4:
        path.write_bytes(b"".join([*lines[:line], *lines[line + 1 :]]))
        with pytest.raises(JournalError, match=f"line {line + 1} "):
            Journal.open(path)


def test_both_file_and_folder_are_synced_before_append_returns(tmp_path, monkeypatch):
    synced = []
    real = os.fsync

    def fsync(descriptor: int) -> None:
        synced.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        real(descriptor)

    monkeypatch.setattr(module.os, "fsync", fsync)
    fill(tmp_path / "j.jsonl", 1)
    assert synced == [str(tmp_path / "j.jsonl"), str(tmp_path)]


@pytest.mark.parametrize("call", ["fsync", "pwrite"])
def test_what_is_not_durable_is_refused_and_not_in_the_journal(tmp_path, monkeypatch, call):
    journal = fill(tmp_path / "j.jsonl", 2)
    before = (tmp_path / "j.jsonl").read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module.os, call, full)
        with pytest.raises(JournalError, match="No space left on device"):
            journal.append("PREPARED")
    assert (tmp_path / "j.jsonl").read_bytes() == before
    assert journal.append("PREPARED").seq == 3  # as soon as it can


def test_a_real_full_disk(small_disk):
    journal = fill(small_disk / "j.jsonl", 2)
    (small_disk / "filler").write_bytes(bytes(190_000))
    with pytest.raises(JournalError, match="cannot be written"):
        for _ in range(600):
            journal.append("PREPARED", old=OLD)
    count = len(journal.records())
    assert len(Journal.open(small_disk / "j.jsonl").records()) == count > 2
    (small_disk / "filler").unlink()
    assert journal.append("PREPARED").seq == count + 1


def test_a_second_writer_is_noticed(tmp_path):
    first = fill(tmp_path / "j.jsonl", 1)
    Journal.open(tmp_path / "j.jsonl").append("RAM_SENT")
    with pytest.raises(JournalError, match="another program"):
        first.append("RAM_SENT")


def test_the_journals_own_keys_are_not_for_facts(tmp_path):
    with pytest.raises(ValueError, match="seq is the journal's own key"):
        Journal.open(tmp_path / "j.jsonl").append("PREPARED", seq=9)


def test_the_lines_for_a_terminal(tmp_path):
    journal = fill(tmp_path / "j.jsonl", 1)
    (line,) = wrg_lines(journal.records()[0])
    body, _, checksum = line.removeprefix("$").partition("*")
    assert body == "VNWRG,23,1,0,0,0,1,0,0,0,1,0.125,-0.0625,0.00003"
    value = 0
    for byte in body.encode():
        value ^= byte
    assert checksum == f"{value:02X}"
