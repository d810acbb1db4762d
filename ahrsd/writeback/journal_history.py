"""What the journal of one device amounts to: the open transaction, the budget, the locks.

Built record by record, in the same way from a file at the start and from each new record later, so
a restart can never change what the write-back believes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

from ahrsd.writeback.reconcile import OF_OUTPUTS, OPEN, Kind
from ahrsd.writeback.transaction import Transaction
from drivers.vn100.registers import Values

TIMES_KEPT: Final = 1000  # far more than any budget allows in a day

_TOUCHED_RAM: Final = (Kind.RAM_VERIFIED, Kind.RAM_FAILED, Kind.ROLLBACK)
_HOLDS_NEW: Final = (Kind.FLASH_ACKED, Kind.CONFIRMED)
_HOLDS_OLD: Final = (Kind.ABORTED, Kind.ROLLED_BACK, Kind.LOST, Kind.NOT_SAVED)


class JournalRecord(Protocol):
    """One record, as the journal gives it back."""

    @property
    def kind(self) -> str:
        """One of `Kind`; others (of other commands) are passed over."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """What was recorded; `wall_s` is the wall clock in seconds."""


@dataclass(frozen=True, slots=True)
class History:
    """A journal, summed up. Times are wall-clock seconds.

    open:      the transaction that no record ended yet, and its newest record's kind
    rollbacks: since the last proven write or unlock; each says that a calibration was bad
    holds:     what the device must hold after the newest transaction, where that is known
    broken:    the kind of a record that could not be understood; then nothing may be written
    """

    open: Transaction | None = None
    last: Kind | None = None
    last_wall_s: float = 0.0
    ram_writes_wall_s: tuple[float, ...] = ()
    flashes_wall_s: tuple[float, ...] = ()
    flashes: int = 0
    rollbacks: int = 0
    last_rollback_wall_s: float | None = None
    locked: str | None = None
    torn: bool = False
    holds: dict[int, Values] | None = None
    broken: str | None = None

    @staticmethod
    def of(records: Iterable[JournalRecord]) -> History:
        """The history that these records tell, oldest first."""
        history = History()
        for record in records:
            if record.kind in Kind.__members__:
                history = history.with_record(Kind(record.kind), record.facts)
        return history

    def with_record(self, kind: Kind, facts: Mapping[str, Any]) -> History:
        """The history after one more record."""
        if kind in OF_OUTPUTS:
            return self
        wall_s = float(facts.get("wall_s", 0.0))
        if kind is Kind.LOCKED:
            return replace(self, locked=str(facts.get("reason", "no reason given")))
        if kind is Kind.UNLOCKED:
            return replace(self, locked=None, torn=False, rollbacks=0)
        if kind is Kind.PREPARED:
            try:
                transaction = Transaction.from_facts(facts)
            except (KeyError, TypeError, ValueError):
                return replace(self, broken=kind.value)
            return replace(self, open=transaction, last=kind, last_wall_s=wall_s, holds=None)
        return self._counted(kind, facts, wall_s)._moved(kind, wall_s)

    def _counted(self, kind: Kind, facts: Mapping[str, Any], wall_s: float) -> History:
        """Budgets and rollbacks."""
        changes: dict[str, Any] = {}
        if kind in _TOUCHED_RAM and self.last is Kind.PREPARED:
            changes["ram_writes_wall_s"] = (*self.ram_writes_wall_s, wall_s)[-TIMES_KEPT:]
        if kind is Kind.FLASH_SENT:
            changes["flashes_wall_s"] = (*self.flashes_wall_s, wall_s)[-TIMES_KEPT:]
            changes["flashes"] = self.flashes + 1
        if kind is Kind.PROVEN:
            changes["rollbacks"] = 0
        if kind is Kind.PROVEN and self.last is Kind.FLASH_SENT:  # it was not sent after all
            changes["flashes_wall_s"] = self.flashes_wall_s[:-1]
            changes["flashes"] = self.flashes - 1
        if kind is Kind.ROLLBACK and facts.get("counts"):
            changes["rollbacks"] = self.rollbacks + 1
            changes["last_rollback_wall_s"] = wall_s
        return replace(self, **changes)

    def _moved(self, kind: Kind, wall_s: float) -> History:
        """Where the open transaction stands."""
        if self.open is None:
            return self
        holds = self.holds
        if kind in _HOLDS_NEW:
            holds = self.open.new
        elif kind in _HOLDS_OLD:
            holds = self.open.old
        torn = self.torn or kind is Kind.FLASH_TORN
        still_open = self.open if kind in OPEN else None
        return replace(self, open=still_open, last=kind, last_wall_s=wall_s, holds=holds, torn=torn)
