"""The journal: every change of a device's registers, durable before the change is made.

JSON lines, one file per device serial number, append-only::

    {"crc":"9bd3c1a0","kind":"PREPARED","new":{...},"old":{...},"seq":1,"time":"2026-11-03T..."}

`crc` is the CRC32 of the line's canonical JSON (sorted keys, no blanks) without `crc`; `seq`
counts from 1 without a hole. An append returns after file and folder are fsynced, or raises
JournalError and leaves the file as it was: then no register may be written.

A last line that is torn (the power went while it was written) was never acknowledged; it is
reported, and the next append replaces it. Anything else that does not verify makes the journal
untrustworthy, and opening it fails with the line's number.

Beside the journal lies its receipt (`.receipt` in place of `.jsonl`): number, checksum and kind of
the newest record, replaced as a whole and durable before an append returns. A journal that lacks
the record of its receipt was lost, emptied or exchanged, which is not the same as a device that was
never written: opening it fails, too. A journal without a receipt is of an older version; its next
record makes one.

Both are regular files without links, of this user, of root or of the owner of their folder, and
opened without waiting: a FIFO, a folder or a device in their place is refused in one line.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ahrsd.errors import JournalError
from ahrsd.printable import counted
from drivers.vn100.messages import encode
from drivers.vn100.registers import REGISTERS, Values, as_stored, format_command

_OWN_KEYS = ("seq", "time", "kind", "crc")
_MOST_BYTES = 64 * 1024 * 1024  # tens of thousands of writes; no journal is as long


@dataclass(frozen=True, slots=True)
class Record:
    """One line. `time` is wall-clock UTC, a label and nothing to compute with."""

    seq: int
    time: str
    kind: str
    facts: dict[str, Any] = field(default_factory=dict)


def journal_path(state_directory: Path, serial: str | int) -> Path:
    """Where the journal of the device with this serial number is."""
    return state_directory / f"journal-{serial}.jsonl"


def receipt_path(journal: Path) -> Path:
    """Where the receipt of this journal is."""
    return journal.with_suffix(".receipt")


def _utc() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _canonical(body: dict[str, Any]) -> bytes:
    return json.dumps(body, sort_keys=True, separators=(",", ":")).encode()


def _crc(body: dict[str, Any]) -> str:
    return f"{zlib.crc32(_canonical(body)):08x}"


def _line(record: Record) -> bytes:
    body = {"seq": record.seq, "time": record.time, "kind": record.kind, **record.facts}
    return _canonical({**body, "crc": _crc(body)}) + b"\n"


def _parse(line: bytes) -> Record | None:
    """The record of a line, None where the line does not verify."""
    try:
        body = json.loads(line)
        crc = body.pop("crc")
        seq, time, kind = body.pop("seq"), body.pop("time"), body.pop("kind")
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
        return None
    record = Record(seq, time, kind, body)
    return record if _line(record) == line and crc in line.decode() else None


class Journal:
    """The journal of one device; see the module."""

    def __init__(
        self, path: Path, records: list[Record], size: int, torn: bytes, utc: Callable[[], str]
    ) -> None:
        self.path = path
        self.torn = torn
        self._records = records
        self._size = size  # of the verified lines; a torn tail lies behind it
        self._utc = utc

    @staticmethod
    def open(path: Path, utc: Callable[[], str] = _utc) -> Journal:
        """Read and verify.  A file that is not there is an empty journal and is not created.

        Raises JournalError where it cannot be read, a line in the middle does not verify, or the
        receipt says that records are missing.
        """
        content = _read(path) or b""
        *lines, torn = content.split(b"\n")
        if lines and not torn and b"\0" in lines[-1]:  # blocks that never reached the disk
            torn = lines.pop() + b"\n"
        records: list[Record] = []
        for number, line in enumerate(lines, start=1):
            record = _parse(line + b"\n")
            if record is None or record.seq != number:
                raise JournalError(
                    f"{path}: line {number} of the journal is damaged; nothing will be written to "
                    f"the device; keep a copy, then remove the file and {receipt_path(path).name}, "
                    "or repair the line"
                )
            records.append(record)
        _check_receipt(path, lines)
        return Journal(path, records, len(content) - len(torn), torn, utc)

    def records(self) -> list[Record]:
        """All records, oldest first."""
        return list(self._records)

    def last(self, kind: str) -> Record | None:
        """The newest record of this kind."""
        return next((r for r in reversed(self._records) if r.kind == kind), None)

    def append(self, kind: str, **facts: object) -> Record:
        """Add a record and return when it is on the disk.

        Facts are JSON values; register values go as {"23": [12 numbers]}. Raises JournalError
        where the record cannot be made durable: then it is not in the journal.
        """
        if taken := [key for key in _OWN_KEYS if key in facts]:
            raise ValueError(f"{taken[0]} is the journal's own key")
        line = _line(Record(len(self._records) + 1, self._utc(), kind, dict(facts)))
        record = _parse(line)  # what a reader will see: tuples are lists, keys are text
        if record is None:
            raise ValueError(f"the facts of {kind} do not survive JSON: {facts}")
        try:
            self._write(line)
        except OSError as error:
            raise JournalError(
                f"{self.path}: the journal cannot be written ({error.strerror}); "
                "nothing will be written to the device until it can"
            ) from error
        self._records.append(record)
        self._size += len(line)
        self.torn = b""
        return record

    def _write(self, line: bytes) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        create = 0 if self._size else os.O_CREAT  # one that was read and is gone is not begun anew
        descriptor = _open(self.path, os.O_WRONLY | create)
        try:
            if create:
                _give_to_owner(descriptor, self.path.parent)
            if os.fstat(descriptor).st_size != self._size + len(self.torn):
                raise JournalError(
                    f"{self.path}: another program wrote into the journal; start again to read it"
                )
            os.ftruncate(descriptor, self._size)
            try:
                _write_all(descriptor, line, self._size)
                os.fsync(descriptor)
                _sync_directory(self.path.parent)
                self._leave_receipt(line)
            except (OSError, JournalError):
                os.ftruncate(descriptor, self._size)
                self.torn = b""
                raise
        finally:
            os.close(descriptor)

    def _leave_receipt(self, line: bytes) -> None:
        """Replace the receipt by that of this line, as a whole."""
        path = receipt_path(self.path)
        fresh = path.with_suffix(".receipt.new")
        fresh.unlink(missing_ok=True)
        descriptor = _open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        try:
            _write_all(descriptor, _receipt_of(line), 0)
            os.fsync(descriptor)
        except OSError:
            fresh.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)
        fresh.replace(path)
        _sync_directory(path.parent)


def _open(path: Path, flags: int) -> int:
    """Open a regular file of somebody who may have put it there, without waiting for anybody.

    Raises JournalError where it is anything else, OSError where it cannot be opened.
    """
    safely = os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NOCTTY
    try:
        descriptor = os.open(path, flags | safely, 0o644)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise
        raise JournalError(_not_a_file(path, path.lstat().st_mode)) from error
    try:
        _refuse_others(path, os.fstat(descriptor))
    except (JournalError, OSError):
        os.close(descriptor)
        raise
    return descriptor


def _give_to_owner(descriptor: int, folder: Path) -> None:
    """Give a file that root begins to the owner of its folder: the daemon must write there, too."""
    status = folder.stat()
    if os.geteuid() == 0 and os.fstat(descriptor).st_uid == 0 != status.st_uid:
        os.fchown(descriptor, status.st_uid, status.st_gid)


def _refuse_others(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise JournalError(_not_a_file(path, status.st_mode))
    if status.st_uid not in (0, os.geteuid(), path.parent.stat().st_uid):
        raise JournalError(
            f"{path}: is a file of the user {status.st_uid}, neither of this one nor of the "
            "folder's owner; nothing will be written to the device; look at it, then remove it"
        )


def _not_a_file(path: Path, mode: int) -> str:
    kinds = {
        stat.S_IFLNK: "a symbolic link",
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a FIFO",
        stat.S_IFSOCK: "a socket",
    }
    what = kinds.get(stat.S_IFMT(mode), "a device")
    return (
        f"{path}: is {what} where a regular file belongs; nothing will be written to the device; "
        "remove it, or name the file itself"
    )


def _read(path: Path) -> bytes | None:
    """All of a file, None where there is none.  Raises JournalError."""
    try:
        descriptor = _open(path, os.O_RDONLY)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise _unreadable(path, error) from error
    try:
        if os.fstat(descriptor).st_size > _MOST_BYTES:
            raise JournalError(f"{path}: is larger than {_MOST_BYTES} bytes, so it is no journal")
        content = b""
        while chunk := os.read(descriptor, 1 << 20):
            content += chunk
        return content
    except OSError as error:
        raise _unreadable(path, error) from error
    finally:
        os.close(descriptor)


def _unreadable(path: Path, error: OSError) -> JournalError:
    return JournalError(
        f"{path}: the journal cannot be read ({error.strerror}); "
        "nothing will be written to the device until it can"
    )


def _receipt_of(line: bytes) -> bytes:
    """The receipt of a record's line."""
    body = json.loads(line)
    return _canonical({key: body[key] for key in ("seq", "crc", "kind")}) + b"\n"


def _check_receipt(path: Path, lines: list[bytes]) -> None:
    """Raise JournalError where the receipt is of a record that is not in the journal."""
    receipt = receipt_path(path)
    content = _read(receipt)
    if content is None:
        return
    try:
        body = json.loads(content)
        seq, kind = int(body["seq"]), str(body["kind"])
        known = 0 < seq <= len(lines) and _receipt_of(lines[seq - 1]) == content
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise JournalError(
            f"{receipt}: is damaged, so nobody knows whether the journal is whole; nothing will be "
            f"written to the device; look at {path.name}, then remove the receipt"
        ) from error
    if not known:
        found = f"has {counted(len(lines), 'record')}" if lines else "is empty or gone"
        raise JournalError(
            f"{path}: the journal {found}, but its record {seq} ({kind}) was acknowledged: records "
            "were lost, and what the device holds may be on trial; nothing will be written to it; "
            "restore the journal from a copy, or look at registers 23 and 84 (a device that is "
            f"switched off and on has what is in its flash), then remove {receipt.name}"
        )


def _write_all(descriptor: int, data: bytes, offset: int) -> None:
    while data:
        count = os.pwrite(descriptor, data, offset)
        data, offset = data[count:], offset + count


def _sync_directory(path: Path) -> None:
    """A new file's name is durable only when its folder is."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def register_values(record: Record, which: str = "old") -> dict[int, tuple[float | int | str, ...]]:
    """The registers that a record holds under `which`: "old" or "new"."""
    return {int(number): tuple(values) for number, values in record.facts.get(which, {}).items()}


def wrg_lines(record: Record, which: str = "old") -> list[str]:
    """`$VNWRG,23,...*CS` for each register of the record that a person may send from a terminal."""
    return typed_lines(register_values(record, which))


def typed_lines(registers: Mapping[int, Values]) -> list[str]:
    """`$VNWRG,...*CS` for each register that can be written, in the order of their numbers."""
    return [
        encode(f"VNWRG,{format_command(number, as_stored(number, values), held=True)}")
        .decode()
        .strip()
        for number, values in sorted(registers.items())
        if REGISTERS[number].writable
    ]
