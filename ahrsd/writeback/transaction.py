"""A transaction and the journal: what it changes, its procedures, what a device's records amount
to.

Each procedure keeps the device's output paused while it lasts and returns whether the device
was as expected; everything else is an error that the session reports. None of them undoes what it
did: that is a procedure of its own, so that the gate knows a rollback from a write.

A cable can be moved to another device between any two commands. So each procedure asks who
answers before it compares, before every attempt to write a register, and before the save; what is
judged of one device is never written into another.

**What the journal amounts to** (`JournalHistory`): the open transaction, the budget, the locks.
Built record by record, in the same way from a file at the start and from each new record later, so
a restart can never change what the write-back believes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Protocol

from ahrsd.writeback.clocks import UNKNOWN, Stamp
from ahrsd.writeback.composition import register_lines
from ahrsd.writeback.reconcile import OF_OTHERS, OPEN, RecordKind
from drivers.vn100.commands import QUIET, NoReply, NotPermitted, Procedure, TooLate, Write
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.firmware import Profile, profile_of
from drivers.vn100.procedures import (
    WRITE_TRIES,
    RestoreFailed,
    Unit,
    VerifyFailed,
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
from drivers.vn100.registers import Values, parse, same

# -- One transaction -------------------------------------------------------------------------------


BEHIND_TRIES = 5  # to have a serial number and the command right behind it
HSI_RESULT = 47  # changes by itself while the on-board estimator runs; nobody's setting


@dataclass(frozen=True, slots=True)
class Transaction:
    """What a write changes. `old` and `new` have the same registers.

    snapshot: every configuration register as the user has it, before the daemon touched anything
    approver: who said yes: "operator" or "auto"
    model:    of the device; empty in records from before it was kept
    """

    id: str
    serial: int
    firmware: str
    old: dict[int, Values]
    new: dict[int, Values]
    snapshot: dict[int, Values]
    heading_change_deg: float
    approver: str
    model: str = ""

    def is_of(self, unit: Unit) -> bool:
        """Whether this is the device that was judged."""
        return unit == Unit(self.model or unit.model, self.serial, self.firmware)

    @property
    def profile(self) -> Profile:
        """The firmware's profile."""
        return profile_of(self.firmware)

    def facts(self) -> dict[str, Any]:
        """As the journal holds it, with lines that a person can type to go back."""
        return {
            "txn": self.id,
            "serial": self.serial,
            "model": self.model,
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
            model=str(facts.get("model", "")),
        )


def _to_json(registers: Mapping[int, Values]) -> dict[str, list[float | int | str]]:
    return {str(number): list(values) for number, values in sorted(registers.items())}


def _from_json(registers: Mapping[str, list[float | int | str]]) -> dict[int, Values]:
    return {int(number): tuple(values) for number, values in registers.items()}


@dataclass(frozen=True, slots=True)
class ProcedureOutcome:
    """How a procedure ended: as expected, or which registers were not, or what was refused.

    other:   who answered, where it was not the transaction's device
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
    """Everything is still as the journal will say it was. Changes nothing.

    session_keys: settings that the daemon itself changed for the session; they may differ.
    """
    return quiet(_check(transaction, session_keys))


def stage(transaction: Transaction) -> Procedure[ProcedureOutcome]:
    """Write the new values, each read back, then all of them together with who answers.

    Nothing is written where the old values are gone.
    """
    return quiet(_stage(transaction))


def roll_back(
    transaction: Transaction, *, only_ours: bool, left: Mapping[int, Values] | None = None
) -> Procedure[ProcedureOutcome]:
    """The old values again, read back; a register that has them is not written.

    Every register is tried before a failure is reported, and all of them also where the device does
    not let its output be paused: that makes replies slower, and is no reason to leave values in it.

    only_ours: nothing is written where a register holds neither the old nor the new value, nor
               what is `left`, for then somebody else wrote it
    left:      by register, what the device made of a value of ours
    """
    return _roll_back(transaction, only_ours, left or {})


def save(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[ProcedureOutcome]:
    """VNWNV saves all of RAM, so: session settings put back, every register compared, then VNWNV.

    Only the registers of the transaction may differ from what the user had, and they must hold the
    new values; otherwise nothing is saved and the outcome says why. An error that is raised means
    that VNWNV may have been carried out.
    """
    return quiet(_save(transaction, session_keys))


def _other(transaction: Transaction) -> Procedure[Unit | None]:
    """Who answers, where it is another device; asked twice, for a reply may be altered."""
    unit = yield from read_unit()
    if transaction.is_of(unit):
        return None
    unit = yield from read_unit()
    return None if transaction.is_of(unit) else unit


def _other_by_serial(transaction: Transaction) -> Procedure[Unit | None]:
    """The same within a procedure that has asked already: the serial number is enough."""
    if int((yield from read(3))[0]) == transaction.serial:
        return None
    return (yield from _other(transaction))


def _changed(expected: Mapping[int, Values]) -> Procedure[tuple[int, ...]]:
    """Registers that do not hold what is expected, in two readings."""
    changed = differences(expected, (yield from read_registers(expected)))
    if changed:
        changed = differences(expected, (yield from read_registers(expected)))
    return tuple(changed)


def _check(transaction: Transaction, session_keys: frozenset[int]) -> Procedure[ProcedureOutcome]:
    if (other := (yield from _other(transaction))) is not None:
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
    if (other := (yield from _other(transaction))) is not None:
        return ProcedureOutcome(False, other=other)
    if changed := (yield from _changed(transaction.old)):
        return ProcedureOutcome(False, changed)
    written = False
    for number, values in transaction.new.items():
        refused = yield from _write(transaction, number, transaction.old[number], values, written)
        if refused is not None:
            return refused
        written = True
    return (yield from _read_all_back(transaction, transaction.new))


def _roll_back(
    transaction: Transaction, only_ours: bool, left: Mapping[int, Values]
) -> Procedure[ProcedureOutcome]:
    abandoned = False
    try:
        with suppress(NoReply, DeviceRefused):
            yield QUIET
        return (yield from _put_back(transaction, only_ours, left))
    except GeneratorExit:  # dropped without an end: nobody is there to carry out a command
        abandoned = True
        raise
    finally:
        if not abandoned:
            with suppress(NoReply, DeviceRefused):  # the registers are what the outcome is about
                yield from resume()


def _read_all_back(
    transaction: Transaction, expected: Mapping[int, Values]
) -> Procedure[ProcedureOutcome]:
    """Both registers in one reading, and whose they are: a restart between two writes shows."""
    if (other := (yield from _other_by_serial(transaction))) is not None:
        return ProcedureOutcome(False, other=other, written=True)
    changed = yield from _changed(expected)
    return ProcedureOutcome(not changed, changed, written=True)


def _write(
    transaction: Transaction, number: int, before: Values, values: Values, written: bool
) -> Procedure[ProcedureOutcome | None]:
    """Write a register of the transaction's device; the outcome where another one answers.

    before: what it held until now; written: whether something was written before

    Each attempt is one command, and who answers is asked right before it: what takes over the cable
    in the silence behind an attempt is not written. There is another attempt only where the
    register still holds what it held: anything else is what the device made of the values, or
    what somebody wrote or a restart brought back. Raises VerifyFailed.
    """
    echo: list[Values] = []
    for attempt in range(1, WRITE_TRIES + 1):
        command = _written_once(number, values, echo)
        if (other := (yield from _right_behind(transaction, command))) is not None:
            return ProcedureOutcome(False, other=other, written=written)
        written = True
        back = yield from read(number)
        if not any(same(number, one, back[: len(one)]) for one in (before, values)):
            back = yield from read(number)  # a reply may be altered
        if same(number, values, back[: len(values)]):
            return None
        if attempt == WRITE_TRIES or not same(number, before, back[: len(before)]):
            break
    echoed = any(same(number, one, back) for one in echo)
    raise VerifyFailed(number, values, back, attempt, echoed=echoed)


def _written_once(number: int, values: Values, echo: list[Values]) -> Callable[[], Procedure[None]]:
    """The write, as often as asked; what the device answered goes into `echo`."""

    def write() -> Procedure[None]:
        with suppress(NoReply):  # carried out or not: a read says which
            reply = yield Write(number, values, once=True)
            echo.append(parse(number, reply.tokens))

    return write


def _right_behind(
    transaction: Transaction, make: Callable[[], Procedure[None]]
) -> Procedure[Unit | None]:
    """Carry out what changes the device right behind its serial number; the unit that is another.

    On a line that loses answers the number may be old by then: TooLate, and it is asked again.
    Raises TooLate where no answer comes soon enough.
    """
    for left in reversed(range(BEHIND_TRIES)):
        if (other := (yield from _other_by_serial(transaction))) is not None:
            return other
        try:
            yield from make()
        except TooLate:
            if not left:
                raise
        else:
            return None
    return None


def _put_back(
    transaction: Transaction, only_ours: bool, left: Mapping[int, Values]
) -> Procedure[ProcedureOutcome]:
    if (other := (yield from _other_by_serial(transaction))) is not None:
        return ProcedureOutcome(False, other=other)
    if only_ours and (strange := (yield from _foreign_values(transaction, left))):
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
    return (yield from _read_all_back(transaction, transaction.old))


def _foreign_values(
    transaction: Transaction, left: Mapping[int, Values]
) -> Procedure[tuple[int, ...]]:
    """Registers that hold neither the old nor the new value nor what is left, in two readings."""
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
        if (other := (yield from _other(transaction))) is not None:
            return ProcedureOutcome(False, other=other)
        yield from restore(transaction.snapshot, sorted(session_keys))
        outcome = yield from _compare(transaction, transaction.new, frozenset())
        if outcome.as_expected:
            outcome = yield from _read_all_back(transaction, transaction.new)
    except (NotPermitted, RestoreFailed, NoReply, DeviceRefused) as error:
        return ProcedureOutcome(False, why=str(error))
    if outcome.as_expected:
        try:
            other = yield from _right_behind(transaction, partial(save_settings, behind=True))
        except (NotPermitted, TooLate) as error:
            return ProcedureOutcome(False, why=str(error))
        if other is not None:
            return ProcedureOutcome(False, other=other)
    return outcome


# -- What the journal of one device amounts to -----------------------------------------------------


TIMES_KEPT: Final = 1000  # far more than any budget allows in a day
BY_HAND: Final = "HAND_PREPARED"  # a write of the registers command

_TOUCHED_RAM: Final = (RecordKind.RAM_VERIFIED, RecordKind.RAM_FAILED, RecordKind.ROLLBACK)
_HOLDS_NEW: Final = (RecordKind.FLASH_ACKED, RecordKind.CONFIRMED)
_HOLDS_OLD: Final = (
    RecordKind.ABORTED,
    RecordKind.ROLLED_BACK,
    RecordKind.REVERTED,
    RecordKind.LOST,
    RecordKind.NOT_SAVED,
)


class JournalRecord(Protocol):
    """One record, as the journal gives it back."""

    @property
    def kind(self) -> str:
        """One of `RecordKind`; others (of other commands) are passed over."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """What was recorded; `clocks.Stamp` reads the time from it."""


@dataclass(frozen=True, slots=True)
class StoredRecord:
    """A journal record out of `JournalOpened`."""

    kind: str
    facts: dict[str, Any]

    @staticmethod
    def of(body: Mapping[str, Any]) -> StoredRecord:
        """From `JournalOpened.records`."""
        return StoredRecord(str(body["kind"]), dict(body["facts"]))


@dataclass(frozen=True, slots=True)
class JournalHistory:
    """A journal, summed up.

    open:      the transaction that no record ended yet, the kind and time of its newest record
    newest_at: the time of the newest record of any kind
    rollbacks: since the last proven write or unlock; each says that a calibration was bad
    holds:     what the device must hold after the newest transaction, where that is known
    values:    registers and values that a write found or meant, also one by hand
    trials:    registers and values that a write meant, and that no save of ours nor a person kept
    broken:    the kind of a record that could not be understood; then nothing may be written
    """

    open: Transaction | None = None
    last: RecordKind | None = None
    last_at: Stamp = UNKNOWN
    newest_at: Stamp = UNKNOWN
    ram_writes_at: tuple[Stamp, ...] = ()
    flashes_at: tuple[Stamp, ...] = ()
    flashes: int = 0
    rollbacks: int = 0
    rollback_at: Stamp | None = None
    locked: str | None = None
    torn: bool = False
    holds: dict[int, Values] | None = None
    values: tuple[tuple[int, Values], ...] = ()
    trials: tuple[tuple[int, Values], ...] = ()
    broken: str | None = None

    @staticmethod
    def of(records: Iterable[JournalRecord]) -> JournalHistory:
        """The history that these records tell, oldest first."""
        history = JournalHistory()
        for record in records:
            if record.kind in RecordKind.__members__:
                history = history.with_record(RecordKind(record.kind), record.facts)
            elif record.kind == BY_HAND:
                history = history._with_values(record.facts)._without_trials(record.facts)
        return history

    def with_record(self, kind: RecordKind, facts: Mapping[str, Any]) -> JournalHistory:
        """The history after one more record."""
        if kind in OF_OTHERS:
            return self
        at = Stamp.of(facts)
        now = replace(self, newest_at=at)
        if kind is RecordKind.CLIENT_WRITES:  # in RAM: the next start may bring either value
            return now._with_values(facts)._not_sure_of(facts)._without_trials(facts)
        if kind is RecordKind.LOCKED:
            return replace(now, locked=str(facts.get("reason", "no reason given")))
        if kind is RecordKind.UNLOCKED:
            return replace(now, locked=None, torn=False, rollbacks=0, trials=())
        if kind is RecordKind.PREPARED:
            try:
                return now._begun(Transaction.from_facts(facts), at)._with_values(facts)
            except (KeyError, TypeError, ValueError):
                return replace(now, broken=kind.value)
        return now._counted(kind, facts, at)._with_transaction_at(kind, facts, at)

    def tried(self, number: int, values: Values) -> bool:
        """Whether a write meant this register to have these values, and nothing kept them."""
        return any(n == number and same(n, known, values) for n, known in self.trials)

    def knows(self, number: int, values: Values) -> bool:
        """Whether a record has these values of this register, as found or as meant."""
        return any(n == number and same(n, known, values) for n, known in self.values)

    def _with_values(self, facts: Mapping[str, Any]) -> JournalHistory:
        try:
            found = [
                (int(number), tuple(row))
                for which in ("old", "new")
                for number, row in facts[which].items()
            ]
        except (KeyError, TypeError, ValueError, AttributeError):
            return self
        return replace(self, values=tuple(dict.fromkeys((*self.values, *found)))[-TIMES_KEPT:])

    def _begun(self, transaction: Transaction, at: Stamp) -> JournalHistory:
        """With this transaction open. KeyError or ValueError where its values are no registers'."""
        changed = [(n, v) for n, v in transaction.new.items() if not same(n, v, transaction.old[n])]
        trials = (*self.trials, *((n, v) for n, v in changed if not self.tried(n, v)))
        return replace(
            self, open=transaction, last=RecordKind.PREPARED, last_at=at, holds=None,
            trials=trials[-TIMES_KEPT:],
        )  # fmt: skip

    def _without_trials(self, facts: Mapping[str, Any]) -> JournalHistory:
        """Somebody wrote these values: they are that person's, or program's."""
        try:
            return replace(self, trials=_without(self.trials, _from_json(facts["new"])))
        except (KeyError, TypeError, ValueError, AttributeError):
            return self

    def _not_sure_of(self, facts: Mapping[str, Any]) -> JournalHistory:
        written = {str(number) for number in facts.get("new", ())}
        left = {n: v for n, v in (self.holds or {}).items() if str(n) not in written}
        return replace(self, holds=left or None)

    def _counted(self, kind: RecordKind, facts: Mapping[str, Any], at: Stamp) -> JournalHistory:
        """Budgets and rollbacks."""
        changes: dict[str, Any] = {}
        if kind in _TOUCHED_RAM and self.last is RecordKind.PREPARED:
            changes["ram_writes_at"] = (*self.ram_writes_at, at)[-TIMES_KEPT:]
        if kind is RecordKind.FLASH_SENT:
            changes["flashes_at"] = (*self.flashes_at, at)[-TIMES_KEPT:]
            changes["flashes"] = self.flashes + 1
        if kind is RecordKind.PROVEN:
            changes["rollbacks"] = 0
        if (
            kind is RecordKind.PROVEN and self.last is RecordKind.FLASH_SENT
        ):  # it was not sent after all
            changes["flashes_at"] = self.flashes_at[:-1]
            changes["flashes"] = self.flashes - 1
        if kind is RecordKind.ROLLBACK and facts.get("counts"):
            changes["rollbacks"] = self.rollbacks + 1
            changes["rollback_at"] = at
        return replace(self, **changes)

    def _with_transaction_at(
        self, kind: RecordKind, facts: Mapping[str, Any], at: Stamp
    ) -> JournalHistory:
        """Where the open transaction stands; a record of another one says nothing about it."""
        if self.open is None or facts.get("txn", self.open.id) != self.open.id:
            return self
        holds, trials = self.holds, self.trials
        if kind in _HOLDS_NEW:
            holds = self.open.new
            trials = _without(trials, self.open.new)
        elif kind in _HOLDS_OLD:
            saved = kind is RecordKind.REVERTED and self.last in (
                RecordKind.FLASH_SENT,
                RecordKind.FLASH_ACKED,
            )
            holds = None if saved else self.open.old  # the next start may bring either
        torn = self.torn or kind is RecordKind.FLASH_TORN
        still_open = self.open if kind in OPEN else None
        return replace(
            self, open=still_open, last=kind, last_at=at, holds=holds, trials=trials, torn=torn
        )


def _without(
    trials: Iterable[tuple[int, Values]], kept: Mapping[int, Values]
) -> tuple[tuple[int, Values], ...]:
    return tuple((n, v) for n, v in trials if n not in kept or not same(n, kept[n], v))


def of_another_device(records: Iterable[JournalRecord], serial: int) -> str:
    """Which record is of a device with another serial number; empty where none is."""
    for number, record in enumerate(records, start=1):
        device = record.facts.get("device")
        theirs = record.facts.get(
            "serial", device.get("serial") if isinstance(device, dict) else None
        )
        if theirs is not None and str(theirs) != str(serial):
            return f"record {number} is of the device {theirs}, and this is {serial}"
    return ""
