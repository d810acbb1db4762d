"""The write-back inside the core: carries out its actions and passes on its inputs.

`ActionQueue` carries out its actions in order. A journal record stops the queue until it is on the
disk, because the next action may send a byte to the device. A procedure waits until the session is
idle.

`DeviceRecord` collects identity, registers and journal of a device, and passes them on once all
three are known. `TrialComparison` compares the registers on trial with those before them.
`OperatorAnswers` holds answers to the operator until the journal has them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from ahrsd import events
from ahrsd.core.device_session import DeviceSession
from ahrsd.inputs import Journalled, JournalOpened
from ahrsd.samples import SampleBlock
from ahrsd.stream.decompensation import user_compensation
from ahrsd.writeback.actions import (
    Action,
    AppendToJournal,
    CalibrateAnew,
    CancelProcedure,
    Emit,
    IdentifyAgain,
    InForce,
    Look,
    RunProcedure,
    SetUpStream,
)
from ahrsd.writeback.journal_history import (
    OF_OUTPUTS,
    RecordKind,
    StoredRecord,
    find_record_of_other_device,
)
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.states import LIVED_WITH, State
from ahrsd.writeback.trial import LiveTrial
from drivers.vn100.registers import COMPENSATING, Unit, Values, same
from drivers.vn100.session import Event as SessionEvent

# -- Actions of the write-back ---------------------------------------------------------------------


class CoreCallbacks(Protocol):
    """The methods of the core that the queue calls."""

    def emit(self, event: events.Event) -> None:
        """Answer the shell with this event."""

    def process_events(self, found: list[SessionEvent]) -> None:
        """Process measurements and faults that the session received."""

    def set_registers_in_force(self, registers: Mapping[int, Values] | None) -> None:
        """The device applies these registers from now on; None: unknown."""

    def calibrate_anew(self, reason: str) -> None:
        """Discard the estimate: the registers that its samples passed are in doubt."""


class ActionQueue:
    """Actions in order. `pausing` is called before a procedure that may pause the output."""

    def __init__(
        self, device_session: DeviceSession, writeback: WriteBack, pausing: Callable[[], None]
    ) -> None:
        self._device_session, self._writeback = device_session, writeback
        self._pausing = pausing
        self._actions: deque[Action] = deque()
        self._procedure: RunProcedure | None = None
        self._look: Look | None = None
        self._awaiting_journal = False
        self._now_s = 0.0

    @property
    def may_close(self) -> bool:
        """Whether the port may be closed: nothing is under way, or a stop waited long enough."""
        return (
            not self._actions
            and self._procedure is None
            and not self._awaiting_journal
            and self._writeback.idle
            and self._device_session.may_close
        ) or not self._device_session.limit.may_wait(self._now_s)

    @property
    def awaiting_journal(self) -> bool:
        """Whether the queue waits for a record to be on the disk."""
        return self._awaiting_journal

    @property
    def procedure_waiting(self) -> bool:
        """Whether a procedure waits until the session is idle."""
        return self._procedure is not None or self._look is not None

    def add(self, actions: Iterable[Action]) -> None:
        """Append to the queue."""
        self._actions.extend(actions)

    def stop(self, host_s: float) -> None:
        """The run is to end: values that are only in RAM are undone, within a time limit."""
        self._device_session.limit.begin(host_s)
        self.add(self._writeback.on_stop(host_s))

    def forget_procedure(self) -> None:
        """Drop what has not started: the link or device was lost, which the write-back knows."""
        self._procedure = self._look = None

    def on_journalled(self, item: Journalled, host_s: float) -> None:
        """The record that the queue waits for is on the disk, or failed."""
        self._awaiting_journal = False
        kind = RecordKind(item.kind)
        if kind in OF_OUTPUTS:
            self._device_session.on_journalled(kind, item.error, host_s)
        if item.error:
            first = self._writeback.on_journal_failed(kind, item.error, host_s)
        else:
            first = self._writeback.on_journal_ok(kind, host_s)
        self._actions.extendleft(reversed(first))

    def emit_leading_events(self, core: CoreCallbacks) -> None:
        """Emit the leading events now: their time must not depend on how the bytes were cut."""
        while self._actions and not self._awaiting_journal:
            action = self._actions[0]
            if not isinstance(action, Emit):
                return
            self._actions.popleft()
            core.emit(action.event)

    def run_actions(self, core: CoreCallbacks, host_s: float) -> bool:
        """Carry out what can be done now; returns whether anything was."""
        done, self._now_s = False, host_s
        self._actions.extend(self._device_session.outputs.take_actions())
        while self._actions and not self._awaiting_journal:
            self._carry_out(self._actions.popleft(), core, host_s)
            done = True
        if self._procedure is not None:  # takes precedence over a look, which changes nothing
            self._look = None
            core.process_events(self._device_session.stop_looking(host_s))
        if self._procedure is not None and self._device_session.idle:
            run, self._procedure = self._procedure, None
            self._pausing()
            core.process_events(
                self._device_session.run(run.name, run.make(), run.purpose, host_s, run.gate)
            )
            done = True
        if self._look is not None and self._device_session.idle:
            wanted, self._look = self._look, None
            core.process_events(self._device_session.look(wanted.unit, wanted.expected, host_s))
            done = True
        return done

    def _carry_out(self, action: Action, core: CoreCallbacks, host_s: float) -> None:
        match action:
            case Emit(event):
                core.emit(event)
            case AppendToJournal(kind, facts):
                self._awaiting_journal = True
                core.emit(events.JournalAppend(kind.value, dict(facts)))
            case RunProcedure():
                self._procedure = action
            case CancelProcedure(name):
                if self._procedure is not None and self._procedure.name == name:
                    self._procedure = None
                core.process_events(self._device_session.cancel(name, host_s))
            case InForce(registers):
                core.set_registers_in_force(registers)
            case Look():
                self._look = action
            case CalibrateAnew(reason):
                core.calibrate_anew(reason)
            case SetUpStream():
                self._pausing()
                core.process_events(self._device_session.set_up_again(host_s))
            case IdentifyAgain():
                self._look = None
                core.process_events(self._device_session.identify_again(host_s))


# -- The device, for the write-back ----------------------------------------------------------------


@dataclass(slots=True)
class DeviceRecord:
    """Collects registers and journal of the device that was identified last."""

    _unit: Unit | None = None
    _values: dict[int, Values] | None = None
    _journal: Sequence[StoredRecord] | None = field(default=None)
    _journal_known: bool = False
    _breaks: int = -1
    _read_from_s: float = float("inf")

    def on_identified(self, unit: Unit) -> Unit | None:
        """A device was identified; its journal is not open yet. Returns the unit before it."""
        before, self._unit, self._journal_known = self._unit, unit, False
        return before

    def on_journal_read(self, item: JournalOpened) -> str:
        """Take its journal; returns why it cannot be trusted, "" if it can."""
        records = [StoredRecord.of(r) for r in item.records]
        error = item.error or find_record_of_other_device(records, item.serial)
        self._journal = None if error else records
        self._journal_known, self._read_from_s = True, item.host_ns * 1e-9
        return error

    def on_registers_read(
        self, values: dict[int, Values], believed: Mapping[int, Values], breaks: int
    ) -> list[int]:
        """Take its registers; returns those that another program changed at an unknown time.

        believed: the values assumed until now; breaks: count of restarts of link or device, which
        explain a change
        """
        explained = breaks != self._breaks
        self._values, self._breaks = values, breaks
        read = [n for n in COMPENSATING if n in believed and n in values]
        return [] if explained else [n for n in read if not same(n, believed[n], values[n])]

    def report(
        self,
        device_session: DeviceSession,
        writeback: WriteBack,
        host_s: float,
    ) -> list[Action]:
        """Report to the write-back, once, when all parts are known.

        Registers that this session changes are reported with the user's values.
        """
        identity, values = device_session.identity, self._values
        if identity is None or values is None or not self._journal_known:
            return []
        self._values = None
        users = device_session.on_registers_and_journal(values, self._journal)
        return writeback.on_device(
            identity,
            users,
            self._journal,
            host_s,
            session_keys=device_session.session_keys,
            clients=frozenset(device_session.clients.now),
            read_from_s=self._read_from_s,
        )


# -- A candidate on trial --------------------------------------------------------------------------


class TrialComparison:
    """Compares the registers in force with those that they replaced, on the same samples."""

    def __init__(self, writeback: WriteBack) -> None:
        self._writeback = writeback
        self._trial: LiveTrial | None = None

    def on_state_changed(
        self, change: events.StateChanged, registers: Mapping[int, Values]
    ) -> None:
        """The state of the write-back changed, with these registers in force."""
        proven_again = (change.new, change.old) == (State.PROVEN, State.RECONCILING)
        if change.new == State.TRIAL or proven_again:
            self._begin(registers)
        elif change.new not in LIVED_WITH:
            self._trial = None

    def restart(self, registers: Mapping[int, Values]) -> None:
        """The readings jumped: judge the registers on trial by later samples only."""
        if self._trial is not None:
            self._begin(registers)

    def _begin(self, registers: Mapping[int, Values]) -> None:
        transaction = self._writeback.history.open
        old = {} if transaction is None else transaction.old
        mag, bias = user_compensation(registers)
        old_mag, old_bias = user_compensation({**registers, **old})
        limit = 0.01 * self._writeback.policy.trial.max_wrong_percent
        self._trial = LiveTrial(mag, old_mag, bias, old_bias, wrong_limit=limit)

    def take(self, block: SampleBlock, host_s: float) -> list[Action]:
        """Take samples without the terms of the vehicle's columns; returns resulting actions."""
        if self._trial is None:
            return []
        return self._writeback.on_trial_metrics(self._trial.take(block), host_s)


# -- The operator ----------------------------------------------------------------------------------


class OperatorAnswers:
    """Answers to the operator, due once nothing waits for the journal."""

    def __init__(self) -> None:
        self._due: list[events.Answered] = []

    def add(self, word: str, answer: tuple[bool, str]) -> None:
        """Add the answer to a command; `word` identifies it."""
        self._due.append(events.Answered(word, *answer))

    def on_journalled(self, item: Journalled) -> None:
        """If a lock could not be written to disk, answer that it holds for this run only."""
        if item.error and item.kind in (RecordKind.LOCKED, RecordKind.UNLOCKED):
            text = f"not in the journal: {item.error}; it holds for this run only"
            self._due = [replace(a, accepted=False, text=text) for a in self._due]

    def take(self) -> list[events.Answered]:
        """The answers since the last call."""
        due, self._due = self._due, []
        return due
