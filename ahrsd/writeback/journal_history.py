"""Summary of a device's journal: kinds and times of its records, transactions, history.

`JournalHistory` is the summary: the open transaction, the budget, the locks. It is built record by
record, in the same way from a file at the start and from each new record later, so a restart can
never change the state of the write-back.

**Times** (`Stamp`) prove a restart and give the age of a record. A record is stamped by three
clocks. The wall clock can be wrong by any amount and can be set at any moment. The time since the
host's boot (CLOCK_BOOTTIME) cannot be set, but is only valid within one boot, identified by the
boot id. The device's own time since its start-up falls if, and only if, the device restarts.

* A restart of the device is proven within one boot of the host by boottime and the device's time,
  across boots by the device's time alone. The wall clock is never used.
* The age of a budgeted write is a lower bound from all clocks. Within one boot it is boottime,
  reduced if the wall clock shows less. Across boots the host has been up at least since its boot,
  and the wall clock counts less `WALL_ERROR_S`, and only if both of its readings are plausible (a
  computer without a battery starts in 1970 or 2000).

A record without boot id is of another boot: old journals and recordings have none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final, Protocol

from drivers.vn100.registers import Profile, Unit, Values, profile_of, register_lines, same

# -- Times of records ------------------------------------------------------------------------------


PLAUSIBLE_FROM_S: Final = 1577836800.0  # 2020: a wall clock before that was never set
WALL_ERROR_S: Final = 7500.0  # one hour slow then and one hour fast now, plus some minutes
LATENCY_S: Final = 0.5  # longest delay of a message from the device
CLOCK_RATE: Final = 1e-3  # largest relative error of a device's clock against the host's


@dataclass(frozen=True, slots=True)
class Stamp:
    """One moment by all available clocks; None or "": unknown.

    boot_s:   time since the host's boot `boot_id`
    device_s: the device's own time since its start-up, at most: its newest sample
    """

    wall_s: float | None = None
    boot_id: str = ""
    boot_s: float | None = None
    device_s: float | None = None

    @staticmethod
    def of(facts: Mapping[str, Any]) -> Stamp:
        """From a journal record; missing or invalid values become unknown."""
        boot_id = facts.get("boot_id")
        return Stamp(
            wall_s=_finite_or_none(facts.get("wall_s")),
            boot_id=boot_id if isinstance(boot_id, str) else "",
            boot_s=_finite_or_none(facts.get("boot_s")),
            device_s=_finite_or_none(facts.get("device_s")),
        )

    def facts(self) -> dict[str, Any]:
        """For a journal record."""
        return {
            "wall_s": self.wall_s,
            "boot_id": self.boot_id,
            "boot_s": self.boot_s,
            "device_s": self.device_s,
        }


UNKNOWN: Final = Stamp()


@dataclass(frozen=True, slots=True)
class Now:
    """The present by the same clocks; `run_s`: time since this run read the whole journal."""

    stamp: Stamp
    run_s: float = 0.0


def _finite_or_none(value: object) -> float | None:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if plain and math.isfinite(value) else None  # type: ignore[arg-type]


def age_by_boottime_s(record: Stamp, now: Stamp) -> float | None:
    """The age of the record by boottime; None if it is of another boot, or in the future."""
    if not record.boot_id or record.boot_id != now.boot_id:
        return None
    if record.boot_s is None or now.boot_s is None or now.boot_s < record.boot_s:
        return None
    return now.boot_s - record.boot_s


def restarted_since(record: Stamp, now: Stamp, uptime_s: float | None) -> bool:
    """Whether a device with this time since its start-up must have restarted after the record.

    Allows for a device clock that is slow by `CLOCK_RATE`. A time that fell, but to more than the
    age of the record, is a clock that jumped and no restart.
    """
    if uptime_s is None or not math.isfinite(uptime_s) or uptime_s < 0.0:
        return False
    fell = record.device_s is not None and uptime_s < record.device_s - LATENCY_S
    if not record.boot_id or record.boot_id != now.boot_id:
        return fell
    age_s = age_by_boottime_s(record, now)
    if age_s is None:
        return False
    started_later = uptime_s < age_s * (1.0 - CLOCK_RATE) - LATENCY_S
    return started_later or (fell and uptime_s <= age_s * (1.0 + CLOCK_RATE) + LATENCY_S)


def least_ages_s(records: Sequence[Stamp], now: Now) -> list[float]:
    """For each record, oldest first, a lower bound of its age; at least 0.

    A record is at least as old as every later record.
    """
    least: list[float] = []
    newest_s = 0.0
    for record in reversed(records):
        newest_s = max(newest_s, _least_age_s(record, now))
        least.append(newest_s)
    return least[::-1]


def _least_age_s(record: Stamp, now: Now) -> float:
    wall_s = None
    if plausible(record.wall_s) and plausible(now.stamp.wall_s):
        wall_s = (now.stamp.wall_s or 0.0) - (record.wall_s or 0.0)
    if record.boot_id and record.boot_id == now.stamp.boot_id:
        age_s = age_by_boottime_s(record, now.stamp)
        known = [s for s in (age_s, wall_s) if s is not None]
        return min(known) if age_s is not None else 0.0
    up_s = 0.0
    if now.stamp.boot_id:  # records of this run have its boot id, so this one is older
        up_s = now.run_s if not record.boot_id else now.stamp.boot_s or 0.0
    return max(up_s, 0.0 if wall_s is None else wall_s - WALL_ERROR_S)


def plausible(wall_s: float | None) -> bool:
    """Whether this wall clock was ever set."""
    return wall_s is not None and wall_s >= PLAUSIBLE_FROM_S


# -- Kinds of records ------------------------------------------------------------------------------


class RecordKind(StrEnum):
    """Records of the journal. The first group leaves a transaction open, the second ends it."""

    PREPARED = "PREPARED"  # J1: what the device holds, what it shall hold; nothing sent yet
    RAM_FAILED = "RAM_FAILED"  # J3: a write was refused or did not verify; old values follow
    RAM_VERIFIED = "RAM_VERIFIED"  # J3: read back, equal
    PROVEN = "PROVEN"  # J4: the trial passed
    ROLLBACK = "ROLLBACK"  # J4: the old values are about to be written
    FLASH_SENT = "FLASH_SENT"  # J5: VNWNV is about to be sent
    FLASH_ACKED = "FLASH_ACKED"  # J6: the device said yes

    ABORTED = "ABORTED"  # nothing was changed
    ROLLED_BACK = "ROLLED_BACK"  # the old values were read back
    REVERTED = "REVERTED"  # the old values are back, by whom is not known
    LOST = "LOST"  # the device restarted with the old values
    NOT_SAVED = "NOT_SAVED"  # VNWNV was sent, a restart brought the old values
    CONFIRMED = "CONFIRMED"  # J7: a restart brought the new values
    FOREIGN = "FOREIGN"  # the device holds what nobody here wrote
    FLASH_TORN = "FLASH_TORN"  # VNWNV was interrupted, the flash holds neither

    LOCKED = "LOCKED"  # not part of a transaction
    UNLOCKED = "UNLOCKED"
    OUTPUTS_KEPT = "OUTPUTS_KEPT"  # nor these: the user's outputs, before the session changes them
    OUTPUTS_BACK = "OUTPUTS_BACK"  # they are in the device again
    CLIENT_SAVED = "CLIENT_SAVED"  # a program on a shared port saved all of RAM
    CLIENT_RESET = "CLIENT_RESET"  # or reset the device: its RAM is what its flash holds
    CLIENT_WRITES = "CLIENT_WRITES"  # one is about to write what calibrates, in RAM


OPEN: Final = (
    RecordKind.PREPARED,
    RecordKind.RAM_FAILED,
    RecordKind.RAM_VERIFIED,
    RecordKind.PROVEN,
    RecordKind.ROLLBACK,
    RecordKind.FLASH_SENT,
    RecordKind.FLASH_ACKED,
)


OF_OUTPUTS: Final = (RecordKind.OUTPUTS_KEPT, RecordKind.OUTPUTS_BACK)


OF_OTHERS: Final = (  # say nothing about a transaction
    *OF_OUTPUTS,
    RecordKind.CLIENT_SAVED,
    RecordKind.CLIENT_RESET,
)


# -- What the records amount to --------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Transaction:
    """A write of registers. `old` and `new` have the same registers.

    snapshot: every configuration register with the user's value before the daemon changed any
    approver: "operator" or "auto"
    model:    of the device; empty in old records, which do not have it
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
        """Facts for the journal, with the lines that restore the old values by hand."""
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
        """From a PREPARED record; KeyError, TypeError or ValueError if it is not one."""
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


TIMES_KEPT: Final = 1000  # far more than any budget allows in a day


BY_HAND: Final = "HAND_PREPARED"  # a write of the registers command
BY_HAND_DONE: Final = "HAND_VERIFIED"  # its good end; at a bad one, `restored` says how it ended
BY_HAND_SAVE: Final = "HAND_FLASH_SENT"  # its save to flash, about to be sent
BY_HAND_SAVED: Final = "HAND_FLASH_ACKED"  # and the good end of that


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
    """One record, as read from the journal."""

    @property
    def kind(self) -> str:
        """One of `RecordKind`; others (of other commands) are ignored."""

    @property
    def facts(self) -> Mapping[str, Any]:
        """The recorded facts; `Stamp` reads the time from them."""


@dataclass(frozen=True, slots=True)
class StoredRecord:
    """A journal record from `JournalOpened`."""

    kind: str
    facts: dict[str, Any]

    @staticmethod
    def of(body: Mapping[str, Any]) -> StoredRecord:
        """From `JournalOpened.records`."""
        return StoredRecord(str(body["kind"]), dict(body["facts"]))


@dataclass(frozen=True, slots=True)
class JournalHistory:
    """Summary of a journal.

    open:      the transaction that no record has ended; `last`, `last_at`: its newest record
    newest_at: the time of the newest record of any kind
    flashes_at, flashes: saves to flash by ahrsd, also by hand; `flashes` with those of clients
    rollbacks: since the last proven write or unlock; each means that a calibration was bad
    holds:     what the device must hold after the newest transaction, if known
    values:    registers with old and new values of writes, including those by hand
    trials:    registers with new values of writes that were neither saved nor kept by a person
    by_hand:   old and new values of a write by hand, or of its save, that has no end
    broken:    the kind of a record that could not be parsed; then nothing may be written
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
    by_hand: tuple[dict[int, Values], dict[int, Values]] | None = None
    broken: str | None = None

    @staticmethod
    def of(records: Iterable[JournalRecord]) -> JournalHistory:
        """The history of these records, oldest first."""
        history, by_hand = JournalHistory(), None
        for record in records:
            if record.kind in RecordKind.__members__:
                history = history.with_record(RecordKind(record.kind), record.facts)
            elif record.kind == BY_HAND:
                history = history._with_write_of_others(record.facts)._with_by_hand(record.facts)
                by_hand = history.by_hand
            elif record.kind == BY_HAND_SAVE:  # if that breaks off, the flash may hold some of each
                at = Stamp.of(record.facts)
                history = replace(history._with_flash(at), newest_at=at, by_hand=by_hand)
            elif record.kind in (BY_HAND_DONE, BY_HAND_SAVED) or record.facts.get("restored"):
                history = replace(history, by_hand=None)
        return history

    def with_record(self, kind: RecordKind, facts: Mapping[str, Any]) -> JournalHistory:
        """The history after one more record."""
        if kind is RecordKind.CLIENT_SAVED:
            return replace(self, flashes=self.flashes + 1)
        if kind in OF_OTHERS:
            return self
        at = Stamp.of(facts)
        now = replace(self, newest_at=at)
        if kind is RecordKind.CLIENT_WRITES:
            return now._with_write_of_others(facts)
        if kind is RecordKind.LOCKED:
            return replace(now, locked=str(facts.get("reason", "no reason given")))
        if kind is RecordKind.UNLOCKED:
            return replace(now, locked=None, torn=False, rollbacks=0, trials=())
        if kind is RecordKind.PREPARED:
            try:
                return now._with_open_transaction(Transaction.from_facts(facts), at)._with_values(
                    facts
                )
            except (KeyError, TypeError, ValueError):
                return replace(now, broken=kind.value)
        return now._with_counts(kind, facts, at)._with_transaction_at(kind, facts, at)

    def is_trial_value(self, number: int, values: Values) -> bool:
        """Whether a write set this register to these values, and they were not kept."""
        return any(n == number and same(n, known, values) for n, known in self.trials)

    def has_value(self, number: int, values: Values) -> bool:
        """Whether a record has these values of this register, as old or new ones."""
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

    def _with_open_transaction(self, transaction: Transaction, at: Stamp) -> JournalHistory:
        """With this transaction open. KeyError or ValueError if its values do not fit registers."""
        changed = [(n, v) for n, v in transaction.new.items() if not same(n, v, transaction.old[n])]
        trials = (*self.trials, *((n, v) for n, v in changed if not self.is_trial_value(n, v)))
        return replace(
            self, open=transaction, last=RecordKind.PREPARED, last_at=at, holds=None,
            trials=trials[-TIMES_KEPT:],
        )  # fmt: skip

    def _with_write_of_others(self, facts: Mapping[str, Any]) -> JournalHistory:
        """With a person's or client's write in RAM: the next start may bring either value."""
        return self._with_values(facts)._without_holds_of(facts)._without_trials(facts)

    def _with_by_hand(self, facts: Mapping[str, Any]) -> JournalHistory:
        try:
            return replace(self, by_hand=(_from_json(facts["old"]), _from_json(facts["new"])))
        except (KeyError, TypeError, ValueError, AttributeError):
            return self

    def _without_trials(self, facts: Mapping[str, Any]) -> JournalHistory:
        """Another program or person wrote these values: they are no trial values of ours."""
        try:
            return replace(self, trials=_drop_kept(self.trials, _from_json(facts["new"])))
        except (KeyError, TypeError, ValueError, AttributeError):
            return self

    def _without_holds_of(self, facts: Mapping[str, Any]) -> JournalHistory:
        written = {str(number) for number in facts.get("new", ())}
        left = {n: v for n, v in (self.holds or {}).items() if str(n) not in written}
        return replace(self, holds=left or None)

    def _with_flash(self, at: Stamp) -> JournalHistory:
        """With one more save to flash."""
        flashes_at = (*self.flashes_at, at)[-TIMES_KEPT:]
        return replace(self, flashes_at=flashes_at, flashes=self.flashes + 1)

    def _with_counts(self, kind: RecordKind, facts: Mapping[str, Any], at: Stamp) -> JournalHistory:
        """With budgets and rollbacks updated."""
        changes: dict[str, Any] = {}
        if kind in _TOUCHED_RAM and self.last is RecordKind.PREPARED:
            changes["ram_writes_at"] = (*self.ram_writes_at, at)[-TIMES_KEPT:]
        if kind is RecordKind.FLASH_SENT:
            return self._with_flash(at)
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
        """With the state of the open transaction updated; ignores records of another one."""
        if self.open is None or facts.get("txn", self.open.id) != self.open.id:
            return self
        holds, trials = self.holds, self.trials
        if kind in _HOLDS_NEW:
            holds = self.open.new
            trials = _drop_kept(trials, self.open.new)
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


def _drop_kept(
    trials: Iterable[tuple[int, Values]], kept: Mapping[int, Values]
) -> tuple[tuple[int, Values], ...]:
    return tuple((n, v) for n, v in trials if n not in kept or not same(n, kept[n], v))


def find_record_of_other_device(records: Iterable[JournalRecord], serial: int) -> str:
    """Which record is of a device with another serial number; empty if none is."""
    for number, record in enumerate(records, start=1):
        device = record.facts.get("device")
        theirs = record.facts.get(
            "serial", device.get("serial") if isinstance(device, dict) else None
        )
        if theirs is not None and str(theirs) != str(serial):
            return f"record {number} is of the device {theirs}, and this is {serial}"
    return ""
