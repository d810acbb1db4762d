"""The journal: durable or refused, verified or refused, torn only at its end."""

from __future__ import annotations

import errno
import json
import os
import stat
import zlib
from pathlib import Path

import pytest

from ahrsd.daemon import journal as module
from ahrsd.daemon.journal import Journal, journal_path, receipt_path, register_values, wrg_lines
from ahrsd.errors import JournalError

OLD = {"23": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.125, -0.0625, 3e-5]}


def fill(path, count=5):
    journal = Journal.open(path, lambda: "2026-11-03T12:00:00.000+00:00")
    for k in range(count):
        journal.append("PREPARED" if k % 2 == 0 else "RAM_SENT", number=k, old=OLD)
    return journal


def test_records_are_read_back_with_their_facts(tmp_path):
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


def test_format_is_as_documented_in_the_module(tmp_path):
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


def test_power_cut_at_any_byte_of_the_last_line_loses_only_that_line(tmp_path):
    path = tmp_path / "j.jsonl"
    journal = fill(path, 2)
    receipt = receipt_path(path).read_bytes()
    journal.append("PREPARED", number=2, old=OLD)
    whole = path.read_bytes()
    start = whole[:-1].rindex(b"\n") + 1
    for size in range(start, len(whole)):
        path.write_bytes(whole[:size])
        receipt_path(path).write_bytes(receipt)  # the line was not acknowledged
        journal = Journal.open(path)
        assert len(journal.records()) == 2
        assert journal.torn == whole[start:size]
        assert journal.append("RAM_SENT").seq == 3
        assert [r.kind for r in Journal.open(path).records()][-1] == "RAM_SENT"


def test_unwritten_disk_blocks_are_a_torn_line(tmp_path):
    fill(tmp_path / "j.jsonl", 2)
    with (tmp_path / "j.jsonl").open("ab") as file:
        file.write(bytes(80) + b'"seq":3}\n')
    journal = Journal.open(tmp_path / "j.jsonl")
    assert len(journal.records()) == 2
    assert len(journal.torn) == 89


def test_any_changed_byte_is_found(tmp_path):
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
def test_missing_or_doubled_line_is_reported(tmp_path, line):
    path = tmp_path / "j.jsonl"
    fill(path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[: line + 1], lines[line], *lines[line + 1 :]]))
    with pytest.raises(JournalError, match=f"line {line + 2} of the journal is damaged"):
        Journal.open(path)
    path.write_bytes(b"".join([*lines[:line], *lines[line + 1 :]]))
    missing = f"line {line + 1} " if line < 4 else r"has 4 records, but its record 5 \(PREPARED\)"
    with pytest.raises(JournalError, match=missing):
        Journal.open(path)


def test_both_file_and_folder_are_synced_before_append_returns(tmp_path, monkeypatch):
    synced = []
    real = os.fsync

    def fsync(descriptor: int) -> None:
        synced.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        real(descriptor)

    monkeypatch.setattr(module.os, "fsync", fsync)
    fill(tmp_path / "j.jsonl", 1)
    receipt = [str(tmp_path / "j.receipt.new"), str(tmp_path)]
    assert synced == [str(tmp_path / "j.jsonl"), str(tmp_path), *receipt]


@pytest.mark.parametrize("call", ["fsync", "pwrite"])
def test_record_that_is_not_durable_is_refused_and_removed(tmp_path, monkeypatch, call):
    journal = fill(tmp_path / "j.jsonl", 2)
    before = (tmp_path / "j.jsonl").read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module.os, call, full)
        with pytest.raises(JournalError, match="No space left on device"):
            journal.append("PREPARED")
    assert (tmp_path / "j.jsonl").read_bytes() == before
    assert journal.append("PREPARED").seq == 3  # as soon as it is possible


def test_record_on_a_full_disk_is_refused(small_disk):
    journal = fill(small_disk / "j.jsonl", 2)
    (small_disk / "filler").write_bytes(bytes(190_000))
    with pytest.raises(JournalError, match="cannot be written"):
        for _ in range(600):
            journal.append("PREPARED", old=OLD)
    count = len(journal.records())
    assert len(Journal.open(small_disk / "j.jsonl").records()) == count > 2
    (small_disk / "filler").unlink()
    assert journal.append("PREPARED").seq == count + 1


def test_second_writer_is_noticed(tmp_path):
    first = fill(tmp_path / "j.jsonl", 1)
    Journal.open(tmp_path / "j.jsonl").append("RAM_SENT")
    with pytest.raises(JournalError, match="another program"):
        first.append("RAM_SENT")


@pytest.mark.parametrize("how", ["gone", "empty", "cut", "exchanged"])
def test_lost_journal_is_recognised_by_its_receipt(tmp_path, how):
    path = tmp_path / "j.jsonl"
    fill(path, 4)
    lines = path.read_bytes().splitlines(keepends=True)
    if how == "gone":
        path.unlink()
    elif how == "exchanged":
        other = Journal.open(tmp_path / "other.jsonl", lambda: "2026-11-04T12:00:00.000+00:00")
        for _ in range(4):
            other.append("RAM_SENT")
        path.write_bytes(other.path.read_bytes())
    else:
        path.write_bytes(b"".join(lines[:3]) if how == "cut" else b"")
    with pytest.raises(JournalError, match=r"record 4 \(RAM_SENT\) was acknowledged") as lost:
        Journal.open(path)
    assert "\n" not in str(lost.value)
    assert "remove j.receipt" in str(lost.value)
    receipt_path(path).unlink()  # as the message says
    assert len(Journal.open(path).records()) == {"cut": 3, "exchanged": 4}.get(how, 0)


def test_receipt_is_made_with_the_next_record_and_must_be_complete(tmp_path):
    path = tmp_path / "j.jsonl"
    fill(path, 2)
    receipt_path(path).unlink()  # an older version made none
    assert Journal.open(path).append("PROVEN").seq == 3
    assert json.loads(receipt_path(path).read_text())["seq"] == 3
    for content in (b"", b"[]", b'{"seq": "x"}', b"\xff" * 40, b'{"seq":0,"crc":"","kind":""}'):
        receipt_path(path).write_bytes(content)
        with pytest.raises(JournalError, match="receipt"):
            Journal.open(path)


def test_power_cut_between_record_and_receipt_loses_nothing(tmp_path):
    path = tmp_path / "j.jsonl"
    fill(path, 2)
    before = receipt_path(path).read_bytes()
    Journal.open(path).append("PROVEN")
    receipt_path(path).write_bytes(before)
    receipt_path(path).with_suffix(".receipt.new").write_bytes(b"half a l")
    journal = Journal.open(path)
    assert [record.seq for record in journal.records()] == [1, 2, 3]
    assert journal.append("PROVEN").seq == 4


def test_journal_removed_during_a_run_is_not_started_again(tmp_path):
    journal = fill(tmp_path / "j.jsonl", 2)
    journal.path.unlink()
    with pytest.raises(JournalError, match="cannot be written"):
        journal.append("PROVEN")
    assert not journal.path.exists()


@pytest.mark.parametrize("where", ["journal", "receipt"])
@pytest.mark.parametrize("what", ["FIFO", "folder", "symbolic link", "dangling link", "socket"])
def test_journal_that_is_no_regular_file_is_a_one_line_error(tmp_path, what, where):
    book = tmp_path / "j.jsonl"
    path = book if where == "journal" else receipt_path(book)
    if what == "FIFO":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what == "socket":
        os.mknod(path, stat.S_IFSOCK | 0o600)
    else:
        if what == "symbolic link":
            (tmp_path / "real").write_bytes(b"")
        path.symlink_to(tmp_path / "real")
    kind = "symbolic link" if what == "dangling link" else what
    with pytest.raises(JournalError, match=f"is a {kind} where a regular file belongs") as wrong:
        Journal.open(book)
    assert "\n" not in str(wrong.value)
    if where == "journal":  # put there while the program runs
        path.rmdir() if what == "folder" else path.unlink()
        journal = fill(tmp_path / "other.jsonl", 1)
        journal.path.rename(tmp_path / "kept")
        os.mkfifo(journal.path)
        with pytest.raises(JournalError, match="FIFO"):
            journal.append("PROVEN")


def test_device_as_journal_is_refused():
    with pytest.raises(JournalError, match="/dev/full: is a device where"):
        Journal.open(Path("/dev/full"))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_journal_of_another_user_is_refused_unless_the_folder_owner(tmp_path):
    folder = tmp_path / "state"
    fill(folder / "j.jsonl", 1)
    os.chown(folder / "j.jsonl", 12345, 12345)
    with pytest.raises(JournalError, match="of the user 12345"):
        Journal.open(folder / "j.jsonl")
    os.chown(folder, 12345, 12345)
    assert len(Journal.open(folder / "j.jsonl").records()) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_journal_that_root_begins_is_of_the_folder_owner(tmp_path):
    folder = tmp_path / "state"
    folder.mkdir()
    os.chown(folder, 12345, 12346)
    fill(folder / "j.jsonl", 2)
    status = (folder / "j.jsonl").stat()
    assert (status.st_uid, status.st_gid) == (12345, 12346)


def test_reserved_keys_are_refused_as_facts(tmp_path):
    with pytest.raises(ValueError, match="seq is the journal's own key"):
        Journal.open(tmp_path / "j.jsonl").append("PREPARED", seq=9)


def test_register_commands_for_a_terminal(tmp_path):
    journal = fill(tmp_path / "j.jsonl", 1)
    (line,) = wrg_lines(journal.records()[0])
    body, _, checksum = line.removeprefix("$").partition("*")
    assert body == "VNWRG,23,1,0,0,0,1,0,0,0,1,0.125,-0.0625,0.00003"
    value = 0
    for byte in body.encode():
        value ^= byte
    assert checksum == f"{value:02X}"
