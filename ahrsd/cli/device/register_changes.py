"""Sets of registers for `ahrsd registers`: where they come from, and how one is written by hand.

A set comes from a device, a JSON file, or a record of a journal. It is written with the same care
as the daemon's: journal first, verify, undo.

    HAND_PREPARED     device, old and new values, durable before a byte is sent
    HAND_VERIFIED     written and read back equal
    HAND_FAILED       refused or not equal; what was written is put back, `restored` says whether
    HAND_FLASH_SENT   VNWNV is about to be sent
    HAND_FLASH_ACKED  the device acknowledged it

The daemon's own kinds (`writeback.reconcile`) promise more, gates and a trial, so these are others.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ahrsd.cli.device.access import describe, open_device, read_all
from ahrsd.core.device_session import KeptOutputs
from ahrsd.daemon import host_clock
from ahrsd.daemon.journal import Journal, Record, journal_path, register_values
from ahrsd.errors import AhrsdError, DeviceError, JournalError
from ahrsd.foreign_file import ForeignFileError, read_regular
from ahrsd.writeback.composition import GYRO, MAG, UnwritableError, refuse_unsafe
from ahrsd.writeback.journal_history import JournalHistory
from drivers.serial_port import PortError
from drivers.vn100.commands import (
    Command,
    Identity,
    NotAsKnown,
    Procedure,
    Read,
    Seen,
    TooLate,
    VerifyFailed,
    Word,
    Write,
    WrongDevice,
    quiet,
    read,
    read_present,
    read_registers,
    read_twice,
    restore,
    save_settings_of,
    write_verified,
)
from drivers.vn100.device import Device
from drivers.vn100.errors import DriverError
from drivers.vn100.register_codec import OUT_OF_RANGE
from drivers.vn100.registers import (
    REGISTERS,
    SESSION_SETTINGS,
    RegisterValueError,
    Values,
    format_command,
    parse,
    same,
)

# -- Written by hand -------------------------------------------------------------------------------


Changes = dict[int, Values]
BAUD_RATE = 5  # a line that changes it cuts off the lines behind it


def gate(registers: set[int], save: bool) -> Callable[[Command], bool]:
    """Lets out reads, the pause of the output, and writes of the registers in this set.

    The set is filled when the journal holds their old values, and not before. A failed change is
    put back, so the number decides and not the value.
    """
    words = {"VNASY", "VNWNV"} if save else {"VNASY"}

    def allow(command: Command) -> bool:
        if isinstance(command, Write):
            return command.register in registers
        return isinstance(command, Read) or (isinstance(command, Word) and command.word in words)

    return allow


def refuse_unprovable(present: Changes, changes: Changes) -> None:
    """Raise AhrsdError for a write that could be neither read back nor put back from here."""
    for number, values in changes.items():
        try:
            format_command(number, present[number], held=True)
        except RegisterValueError as error:
            raise AhrsdError(f"the present values could not be put back: {error}") from error
        if number == BAUD_RATE:
            raise AhrsdError(
                "register 5 is not written: the device would answer at its new rate, where this "
                "command can neither read it back nor put it back; nothing was written"
            )
        port = len(REGISTERS[number].fields) - 1
        if REGISTERS[number].fields[port].optional and values[port:] not in (
            (),
            present[number][port:],
        ):
            raise AhrsdError(
                f"register {number} is written for the connected port only, because that of the "
                "other one can be neither read back nor put back: leave the port number out, or "
                "connect to the other port; nothing was written"
            )


def refuse_unproven_save(
    device: Device, journal: Journal, identity: Identity, wanted: Changes
) -> None:
    """Raise JournalError where a save of RAM would make permanent what only was on trial.

    wanted: what the person named; that is the person's decision, whatever the journal says of it
    """
    records, numbers = journal.records(), (MAG, GYRO, *SESSION_SETTINGS)
    history, kept = JournalHistory.of(records), KeptOutputs()
    after = {**device.run(read_present(numbers)), **wanted}
    unnamed = [n for n in (MAG, GYRO) if n in after and n not in wanted]
    if tried := [n for n in unnamed if history.is_trial_value(n, after[n])]:
        which = f"register{'s' * (len(tried) > 1)} {', '.join(map(str, tried))}"
        raise JournalError(
            f"{journal.path}: the device has unproven values of a trial in {which}, and a save "
            "keeps all of RAM; `ahrsd registers rollback` puts the old ones back; nothing was "
            "written"
        )
    kept.update(identity.serial, after, records)
    if kept.left:
        raise JournalError(f"{journal.path}: {kept.describe_left(put_back=False)}")


def to_write(present: Changes, wanted: Changes) -> Changes:
    """The part of `wanted` that the device does not hold already."""
    return {
        number: values
        for number, values in wanted.items()
        if not same(number, values, present[number][: len(values)])
    }


def apply(
    device: Device, journal: Journal, identity: Identity, changes: Changes, **why: object
) -> Record:
    """Write and verify `changes` in RAM; returns the record that `rollback` goes back to.

    why: facts for the journal: `reason`, and for a rollback `undoes`, the number of the change.
    Raises JournalError or Unsteady before anything is written, DeviceError with the outcome of
    putting back.
    """
    old = device.run(read_twice(changes))
    prepared = _append(
        journal,
        "HAND_PREPARED",
        device=describe(identity),
        old=_texts(old),
        new=_texts(changes),
        **why,
    )
    try:
        device.run(quiet(_write_all(identity, changes, held="undoes" in why)))
    except (DriverError, PortError) as error:
        restored = _put_back(device, identity, old)
        outcome = f"NOT put back: {restored}" if restored else "the old values are back"
        _append_behind(
            journal, "HAND_FAILED", f"{error}; {outcome}",
            txn=prepared.seq, error=str(error), restored=not restored,
        )  # fmt: skip
        raise DeviceError(f"{error}; {outcome}") from error
    _append_behind(
        journal, "HAND_VERIFIED", "the new values are in RAM, written and verified",
        txn=prepared.seq,
    )  # fmt: skip
    return prepared


def save_to_flash(device: Device, journal: Journal, identity: Identity, prepared: Record) -> None:
    """VNWNV: everything that is in RAM becomes what the device starts with."""
    expected = register_values(prepared, "new")
    present = device.run(read_registers(expected))
    if changed := to_write(present, expected):
        raise DeviceError(f"register {min(changed)} no longer holds what was written; not saved")
    _append_behind(
        journal, "HAND_FLASH_SENT", "not saved to flash: the new values are in RAM only",
        txn=prepared.seq,
    )  # fmt: skip
    try:
        device.run(quiet(save_settings_of(Seen(identity.unit, present))))
    except (NotAsKnown, TooLate) as error:
        raise DeviceError(f"not saved: {error}") from error
    except (DriverError, PortError) as error:
        raise DeviceError(
            f"{error}; whether it was saved is not known: switch the device off and on and compare "
            f"it with {prepared.seq}:new of the journal (`ahrsd registers diff`)"
        ) from error
    _append_behind(journal, "HAND_FLASH_ACKED", "saved to flash", txn=prepared.seq)


def _append(journal: Journal, kind: str, **facts: object) -> Record:
    """A record with the time by every clock."""
    return journal.append(kind, **{**host_clock.stamp(), **facts})


def _append_behind(journal: Journal, kind: str, so_far: str, **facts: object) -> None:
    """The same after something was done; if it cannot be recorded, the error says so (`so_far`)."""
    try:
        _append(journal, kind, **facts)
    except JournalError as error:
        raise JournalError(f"{so_far}; not recorded: {error}") from error


def _write_all(identity: Identity, changes: Changes, held: bool) -> Procedure[None]:
    """Write and read back each; then read all of them again: a restart in between undoes some."""
    for number, values in changes.items():
        yield from write_verified(number, values, held=held, unit=identity.unit)
    yield from _refuse_other_device(identity)
    for number, values in changes.items():
        back = yield from read(number)
        if to_write({number: back}, {number: values}):
            raise VerifyFailed(number, values, back, 1)


def _put_back(device: Device, identity: Identity, old: Changes) -> str:
    """Whatever differs from `old` gets it again; "" or why that failed."""
    try:
        device.run(quiet(_restore(identity, old)))
    except (DriverError, PortError) as error:
        return str(error)
    return ""


def _restore(identity: Identity, old: Changes) -> Procedure[None]:
    yield from _refuse_other_device(identity)
    yield from restore(old, old, identity.unit)


def _refuse_other_device(identity: Identity) -> Procedure[None]:
    """Raises WrongDevice; the number is read twice, for a reply may be altered on its way."""
    for _ in range(2):
        answered = int((yield from read(3))[0])
        if answered == identity.serial:
            return
    raise WrongDevice(f"the device has the serial number {answered}, not {identity.serial}")


def _texts(values: Changes) -> dict[str, list[float | int | str]]:
    return {str(number): list(row) for number, row in values.items()}


# -- Where they come from --------------------------------------------------------------------------


_LARGEST_BYTES = 4 << 20
_SERIAL, _HSI_CONTROL, _HSI_APPLIED = 3, 44, 3


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

    One that was broken off is in the device in part: each register holds the old or the new value.

    Raises JournalError where there is none: then a person must say which record is meant.
    """
    records = journal.records()
    done = {record.facts.get("txn") for record in records if record.kind == "HAND_VERIFIED"}
    undone = {record.facts.get("undoes") for record in records if record.seq in done}
    for record in reversed(records):
        new = register_values(record, "new")
        if not new or record.seq in undone or "undoes" in record.facts:
            continue
        present, old = read(new), register_values(record)
        to_undo = to_write(present, old)
        if to_undo and not to_write(present, {n: new[n] for n in to_undo}):
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
            raise AhrsdError(f"{name}: after the colon write old or new")
        paths = journals(self.state, self.journal_file, serial)
        if len(paths) > 1:
            names = ", ".join(path.name for path in paths)
            raise JournalError(f"{self.state}: several journals ({names}); say which by --journal")
        return register_values(find(Journal.open(paths[0]), int(number)), which or "old")


def typed(number: int, tokens: Sequence[str]) -> Changes:
    """What a person typed.  Raises RegisterValueError, also for what no sensor can need."""
    wanted = {number: parse(number, tokens)}
    format_command(number, wanted[number])
    try:
        refuse_unsafe(wanted)
    except UnwritableError as error:
        raise RegisterValueError(str(error), OUT_OF_RANGE) from error
    return wanted


def calibrated(
    path: Path, serial: int | None
) -> Callable[[Device, Journal], tuple[Changes, Mapping[str, object]]]:
    """What `registers write --from` wants of a device: the registers of a calibration.json.

    Raises AhrsdError here where the file may not be written to any device, and later, from what is
    returned, where it may not be written to this one.
    """
    body = _calibration(path)
    new, in_force = (_registers_in(path, body, key) for key in ("registers", "registers_in_force"))
    try:
        refuse_unsafe(new)
        for number, values in new.items():
            format_command(number, values)
    except (UnwritableError, RegisterValueError) as error:
        raise AhrsdError(f"{path}: {error}") from error
    device = body.get("device")
    recorded = device.get("serial") if isinstance(device, dict) else None
    if recorded is not None and serial not in (None, recorded):
        raise AhrsdError(f"{path}: is of the device {recorded}, not of {serial}")
    meant = serial if recorded is None else recorded
    if meant is None:
        raise AhrsdError(f"{path}: does not say of which device it is; give --serial NUMBER")

    def wanted(device: Device, _journal: Journal) -> tuple[Changes, Mapping[str, object]]:
        (found,) = device.run(read_registers((_SERIAL,)))[_SERIAL]
        if found != meant:
            raise AhrsdError(f"{path}: is of the device {meant}, and this one is {found}")
        if device.run(read_registers((_HSI_CONTROL,)))[_HSI_CONTROL][1] == _HSI_APPLIED:
            raise AhrsdError("the on-board estimator is applied; set register 44 to 0,1,5")
        present = device.run(read_registers(in_force))
        for number in to_write(present, in_force):
            if number not in new or to_write(present, {number: new[number]}):
                raise AhrsdError(
                    f"{path}: register {number} of the device is not what was in force when it was "
                    "recorded; record again and calibrate anew"
                )
        return new, {"reason": "write", "calibration": path.name}

    return wanted


def _calibration(path: Path) -> dict[str, object]:
    """A calibration that determines something. Raises AhrsdError."""
    try:
        body = json.loads(read_regular(path, _LARGEST_BYTES).data)
    except ForeignFileError as error:
        raise AhrsdError(f"{path}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise AhrsdError(f"{path}: is not JSON: {error}") from error
    if not isinstance(body, dict) or body.get("schema") != "ahrsd.calibration/1":
        raise AhrsdError(f"{path}: is no calibration.json of `ahrsd calibrate`")
    if body.get("converged") is not True or not body.get("registers"):
        warnings = body.get("warnings")
        why = "; ".join(map(str, warnings)) if isinstance(warnings, list) else ""
        raise AhrsdError(f"{path}: it must not be written: {why or 'it has not converged'}")
    if not body.get("registers_in_force"):
        raise AhrsdError(
            f"{path}: it is not known which registers were in force at the recording; record with "
            "`ahrsd capture` or `ahrsd run`, which read them"
        )
    return body


def _registers_in(path: Path, body: Mapping[str, object], key: str) -> Changes:
    found, values = body[key], {}
    for number in (MAG, GYRO):
        row = found.get(str(number)) if isinstance(found, dict) else None
        if row is not None:
            try:
                values[number] = parse(number, [str(value) for value in row])
            except (RegisterValueError, TypeError) as error:
                raise AhrsdError(f"{path}: {key} {number}: {error}") from error
    missing = [n for n in (MAG, GYRO) if n not in values]
    if not values or (key == "registers_in_force" and missing):
        raise AhrsdError(f"{path}: {key} has no register {missing[0]}")
    return values


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
