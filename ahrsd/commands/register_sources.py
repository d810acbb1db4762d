"""Where sets of registers come from: a device, a JSON file, a record of a journal."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from ahrsd.commands.device_access import open_device, read_all
from ahrsd.commands.register_changes import Changes, to_write
from ahrsd.errors import AhrsdError, JournalError
from ahrsd.journal import Journal, Record, journal_path, register_values
from drivers.vn100.procedures import Identity
from drivers.vn100.registers import REGISTERS


def journals(state: Path, file: Path | None, serial: int | None) -> list[Path]:
    """The journals that are meant, at least one.  Raises JournalError."""
    if file is not None:
        return [file]
    pattern = "journal-*.jsonl" if serial is None else journal_path(state, serial).name
    found = sorted(state.glob(pattern))
    if not found:
        which = "" if serial is None else f" of the device with the serial number {serial}"
        raise JournalError(f"{state}: there is no journal{which}; nothing was written from here")
    return found


def find(journal: Journal, number: int) -> Record:
    """The record of a change.  Raises JournalError where there is none with this number."""
    changes = {record.seq: record for record in journal.records() if "old" in record.facts}
    if number not in changes:
        known = ", ".join(map(str, changes)) or "none"
        raise JournalError(f"{journal.path}: record {number} is no change; changes are: {known}")
    return changes[number]


def newest_in_force(journal: Journal, read: Callable[[Iterable[int]], Changes]) -> Record:
    """The newest change that is in the device and was not undone; undoing is no change itself.

    Raises JournalError where there is none: then a person must say which record is meant.
    """
    records = journal.records()
    done = {record.facts.get("txn") for record in records if record.kind == "HAND_VERIFIED"}
    undone = {record.facts.get("undoes") for record in records if record.seq in done}
    for record in reversed(records):
        new = register_values(record, "new")
        if not new or record.seq in undone or "undoes" in record.facts:
            continue
        present = read(new)
        if not to_write(present, new) and to_write(present, register_values(record)):
            return record
    raise JournalError(
        f"{journal.path}: the device holds the values of none of the journal's changes; "
        "name the record (ahrsd registers history)"
    )


@dataclass(frozen=True, slots=True)
class Sources:
    """Reads a set by its name. A journal's number means the journal of the device beside it."""

    state: Path
    journal_file: Path | None
    baud: int | None

    def read_pair(self, first: str, second: str) -> tuple[Changes, Changes]:
        """Both sets of registers.  Raises AhrsdError, JournalError or DeviceError."""
        serial: int | None = None
        sets: dict[str, Changes] = {}
        for name in (first, second):
            if _is_port(name):
                identity, sets[name] = self._device(name)
                serial = identity.serial
        for name in (first, second):
            if name not in sets:
                sets[name] = self._stored(name, serial)
        return sets[first], sets[second]

    def read(self, name: str) -> tuple[Identity | None, Changes]:
        """One set, and the device where it is one.  Raises the same."""
        return self._device(name) if _is_port(name) else (None, self._stored(name, None))

    def _device(self, name: str) -> tuple[Identity, Changes]:
        with open_device(Path(name), self.baud) as device:
            return read_all(device)

    def _stored(self, name: str, serial: int | None) -> Changes:
        is_number = name.partition(":")[0].isdecimal()
        return self._record(name, serial) if is_number else _read_json(Path(name))

    def _record(self, name: str, serial: int | None) -> Changes:
        number, _, which = name.partition(":")
        if which not in ("", "old", "new"):
            raise AhrsdError(f"{name}: behind the colon is old or new")
        paths = journals(self.state, self.journal_file, serial)
        if len(paths) > 1:
            names = ", ".join(path.name for path in paths)
            raise JournalError(f"{self.state}: several journals ({names}); say which by --journal")
        return register_values(find(Journal.open(paths[0]), int(number)), which or "old")


def _is_port(name: str) -> bool:
    return Path(name).is_char_device() or (name.startswith("/dev/") and not Path(name).exists())


def _read_json(path: Path) -> Changes:
    """The registers in a file of `registers read --json` or in a calibration.json."""
    try:
        body = json.loads(path.read_text(encoding="utf-8"))["registers"]
        values = {int(number): tuple(row) for number, row in body.items()}
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise AhrsdError(f'{path}: has no "registers" of a device or a calibration') from error
    if unknown := sorted(values.keys() - REGISTERS.keys()):
        raise AhrsdError(f"{path}: register {unknown[0]} is no register of the VN-100")
    return values
