"""What the write-back knows of time and journal, and the actions that it collects for the core."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from ahrsd.events import Noted, RegisterWritten, StateChanged
from ahrsd.writeback.actions import (
    Action,
    CancelProcedure,
    Emit,
    InForce,
    JournalAppend,
    RunProcedure,
)
from ahrsd.writeback.journal_history import History, JournalRecord
from ahrsd.writeback.permissions import Purpose
from ahrsd.writeback.reconcile import Kind
from drivers.vn100.commands import Command, Procedure
from drivers.vn100.registers import Values


class Desk:
    """Outgoing actions in order, each stamped with the newest time; the history beside them."""

    def __init__(self, allow: Callable[[Command, Purpose, float], bool]) -> None:
        self.host_s = self.at_s = 0.0
        self.history = History()
        self.running = ""
        self._allow = allow
        self._wall_offset_s = 0.0
        self._runs = 0
        self._out: list[Action] = []
        self._said = ""

    @property
    def wall_s(self) -> float:
        """The wall clock now, as it ran when the device was bound: steps since do not count."""
        return self.host_s + self._wall_offset_s

    def bind(self, serial: int, journal: Sequence[JournalRecord] | None, wall_s: float) -> None:
        """Another device, or the same one again: its journal is what counts.

        Where it cannot be read, what is remembered of an open transaction is better than nothing.
        """
        self._wall_offset_s = wall_s - self.host_s
        remembered = self.history.open
        if journal is not None or remembered is None or remembered.serial != serial:
            self.history = History.of(journal or ())

    def take(self) -> list[Action]:
        """The actions so far."""
        out, self._out = self._out, []
        return out

    def ask(self, action: Action) -> None:
        """One action more."""
        self._out.append(action)

    def record(self, kind: Kind, **facts: object) -> None:
        """Append to the journal; the history takes it as given."""
        transaction = self.history.open
        complete = {
            **({} if transaction is None else {"txn": transaction.id}),
            **facts,
            "wall_s": self.wall_s,
        }
        self.history = self.history.with_record(kind, complete)
        self.ask(JournalAppend(kind, complete))

    def note(self, level: str, text: str) -> None:
        """One line for the log; not the same one twice in a row."""
        if text != self._said:
            self.ask(Emit(Noted(self.at_s, self.host_s, level, text)))
        self._said = text

    def changed(self, old: str, new: str, reason: str) -> None:
        """The state changed."""
        self.ask(Emit(StateChanged(self.at_s, self.host_s, old, new, reason)))

    def written(
        self, before: Mapping[int, Values], after: Mapping[int, Values], outcome: str
    ) -> None:
        """Registers were written, refused or undone."""
        for number in after:
            old, new = (tuple(float(v) for v in side[number]) for side in (before, after))
            self.ask(Emit(RegisterWritten(self.at_s, self.host_s, number, old, new, outcome)))

    def in_force(self, registers: Mapping[int, Values] | None) -> None:
        """From now on the device applies these; None: nobody knows."""
        self.ask(InForce(None if registers is None else dict(registers)))

    def run(self, what: str, purpose: Purpose, make: Callable[[], Procedure[object]]) -> None:
        """Begin a conversation; its commands pass the gate at the newest time that was told."""
        self._runs += 1
        self.running = f"{what} {self._runs}"
        self.ask(
            RunProcedure(
                self.running,
                purpose,
                make,
                lambda command: self._allow(command, purpose, self.host_s),
            )
        )

    def stop_running(self) -> None:
        """End the conversation that runs, if any."""
        if self.running:
            self.ask(CancelProcedure(self.running))
        self.running = ""
