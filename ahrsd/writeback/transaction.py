"""One transaction: what it changes, its record in the journal, and its conversations with a device.

Each conversation keeps the device's output paused while it lasts and returns whether the device
was as expected; everything else is an error that the session reports. None of them undoes what it
did: that is a conversation of its own, so that the gate knows a rollback from a write.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ahrsd.writeback.composition import register_lines
from drivers.vn100.commands import QUIET, NoReply, NotPermitted, Procedure
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.firmware import Profile, profile_of
from drivers.vn100.procedures import (
    SESSION_SETTINGS,
    RestoreFailed,
    differences,
    quiet,
    read_configuration,
    read_registers,
    restore,
    resume,
    save_settings,
    write_verified,
)
from drivers.vn100.registers import Values

HSI_RESULT = 47  # changes by itself while the on-board estimator runs; nobody's setting


@dataclass(frozen=True, slots=True)
class Transaction:
    """What a write changes. `old` and `new` have the same registers.

    snapshot: every configuration register as the user has it, before the daemon touched anything
    approver: who said yes: "operator" or "auto"
    """

    id: str
    serial: int
    firmware: str
    old: dict[int, Values]
    new: dict[int, Values]
    snapshot: dict[int, Values]
    heading_change_deg: float
    approver: str

    @property
    def profile(self) -> Profile:
        """The firmware's profile."""
        return profile_of(self.firmware)

    def facts(self) -> dict[str, Any]:
        """As the journal holds it, with lines that a person can type to go back."""
        return {
            "txn": self.id,
            "serial": self.serial,
            "firmware": self.firmware,
            "old": _to_json(self.old),
            "new": _to_json(self.new),
            "snapshot": _to_json(self.snapshot),
            "heading_change_deg": self.heading_change_deg,
            "approver": self.approver,
            "lines_old": list(register_lines(self.old)),
            "lines_new": list(register_lines(self.new)),
        }

    @staticmethod
    def from_facts(facts: Mapping[str, Any]) -> Transaction:
        """Back from a PREPARED record; KeyError, TypeError or ValueError where it is not one."""
        return Transaction(
            id=str(facts["txn"]),
            serial=int(facts["serial"]),
            firmware=str(facts["firmware"]),
            old=_from_json(facts["old"]),
            new=_from_json(facts["new"]),
            snapshot=_from_json(facts["snapshot"]),
            heading_change_deg=float(facts["heading_change_deg"]),
            approver=str(facts["approver"]),
        )


def _to_json(registers: Mapping[int, Values]) -> dict[str, list[float | int | str]]:
    return {str(number): list(values) for number, values in sorted(registers.items())}


def _from_json(registers: Mapping[str, list[float | int | str]]) -> dict[int, Values]:
    return {int(number): tuple(values) for number, values in registers.items()}


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a conversation ended: as expected, or which registers were not, or what was refused."""

    as_expected: bool
    differing: tuple[int, ...] = ()
    why: str = ""

    def __str__(self) -> str:
        if self.as_expected:
            return "as expected"
        return self.why or f"registers {', '.join(map(str, self.differing))} differ"


def check(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[Outcome]:
    """Everything is still as the journal will say it was. Changes nothing.

    session_keys: settings that the daemon itself changed for the session; they may differ.
    """
    return quiet(_compare(transaction, transaction.old, session_keys))


def stage(transaction: Transaction) -> Procedure[Outcome]:
    """Write the new values, each read back; nothing is written where the old ones are gone."""
    return quiet(_stage(transaction))


def roll_back(transaction: Transaction) -> Procedure[Outcome]:
    """The old values again, read back; a register that has them is not written.

    Every register is tried before a failure is reported, and all of them also where the device does
    not let its output be paused: that makes replies slower, and is no reason to leave values in it.
    """
    return _roll_back(transaction)


def save(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[Outcome]:
    """VNWNV saves all of RAM, so: session settings put back, every register compared, then VNWNV.

    Only the registers of the transaction may differ from what the user had, and they must hold the
    new values; otherwise nothing is saved and the outcome says why. An error that is raised means
    that VNWNV may have been carried out.
    """
    return quiet(_save(transaction, session_keys))


def _compare(
    transaction: Transaction, expected: Mapping[int, Values], ignored: frozenset[int]
) -> Procedure[Outcome]:
    now = yield from read_configuration(transaction.profile)
    wanted = {**transaction.snapshot, **expected}
    differing = tuple(sorted(differences(wanted, now).keys() - ignored - {HSI_RESULT}))
    return Outcome(not differing, differing)


def _stage(transaction: Transaction) -> Procedure[Outcome]:
    now = yield from read_registers(transaction.new)
    if changed := differences(transaction.old, now):
        return Outcome(False, tuple(changed))
    for number, values in transaction.new.items():
        yield from write_verified(number, values)
    return Outcome(True)


def _roll_back(transaction: Transaction) -> Procedure[Outcome]:
    abandoned = False
    try:
        with suppress(NoReply, DeviceRefused):
            yield QUIET
        yield from restore(transaction.old, transaction.old)
    except GeneratorExit:  # dropped without an end: nobody is there to carry out a command
        abandoned = True
        raise
    finally:
        if not abandoned:
            with suppress(NoReply, DeviceRefused):  # the registers are what the outcome is about
                yield from resume()
    return Outcome(True)


def _save(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[Outcome]:
    keys = [number for number in SESSION_SETTINGS if number in session_keys]
    try:
        yield from restore(transaction.snapshot, keys)
        outcome = yield from _compare(transaction, transaction.new, frozenset())
    except (NotPermitted, RestoreFailed, NoReply, DeviceRefused) as error:
        return Outcome(False, why=str(error))
    if outcome.as_expected:
        try:
            yield from save_settings()
        except NotPermitted as error:
            return Outcome(False, why=str(error))
    return outcome
