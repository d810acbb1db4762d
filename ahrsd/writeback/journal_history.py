"""What the journal of one device amounts to: the open transaction, the budget, the locks.

Built record by record, in the same way from a file at the start and from each new record later, so
a restart can never change what the write-back believes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

from ahrsd.writeback.clocks import UNKNOWN, Stamp
from ahrsd.writeback.reconcile import OF_OTHERS, OPEN, RecordKind
from ahrsd.writeback.transaction import Transaction
from drivers.vn100.registers import Values, same

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
    broken: str | None = None

    @staticmethod
    def of(records: Iterable[JournalRecord]) -> JournalHistory:
        """The history that these records tell, oldest first."""
        history = JournalHistory()
        for record in records:
            if record.kind in RecordKind.__members__:
                history = history.with_record(RecordKind(record.kind), record.facts)
            elif record.kind == BY_HAND:
                history = history._with_values(record.facts)
        return history

    def with_record(self, kind: RecordKind, facts: Mapping[str, Any]) -> JournalHistory:
        """The history after one more record."""
        if kind in OF_OTHERS:
            return self
        at = Stamp.of(facts)
        now = replace(self, newest_at=at)
        if kind is RecordKind.CLIENT_WRITES:  # in RAM: the next start may bring either value
            return now._with_values(facts)._not_sure_of(facts)
        if kind is RecordKind.LOCKED:
            return replace(now, locked=str(facts.get("reason", "no reason given")))
        if kind is RecordKind.UNLOCKED:
            return replace(now, locked=None, torn=False, rollbacks=0)
        if kind is RecordKind.PREPARED:
            try:
                transaction = Transaction.from_facts(facts)
            except (KeyError, TypeError, ValueError):
                return replace(now, broken=kind.value)
            begun = replace(now, open=transaction, last=kind, last_at=at, holds=None)
            return begun._with_values(facts)
        return now._counted(kind, facts, at)._with_transaction_at(kind, facts, at)

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
        holds = self.holds
        if kind in _HOLDS_NEW:
            holds = self.open.new
        elif kind in _HOLDS_OLD:
            saved = kind is RecordKind.REVERTED and self.last in (
                RecordKind.FLASH_SENT,
                RecordKind.FLASH_ACKED,
            )
            holds = None if saved else self.open.old  # the next start may bring either
        torn = self.torn or kind is RecordKind.FLASH_TORN
        still_open = self.open if kind in OPEN else None
        return replace(self, open=still_open, last=kind, last_at=at, holds=holds, torn=torn)


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
