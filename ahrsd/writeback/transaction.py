"""The procedures of a transaction: check, stage in RAM, roll back, save to flash.

Each procedure keeps the device's output paused and returns whether the device was as expected;
anything else is an error that the session reports. None of them undoes its changes: that is a
separate procedure, so that the gate can distinguish a rollback from a write.

The cable can be moved to another device between any two commands. So each procedure reads the
identity before it compares, before every attempt to write a register, and before the save: a
calibration of one device is never written to another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from ahrsd.writeback.journal_history import (
    Transaction,
)
from drivers.vn100.commands import (
    QUIET,
    WRITE_TRIES,
    NoReply,
    NotPermitted,
    Procedure,
    RestoreFailed,
    TooLate,
    VerifyFailed,
    Write,
    differences,
    quiet,
    read,
    read_configuration,
    read_registers,
    read_unit,
    restore,
    resume,
    save_settings,
)
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.registers import Unit, Values, parse, same

BEHIND_TRIES = 5  # to read the serial number and send the command immediately after it
HSI_RESULT = 47  # changes while the on-board estimator runs; not a setting


@dataclass(frozen=True, slots=True)
class ProcedureOutcome:
    """Result of a procedure: as expected, or which registers differ, or why not.

    other:   the unit that answered, if it was not the transaction's device
    written: whether a write may have gone out
    """

    as_expected: bool
    differing: tuple[int, ...] = ()
    why: str = ""
    other: Unit | None = None
    written: bool = False

    def __str__(self) -> str:
        if self.as_expected:
            return "as expected"
        if self.other is not None:
            return f"another device answers: {self.other}"
        return self.why or f"registers {', '.join(map(str, self.differing))} differ"


def check(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[ProcedureOutcome]:
    """Check that all registers are as the journal record says. Changes nothing.

    session_keys: settings that the daemon changed for the session; they may differ.
    """
    return quiet(_check(transaction, session_keys))


def stage(transaction: Transaction) -> Procedure[ProcedureOutcome]:
    """Write the new values and read back each; then read all of them and the identity.

    Nothing is written if the old values are no longer there.
    """
    return quiet(_stage(transaction))


def roll_back(
    transaction: Transaction, *, only_ours: bool, left: Mapping[int, Values] | None = None
) -> Procedure[ProcedureOutcome]:
    """Restore the old values and read them back; a register that has them is not written.

    Every register is tried before a failure is reported, even if the output of the device cannot be
    paused: that makes replies slower, but is no reason to leave values in the device.

    only_ours: nothing is written if a register holds neither the old nor the new value nor that
               in `left`, because another program wrote it then
    left:      by register, a value of ours as the device altered it
    """
    return _roll_back(transaction, only_ours, left or {})


def save(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[ProcedureOutcome]:
    """Restore session settings, compare every register, then VNWNV, which saves all of RAM.

    Only the registers of the transaction may differ from the user's values, and they must hold the
    new values; otherwise nothing is saved and the outcome says why. If an error is raised, VNWNV
    may have been carried out.
    """
    return quiet(_save(transaction, session_keys))


def _find_other_device(transaction: Transaction) -> Procedure[Unit | None]:
    """The unit that answers, if it is another device; read twice, as a reply may be damaged."""
    unit = yield from read_unit()
    if transaction.is_of(unit):
        return None
    unit = yield from read_unit()
    return None if transaction.is_of(unit) else unit


def _find_other_by_serial(transaction: Transaction) -> Procedure[Unit | None]:
    """The same for a procedure that has read the identity before: by serial number only."""
    if int((yield from read(3))[0]) == transaction.serial:
        return None
    return (yield from _find_other_device(transaction))


def _read_differences(expected: Mapping[int, Values]) -> Procedure[tuple[int, ...]]:
    """Registers that differ from the expected values in two readings."""
    changed = differences(expected, (yield from read_registers(expected)))
    if changed:
        changed = differences(expected, (yield from read_registers(expected)))
    return tuple(changed)


def _check(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[ProcedureOutcome]:
    if (other := (yield from _find_other_device(transaction))) is not None:
        return ProcedureOutcome(False, other=other)
    return (yield from _compare(transaction, transaction.old, session_keys))


def _compare(
    transaction: Transaction, expected: Mapping[int, Values], ignored: frozenset[int]
) -> Procedure[ProcedureOutcome]:
    now = yield from read_configuration(transaction.profile)
    wanted = {**transaction.snapshot, **expected}
    differing = tuple(sorted(differences(wanted, now).keys() - ignored - {HSI_RESULT}))
    return ProcedureOutcome(not differing, differing)


def _stage(transaction: Transaction) -> Procedure[ProcedureOutcome]:
    if (other := (yield from _find_other_device(transaction))) is not None:
        return ProcedureOutcome(False, other=other)
    if changed := (yield from _read_differences(transaction.old)):
        return ProcedureOutcome(False, changed)
    written = False
    for number, values in transaction.new.items():
        refused = yield from _write(transaction, number, transaction.old[number], values, written)
        if refused is not None:
            return refused
        written = True
    return (yield from _verify_all(transaction, transaction.new))


def _roll_back(
    transaction: Transaction, only_ours: bool, left: Mapping[int, Values]
) -> Procedure[ProcedureOutcome]:
    abandoned = False
    try:
        with suppress(NoReply, DeviceRefused):
            yield QUIET
        return (yield from _restore_old_values(transaction, only_ours, left))
    except GeneratorExit:  # dropped before its end: no command can be carried out
        abandoned = True
        raise
    finally:
        if not abandoned:
            with suppress(NoReply, DeviceRefused):  # only the registers matter for the outcome
                yield from resume()


def _verify_all(
    transaction: Transaction, expected: Mapping[int, Values]
) -> Procedure[ProcedureOutcome]:
    """Read identity and registers together, which shows a restart between two writes."""
    if (other := (yield from _find_other_by_serial(transaction))) is not None:
        return ProcedureOutcome(False, other=other, written=True)
    changed = yield from _read_differences(expected)
    return ProcedureOutcome(not changed, changed, written=True)


def _write(
    transaction: Transaction, number: int, before: Values, values: Values, written: bool
) -> Procedure[ProcedureOutcome | None]:
    """Write a register of the transaction's device; returns an outcome if another one answers.

    before: its value until now; written: whether something was written before

    Each attempt is one command, sent immediately after reading the serial number, so a device that
    takes over the cable after an attempt is not written. Another attempt is made only if the
    register still holds `before`: any other value is our value altered by the device, or was
    written by another program or restored by a restart. Raises VerifyFailed.
    """
    echo: list[Values] = []
    for attempt in range(1, WRITE_TRIES + 1):
        command = _make_single_write(number, values, echo)
        if (other := (yield from _run_after_serial_check(transaction, command))) is not None:
            return ProcedureOutcome(False, other=other, written=written)
        written = True
        back = yield from read(number)
        if not any(same(number, one, back[: len(one)]) for one in (before, values)):
            back = yield from read(number)  # a reply may be damaged
        if same(number, values, back[: len(values)]):
            return None
        if attempt == WRITE_TRIES or not same(number, before, back[: len(before)]):
            break
    echoed = any(same(number, one, back) for one in echo)
    raise VerifyFailed(number, values, back, attempt, echoed=echoed)


def _make_single_write(
    number: int, values: Values, echo: list[Values]
) -> Callable[[], Procedure[None]]:
    """A function that writes once; the device's reply is appended to `echo`."""

    def write() -> Procedure[None]:
        with suppress(NoReply):  # carried out or not: the read shows it
            reply = yield Write(number, values, once=True)
            echo.append(parse(number, reply.tokens))

    return write


def _run_after_serial_check(
    transaction: Transaction, make: Callable[[], Procedure[None]]
) -> Procedure[Unit | None]:
    """Carry out a change immediately after reading the serial number; returns another unit, if any.

    On a line that loses replies the number may be stale by then (TooLate), and is read again.
    Raises TooLate if no reply comes soon enough.
    """
    for left in reversed(range(BEHIND_TRIES)):
        if (other := (yield from _find_other_by_serial(transaction))) is not None:
            return other
        try:
            yield from make()
        except TooLate:
            if not left:
                raise
        else:
            return None
    return None


def _restore_old_values(
    transaction: Transaction, only_ours: bool, left: Mapping[int, Values]
) -> Procedure[ProcedureOutcome]:
    if (other := (yield from _find_other_by_serial(transaction))) is not None:
        return ProcedureOutcome(False, other=other)
    if only_ours and (strange := (yield from _find_foreign_values(transaction, left))):
        return ProcedureOutcome(False, strange)
    errors: dict[int, Exception] = {}
    for number, values in transaction.old.items():
        refused: ProcedureOutcome | None = None
        try:
            if not same(number, values, (held := (yield from read(number)))):
                refused = yield from _write(transaction, number, held, values, True)
        except (DeviceRefused, NoReply, TooLate, VerifyFailed) as error:
            errors[number] = error
        if refused is not None:
            return refused
    if errors:
        raise RestoreFailed(errors)
    return (yield from _verify_all(transaction, transaction.old))


def _find_foreign_values(
    transaction: Transaction, left: Mapping[int, Values]
) -> Procedure[tuple[int, ...]]:
    """Registers with neither the old nor the new value nor that in `left`, in two readings."""
    found: tuple[int, ...] = ()
    for _ in range(2):
        now = yield from read_registers(transaction.old)
        ours = [transaction.old, transaction.new, {**transaction.old, **left}]
        found = tuple(sorted(set.intersection(*(set(differences(own, now)) for own in ours))))
        if not found:
            return ()
    return found


def _save(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[ProcedureOutcome]:
    try:
        if (other := (yield from _find_other_device(transaction))) is not None:
            return ProcedureOutcome(False, other=other)
        yield from restore(transaction.snapshot, sorted(session_keys))
        outcome = yield from _compare(transaction, transaction.new, frozenset())
        if outcome.as_expected:
            outcome = yield from _verify_all(transaction, transaction.new)
    except (NotPermitted, RestoreFailed, NoReply, DeviceRefused) as error:
        return ProcedureOutcome(False, why=str(error))
    if outcome.as_expected:
        try:
            other = yield from _run_after_serial_check(
                transaction, partial(save_settings, behind=True)
            )
        except (NotPermitted, TooLate) as error:
            return ProcedureOutcome(False, why=str(error))
        if other is not None:
            return ProcedureOutcome(False, other=other)
    return outcome
