"""Actions of the write-back, which the core carries out in the given order.

AppendToJournal is carried out with fsync *before* the next action runs; its result is reported with
`on_journal_ok` or `on_journal_failed`, whose own actions come before the rest of the list.
RunProcedure waits until the session is idle; CancelProcedure throws Cancelled into the running one.

`ActionOutbox` collects the actions, and holds the present time and the journal's history.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ahrsd.events import Event, Noted, RegisterWritten, StateChanged
from ahrsd.printable import counted
from ahrsd.writeback.journal_history import (
    JournalHistory,
    JournalRecord,
    Now,
    RecordKind,
    Stamp,
    plausible,
)
from ahrsd.writeback.states import Purpose
from drivers.vn100.commands import Command, Procedure
from drivers.vn100.registers import Unit, Values

# -- Actions ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RunProcedure:
    """Have the session carry out `make()`. `gate` must allow each command just before it is sent.

    `name` is unique; the end is reported with `on_procedure_finished` or `on_procedure_failed`.
    """

    name: str
    purpose: Purpose
    make: Callable[[], Procedure[object]]
    gate: Callable[[Command], bool]


@dataclass(frozen=True, slots=True)
class CancelProcedure:
    """Cancel the procedure of this name, if it runs or waits; its end need not be reported."""

    name: str


@dataclass(frozen=True, slots=True)
class AppendToJournal:
    """Write this record to the journal durably."""

    kind: RecordKind
    facts: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Emit:
    """An event for the log, the viewer and the report."""

    event: Event


@dataclass(frozen=True, slots=True)
class InForce:
    """The device applies these registers from now on; None: unknown, samples are unusable."""

    registers: Mapping[int, Values] | None


@dataclass(frozen=True, slots=True)
class SetUpStream:
    """Set the session's outputs up again: the user's were restored for a save."""


@dataclass(frozen=True, slots=True)
class IdentifyAgain:
    """Identify the device, read its registers and report to `on_device`."""


@dataclass(frozen=True, slots=True)
class Look:
    """Read identity and registers when nothing else runs, and report to `on_looked`."""

    unit: Unit
    expected: Mapping[int, Values]


@dataclass(frozen=True, slots=True)
class CalibrateAnew:
    """Calibrate anew: samples may have been decompensated with the wrong registers."""

    reason: str


Action = (
    RunProcedure
    | CancelProcedure
    | AppendToJournal
    | Emit
    | InForce
    | SetUpStream
    | IdentifyAgain
    | Look
    | CalibrateAnew
)


# -- The outbox ------------------------------------------------------------------------------------


JOURNAL_AGAIN_S = 30.0  # wait before a failed write to the journal is repeated
_RECORDED_BEFORE_ACTION = (
    RecordKind.PREPARED,
    RecordKind.RAM_VERIFIED,
    RecordKind.FLASH_SENT,
    RecordKind.CLIENT_WRITES,
)  # the action that they precede is not done unless they are on the disk


class ActionOutbox:
    """Actions in order, the clocks and the journal's history.

    A record of a completed step (a rollback) that could not be written to disk is kept and retried
    until it is: otherwise the next start would have to guess.
    """

    def __init__(self, allow: Callable[[Command, Purpose, float], bool]) -> None:
        self.host_s = self.at_s = 0.0
        self.device_s: float | None = None  # the device's newest time since its start-up
        self.history = JournalHistory()
        self.running = ""
        self.rotation_waits = False  # register 26 is not what the device applies
        self._allow = allow
        self._wall_offset_s: float | None = None
        self._least_offset_s: float | None = None  # of all plausible wall clock readings
        self._boot: tuple[str, float | None] = ("", None)  # boot id, and offset from `host_s`
        self._serial: int | None = None
        self._bound_s = 0.0
        self._requested: deque[tuple[RecordKind, dict[str, Any], JournalHistory]] = deque()
        self._unjournaled: list[tuple[RecordKind, dict[str, Any]]] = []
        self._journal_retry_s = 0.0
        self._runs = 0
        self._out: list[Action] = []
        self._last_note = ""

    @property
    def wall_s(self) -> float:
        """The wall clock now, for people; the monotonic clock while it is unknown."""
        return self.host_s + (self._wall_offset_s or 0.0)

    @property
    def stamp(self) -> Stamp:
        """The present by all clocks, for a record."""
        return self.stamp_at(self.host_s)

    def stamp_at(self, host_s: float) -> Stamp:
        """`host_s` by all clocks of the host, and the newest device time."""
        (boot_id, boot_s), wall_s = self._boot, self._wall_offset_s
        return Stamp(
            wall_s=None if wall_s is None else host_s + wall_s,
            boot_id=boot_id,
            boot_s=None if boot_s is None else host_s + boot_s,
            device_s=self.device_s,
        )

    @property
    def now(self) -> Now:
        """The present for a budget, by the earliest plausible wall clock of this run."""
        stamp, least_s = self.stamp, None
        if self._least_offset_s is not None:
            since_s = self.host_s if stamp.boot_s is None else stamp.boot_s
            least_s = since_s + self._least_offset_s
        return Now(replace(stamp, wall_s=least_s), self.host_s - self._bound_s)

    def set_clocks(self, wall_s: float, boot_id: str = "", boot_s: float | None = None) -> None:
        """Set the host's other clocks; the wall clock may have been adjusted."""
        self._wall_offset_s = wall_s - self.host_s
        if plausible(wall_s):
            offset_s = wall_s - (self.host_s if boot_s is None else boot_s)
            least_s = offset_s if self._least_offset_s is None else self._least_offset_s
            self._least_offset_s = min(offset_s, least_s)
        self._boot = (boot_id, None if boot_s is None else boot_s - self.host_s)

    def bind(self, serial: int, journal: Sequence[JournalRecord] | None) -> None:
        """Take the journal of the device that is there now.

        If it cannot be read, an open transaction in memory is kept. Records that are not on the
        disk yet are appended to the history.
        """
        if serial != self._serial and self._unjournaled:
            self.note(
                "error", f"lost: {counted(len(self._unjournaled), 'record')} of {self._serial}"
            )
            self._unjournaled.clear()
        self._serial, self._bound_s, self.device_s = serial, self.host_s, None
        remembered = self.history.open
        if journal is not None or remembered is None or remembered.serial != serial:
            self.history = JournalHistory.of(journal or ())
            for kind, facts in self._unjournaled:
                self.history = self.history.with_record(kind, facts)

    def take_actions(self) -> list[Action]:
        """The actions since the last call."""
        out, self._out = self._out, []
        return out

    def append(self, action: Action) -> None:
        """Append an action."""
        self._out.append(action)

    def record(self, kind: RecordKind, **facts: object) -> None:
        """Append a record after those still missing on disk; the history includes it at once."""
        self.retry_journal()
        transaction = self.history.open
        complete = {
            **({} if transaction is None else {"txn": transaction.id}),
            **facts,
            **self.stamp.facts(),
        }
        before, self.history = self.history, self.history.with_record(kind, complete)
        self._append(kind, complete, before)

    def on_journaled(self, kind: RecordKind) -> bool:
        """A record of this kind is on the disk; returns whether none is missing now."""
        self._take_request(kind)
        self.retry_journal()
        return not self._unjournaled and not self._requested

    def on_journal_failed(self, kind: RecordKind) -> None:
        """A record of this kind could not be written: keep it, or undo what it announced."""
        request = self._take_request(kind)
        if request is None:
            return
        _, facts, before = request
        if kind not in _RECORDED_BEFORE_ACTION:
            self._unjournaled.append((kind, facts))
            self._journal_retry_s = self.host_s + JOURNAL_AGAIN_S
        elif kind is RecordKind.PREPARED:  # no transaction was opened
            self.history = replace(
                self.history,
                open=before.open,
                last=before.last,
                last_at=before.last_at,
                holds=before.holds,
            )

    @property
    def journal_retry_s(self) -> float | None:
        """When failed records are retried; None if there are none."""
        return self._journal_retry_s if self._unjournaled else None

    def retry_journal(self) -> None:
        """Retry the missing records, in order."""
        waiting, self._unjournaled = self._unjournaled, []
        for kind, facts in waiting:
            self._append(kind, facts, self.history)

    def _append(self, kind: RecordKind, facts: dict[str, Any], before: JournalHistory) -> None:
        self._requested.append((kind, facts, before))
        self.append(AppendToJournal(kind, facts))

    def _take_request(
        self, kind: RecordKind
    ) -> tuple[RecordKind, dict[str, Any], JournalHistory] | None:
        request = next((one for one in self._requested if one[0] is kind), None)
        if request is not None:
            self._requested.remove(request)
        return request

    def note(self, level: str, text: str) -> None:
        """Log one line; a repetition of the last one is left out."""
        if text != self._last_note:
            self.append(Emit(Noted(self.at_s, self.host_s, level, text)))
        self._last_note = text

    def emit_state_change(self, old: str, new: str, reason: str) -> None:
        """Emit a change of state."""
        self.append(Emit(StateChanged(self.at_s, self.host_s, old, new, reason)))

    def emit_register_writes(
        self, before: Mapping[int, Values], after: Mapping[int, Values], outcome: str
    ) -> None:
        """Emit that registers were written, refused or undone."""
        for number in after:
            old, new = (tuple(float(v) for v in side[number]) for side in (before, after))
            self.append(Emit(RegisterWritten(self.at_s, self.host_s, number, old, new, outcome)))

    def set_in_force(self, registers: Mapping[int, Values] | None) -> None:
        """The device applies these registers from now on; None: unknown."""
        unknown = registers is None or self.rotation_waits
        self.append(InForce(None if unknown else dict(registers or {})))

    def run(self, what: str, purpose: Purpose, make: Callable[[], Procedure[object]]) -> None:
        """Start a procedure; its gate checks each command at the newest host time."""
        self._runs += 1
        self.running = f"{what} {self._runs}"
        self.append(
            RunProcedure(
                self.running,
                purpose,
                make,
                lambda command: self._allow(command, purpose, self.host_s),
            )
        )

    def cancel_running(self) -> None:
        """Cancel the running procedure, if any."""
        if self.running:
            self.append(CancelProcedure(self.running))
        self.running = ""
