"""Changing registers by hand with the same care as the daemon: journal first, verify, undo.

    HAND_PREPARED     device, old and new values, durable before a byte is sent
    HAND_VERIFIED     written and read back equal
    HAND_FAILED       refused or not equal; what was written is put back, `restored` says whether
    HAND_FLASH_SENT   VNWNV is about to be sent
    HAND_FLASH_ACKED  the device acknowledged it

The daemon's own kinds (`writeback.reconcile`) promise more, gates and a trial, so these are others.
"""

from __future__ import annotations

from collections.abc import Callable

from ahrsd.cli.device.access import describe
from ahrsd.daemon import host_clock
from ahrsd.daemon.journal import Journal, Record, register_values
from ahrsd.errors import DeviceError
from drivers.serial_port import PortError
from drivers.vn100.commands import (
    Command,
    Identity,
    Procedure,
    Read,
    Word,
    Write,
    quiet,
    read_registers,
    restore,
    save_settings,
    write_verified,
)
from drivers.vn100.device import Device
from drivers.vn100.errors import DriverError
from drivers.vn100.registers import Values, same

Changes = dict[int, Values]


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
    Raises JournalError before anything is sent, DeviceError with the outcome of putting back.
    """
    old = device.run(read_registers(changes))
    prepared = _append(
        journal,
        "HAND_PREPARED",
        device=describe(identity),
        old=_texts(old),
        new=_texts(changes),
        **why,
    )
    try:
        device.run(quiet(_write_all(changes, held="undoes" in why)))
    except (DriverError, PortError) as error:
        restored = _put_back(device, old)
        _append(journal, "HAND_FAILED", txn=prepared.seq, error=str(error), restored=not restored)
        outcome = f"NOT put back: {restored}" if restored else "the old values are back"
        raise DeviceError(f"{error}; {outcome}") from error
    _append(journal, "HAND_VERIFIED", txn=prepared.seq)
    return prepared


def save_to_flash(device: Device, journal: Journal, prepared: Record) -> None:
    """VNWNV: everything that is in RAM becomes what the device starts with."""
    expected = register_values(prepared, "new")
    present = device.run(read_registers(expected))
    if changed := to_write(present, expected):
        raise DeviceError(f"register {min(changed)} no longer holds what was written; not saved")
    _append(journal, "HAND_FLASH_SENT", txn=prepared.seq)
    device.run(quiet(save_settings()))
    _append(journal, "HAND_FLASH_ACKED", txn=prepared.seq)


def _append(journal: Journal, kind: str, **facts: object) -> Record:
    """A record with the time by every clock."""
    return journal.append(kind, **{**host_clock.stamp(), **facts})


def _write_all(changes: Changes, held: bool) -> Procedure[None]:
    for number, values in changes.items():
        yield from write_verified(number, values, held=held)


def _put_back(device: Device, old: Changes) -> str:
    """Whatever differs from `old` gets it again; "" or why that failed."""
    try:
        device.run(quiet(restore(old, old)))
    except (DriverError, PortError) as error:
        return str(error)
    return ""


def _texts(values: Changes) -> dict[str, list[float | int | str]]:
    return {str(number): list(row) for number, row in values.items()}
