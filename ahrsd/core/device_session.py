"""The session with one device: identify, read, set up the stream, restore it, close the port.

```
 CLOSED -> IDENTIFYING -> READING -> [KEEPING -> SETTING_UP] -> READY -> RESTORING -> DONE
                                                                READY <-> RUNNING (the write-back)
                                                                READY <-> LOOKING (who answers?)
                                                                READY <-> SERVING (a client's)
```
Before the session's outputs are set up, the user's outputs are recorded in the journal (KEEPING,
`KeptOutputs`). If the device stops sending although its output may be on, the output is requested
again (`OutputWatchdog`). A stop ends within `STOP_S`, whatever the device does (`StopLimit`).

In mode `passive` the phase goes from CLOSED to READY at once and no byte is ever sent. A device
that does not answer is only listened to, and identification is retried: the phase stays
IDENTIFYING, without an identity, so nothing can be written to it.

**The user's outputs.** A session changes registers 6 and 75 to 77. A program that is killed cannot
restore them, and the next run would mistake the session's values for the user's. So the user's
values are journaled before the first byte is sent (`OUTPUTS_KEPT`); the record is closed when they
have been restored (`OUTPUTS_BACK`).

If a run finds an open record, it decides register by register. A value that only a session leaves
(`calibration_stream.left_by_session`) is replaced by the recorded one. Any other value was set
since, by a person or by a restart of the device, and is the user's own.

**Settings of clients.** A driver sets its outputs at every start, in RAM. They are no more part of
the user's configuration than the session's own: they are restored before a save and set again after
it, so that saving a calibration makes nothing else permanent. A restart of the device clears them.
What a client saves itself belongs to the user from then on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from ahrsd.writeback.actions import Action, AppendToJournal, SetUpStream
from ahrsd.writeback.journal_history import JournalRecord, RecordKind
from ahrsd.writeback.permissions import CALIBRATION, permitted
from ahrsd.writeback.states import Mode, Purpose
from drivers.vn100.calibration_stream import (
    CalibrationStream,
    DoesNotFit,
    NoStream,
    NotPutBack,
    configure_stream,
    left_by_session,
)
from drivers.vn100.commands import (
    RESUME,
    Command,
    Identity,
    LinkGone,
    Procedure,
    Read,
    Seen,
    SessionError,
    Speech,
    WrongDevice,
    asked,
    asked_of,
    identify_in,
    identify_surely,
    look,
    put_back_to,
    quiet,
    read_surely,
    restore,
    resume,
)
from drivers.vn100.decode import Measurement
from drivers.vn100.registers import (
    SESSION_SETTINGS,
    Unit,
    Values,
    register_lines,
    same,
)
from drivers.vn100.session import Event, ProcedureFailed, ProcedureFinished, Session

# -- Outputs of the session ------------------------------------------------------------------------


class KeptOutputs:
    """The user's output registers of the device that was read last.

    users: values by register; empty before a device was read
    left:  registers that still hold values of a session that was killed
    """

    def __init__(self) -> None:
        self.users: dict[int, Values] = {}
        self.left: tuple[int, ...] = ()
        self._serial: int | None = None
        self._kept: dict[int, Values] | None = None  # in the open journal record
        self._actions: list[Action] = []

    @property
    def kept(self) -> bool:
        """Whether the open journal record equals the user's outputs."""
        return self._kept == self.users

    def update(
        self, serial: int, registers: Mapping[int, Values], journal: Sequence[JournalRecord] | None
    ) -> None:
        """Take the registers and the journal of a device; None: the journal cannot be trusted.

        Without a journal, what this run itself has recorded for the device is used.
        """
        if journal is not None or serial != self._serial:
            self._kept = open_record(journal or (), serial)
        self._serial = serial
        kept = self._kept or {}
        present = {n: registers[n] for n in SESSION_SETTINGS if n in registers}
        self.users = {
            n: kept[n] if n in kept and left_by_session(n, kept, value) else value
            for n, value in present.items()
        }
        self.left = tuple(n for n, value in present.items() if self.users[n] != value)

    def request_set_up(self) -> None:
        """Ask for the session's outputs; first journal the user's unless that is done already."""
        if self.kept:
            self._actions.append(SetUpStream())
        else:
            self._actions.append(AppendToJournal(RecordKind.OUTPUTS_KEPT, self._record_facts()))

    def record_restored(self) -> None:
        """Journal that the device has the user's outputs again."""
        self._actions.append(AppendToJournal(RecordKind.OUTPUTS_BACK, {"serial": self._serial}))

    def on_journalled(self, kind: RecordKind, error: str) -> bool:
        """A record is on the disk, or failed with `error`: take the step that waited for it."""
        if error:
            return False
        self._kept = dict(self.users) if kind is RecordKind.OUTPUTS_KEPT else None
        if kind is RecordKind.OUTPUTS_KEPT:
            self._actions.append(SetUpStream())
        return True

    def take_actions(self) -> list[Action]:
        """Actions for the core since the last call."""
        actions, self._actions = self._actions, []
        return actions

    def describe_left(self, *, put_back: bool) -> str:
        """Text for the log: what a killed session left, and what a person can do."""
        lines = " ".join(register_lines({n: self.users[n] for n in self.left}))
        text = f"the device still has the outputs of a killed session; the user's were {lines}"
        if put_back:
            return text
        return f"{text}; send that or set device.configure_stream; until then nothing is saved"

    def _record_facts(self) -> dict[str, Any]:
        """Facts of the record; `old`: the values that a person can restore by hand."""
        values = {str(number): list(row) for number, row in sorted(self.users.items())}
        return {"serial": self._serial, "old": values}


def open_record(journal: Sequence[JournalRecord], serial: int) -> dict[int, Values] | None:
    """The outputs that were recorded and not restored since; None if no record is open."""
    kept: dict[int, Values] | None = None
    for record in journal:
        if record.kind == RecordKind.OUTPUTS_BACK:
            kept = None
        elif record.kind == RecordKind.OUTPUTS_KEPT and record.facts.get("serial") == serial:
            kept = {int(number): tuple(row) for number, row in record.facts["old"].items()}
    return kept


# -- Settings of clients ---------------------------------------------------------------------------


class ClientSettings:
    """Registers that clients set. `now`: the clients' values; `users`: those before."""

    def __init__(self) -> None:
        self.now: dict[int, Values] = {}
        self.users: dict[int, Values] = {}
        self._serial: int | None = None

    def select_device(self, serial: int) -> None:
        """A device was identified: forget the settings if it is another one."""
        if self._serial != serial:
            self._serial = serial
            self.clear()

    def record_write(self, number: int, values: Values, before: Values | None) -> None:
        """A client's write was carried out; `before` None: the old value is unknown."""
        if before is None:
            return
        users = self.users.setdefault(number, before)
        self.now[number] = values
        if same(number, users, values):  # the user's own value again
            del self.users[number], self.now[number]

    def drop_overwritten(self, registers: Mapping[int, Values]) -> dict[int, Values]:
        """All registers were read: forget overwritten settings; returns the remaining `users`."""
        for number in list(self.now):
            if not same(number, self.now[number], registers.get(number, ())):
                del self.users[number], self.now[number]
        return dict(self.users)

    def clear(self) -> None:
        """Forget all: they were saved, so they are the user's, or another device is there."""
        self.now, self.users = {}, {}


# -- The session -----------------------------------------------------------------------------------


ASK_AGAIN_S = (0.5, 8.0)  # device does not answer: first and longest wait
RESTORE_AGAIN_S = 0.1
_FOREIGN = 20  # so many messages without one of the session's own layout: its output is lost
FIRST_S, LONGEST_S = 2.0, 5.0  # outputs have at least 1 Hz, so 2 s without one is silence
# First and longest wait of a retry: after the journal refused the user's outputs; if they could not
# be restored; if they were, but the session's could not be set up (a trial fits into the last one)
KEEP_AGAIN_S, PUT_BACK_AGAIN_S, SET_UP_AGAIN_S = (30.0, 30.0), (0.5, 5.0), (5.0, 1800.0)
USUAL_REPLY_S = 0.4  # if replies may take longer, all waits are scaled up
PATIENCE_S, STOP_S = 1.0, 1.5  # limits of a stop: for the write-back, and in total


class Phase(Enum):
    """Phase of the session with the device."""

    CLOSED = "closed"
    IDENTIFYING = "identifying"
    READING = "reading registers"
    KEEPING = "keeping the user's outputs"
    SETTING_UP = "setting up the stream"
    READY = "ready"
    RUNNING = "running a procedure"
    LOOKING = "reading identity and registers again"
    SERVING = "working for a client"
    RESTORING = "restoring"
    CLOSING = "journalling that all is put back"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class Identified:
    """The device was identified."""

    identity: Identity


@dataclass(frozen=True, slots=True)
class ConfigurationRead:
    """All registers were read."""

    values: dict[int, Values]


@dataclass(frozen=True, slots=True)
class StreamChanged:
    """Outputs were set up or restored: samples before and after are not contiguous."""

    text: str
    level: str = "info"


@dataclass(frozen=True, slots=True)
class Unanswered:
    """The device does not identify itself: only listen, and retry now and then."""

    text: str


@dataclass(frozen=True, slots=True)
class Completed:
    """A procedure started with `run` ended; `error` is None if it succeeded."""

    name: str
    result: object
    error: Exception | None


@dataclass(frozen=True, slots=True)
class Looked:
    """Who answered and its registers; `seen` None: no answer, for the reason in `error`."""

    seen: Seen | None
    error: Exception | None = None


@dataclass(frozen=True, slots=True)
class Served:
    """A client's command was answered with `result` (a Reply), or ended with `error`."""

    result: object
    error: Exception | None


@dataclass(frozen=True, slots=True)
class Closed:
    """The session is closed; `error` says what could not be restored, None if all was."""

    error: Exception | None


DeviceEvent = (
    Identified
    | ConfigurationRead
    | StreamChanged
    | Unanswered
    | Completed
    | Looked
    | Served
    | Closed
)
_ENDING = (Phase.RESTORING, Phase.CLOSING, Phase.DONE)


class OutOfTime(SessionError):
    """A stop took too long; from the journal the next run knows what to restore."""

    def __init__(self, why: str) -> None:
        super().__init__(f"{why}; the next run with device.configure_stream puts it back")


@dataclass(slots=True)
class StopLimit:
    """The two deadlines of a stop, None before it. `closing`: the first one no longer applies."""

    scale: float = 1.0
    patience_s: float | None = None
    end_s: float | None = None
    closing: bool = False

    @property
    def due_s(self) -> float | None:
        """The next deadline."""
        return self.end_s if self.closing else self.patience_s

    def begin(self, now_s: float) -> None:
        """A stop was requested; a second request changes nothing."""
        if self.end_s is None:
            self.patience_s = now_s + self.scale * PATIENCE_S
            self.end_s = now_s + self.scale * STOP_S

    def may_wait(self, now_s: float) -> bool:
        """Whether work under way may still be finished."""
        return self.patience_s is None or now_s < self.patience_s

    def expired(self, now_s: float) -> bool:
        """Whether the stop must end now."""
        return self.end_s is not None and now_s >= self.end_s


@dataclass(slots=True)
class OutputWatchdog:
    """When to request output from a device that should be streaming; it never gives up.

    Two causes: no measurement came for a while (the output was paused for a command and not
    resumed, because the reply or the command was lost), or a change of the outputs failed (the
    user's could not be restored, or the session's not set up). A retry of such a change does not
    wait for silence, and may wait longer if the device streams by itself.
    """

    scale: float = 1.0  # factor on all waits
    times_asked: int = 0  # requests since the newest measurement
    _silent_until_s: float | None = None
    _retry_at_s: float | None = None
    _retry_wait_s: float = 0.0

    @property
    def due_s(self) -> float | None:
        """The next deadline; None if there is none."""
        due = [time_s for time_s in (self._silent_until_s, self._retry_at_s) if time_s is not None]
        return min(due, default=None)

    @property
    def retrying(self) -> bool:
        """Whether the newest change of the outputs failed."""
        return self._retry_wait_s > 0.0

    def start(self, now_s: float) -> None:
        """From now on the device should stream."""
        wait_s = min(FIRST_S * 2 ** max(0, self.times_asked - 1), LONGEST_S)
        self._silent_until_s = now_s + self.scale * wait_s

    def on_measurement(self, now_s: float) -> None:
        """A measurement came: restart the wait."""
        self.times_asked = 0
        self.start(now_s)

    def schedule_retry(self, now_s: float, first_s: float, longest_s: float) -> None:
        """Retry after `first_s`, then double the wait up to `longest_s`, also while it streams."""
        self._retry_wait_s = min(max(2.0 * self._retry_wait_s, first_s), longest_s)
        self._retry_at_s = now_s + self.scale * self._retry_wait_s

    def cancel_retry(self) -> None:
        """The change succeeded."""
        self._retry_at_s, self._retry_wait_s = None, 0.0

    def retry_due(self, now_s: float) -> bool:
        """Whether to retry now; report the result with `schedule_retry` or `cancel_retry`."""
        due = self._retry_at_s is not None and now_s >= self._retry_at_s
        if due:
            self._retry_at_s = None
        return due

    def expired(self, now_s: float) -> bool:
        """Whether no measurement came for too long; if so, the next wait is longer."""
        if self._silent_until_s is None or now_s < self._silent_until_s:
            return False
        self.times_asked += 1
        self.start(now_s)
        return True


class DeviceSession:
    """Owns the driver's session. Calls return measurements, `take_events` the other events."""

    def __init__(
        self,
        mode: Mode,
        *,
        change_stream: bool = False,
        rate_hz: float = 100.0,
        reply_timeout_s: float = USUAL_REPLY_S,
    ) -> None:
        self.mode = mode
        self.change_stream = change_stream and mode is not Mode.PASSIVE
        self.rate_hz = rate_hz
        self._may_resume = self.change_stream or mode >= Mode.STAGE  # whether to send VNASY,1
        self._resume_purpose = Purpose.STREAM if self.change_stream else Purpose.ROLL_BACK
        self.phase = Phase.CLOSED
        self.identity: Identity | None = None
        self.outputs, self.clients = KeptOutputs(), ClientSettings()
        scale = max(1.0, reply_timeout_s / USUAL_REPLY_S)
        self.watchdog, self.limit = OutputWatchdog(scale), StopLimit(scale)
        self.session = Session(self._allowed, reply_timeout_s=reply_timeout_s)
        self._purpose = Purpose.READ
        self._extra_gate: Callable[[Command], bool] | None = None
        self._serial: int | None = None
        self._name = ""
        self._baud = 115200
        self._outputs_changed = self._unanswered = self._journal_refused = False
        self._failure = "no answer in time"  # why something was not restored
        self._ask_again_s = ASK_AGAIN_S[0]
        self._serving: Speech = RESUME
        self._own_layout, self._foreign = "", 0  # of its output; others since then
        self._events: list[DeviceEvent] = []

    def _allowed(self, command: Command) -> bool:
        clients = self.clients.now
        if not permitted(command, self.mode, self.change_stream, self._purpose, clients):
            return False
        return self._extra_gate is None or self._extra_gate(command)

    @property
    def idle(self) -> bool:
        """Whether a procedure may be started now."""
        return self.phase is Phase.READY and not self.session.busy

    @property
    def listening(self) -> bool:
        """Whether no procedure pauses the device's output."""
        return self.phase in (Phase.READY, Phase.LOOKING, Phase.SERVING)

    @property
    def may_close(self) -> bool:
        """Whether nothing is under way that must end before the port is closed."""
        return self.phase not in (Phase.RUNNING, Phase.RESTORING)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` must be called if nothing arrives before."""
        due = [self.session.deadline_s, self.limit.due_s]
        if self.idle and self._may_resume and self._writable:
            due.append(self.watchdog.due_s)
        return min((d for d in due if d is not None), default=None)

    @property
    def session_keys(self) -> frozenset[int]:
        """Registers changed by this session, by a killed one before it, or by clients."""
        ours = SESSION_SETTINGS if self.change_stream or self.outputs.left else ()
        return frozenset((*ours, *self.clients.now))

    def take_events(self) -> list[DeviceEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def on_opened(self, baud: int, now_s: float) -> list[Event]:
        """The port was opened: identify the device."""
        self._baud, self._ask_again_s = baud, ASK_AGAIN_S[0]
        if self.mode is Mode.PASSIVE:
            self.phase = Phase.READY
            return []
        return self.identify_again(now_s)

    def on_registers_and_journal(
        self, registers: Mapping[int, Values], journal: Sequence[JournalRecord] | None
    ) -> dict[int, Values]:
        """Registers and journal were read; returns the registers with the user's values.

        With `change_stream`, the session's outputs are set up once the user's are journaled.
        """
        if self._serial is None or self.mode is Mode.PASSIVE:
            return dict(registers)
        self.outputs.update(self._serial, registers, journal)
        if self.outputs.left and not self._outputs_changed:
            self._warn(self.outputs.describe_left(put_back=self.change_stream))
        if self.phase is Phase.KEEPING:
            self.outputs.request_set_up()
        return {**registers, **self.outputs.users, **self.clients.drop_overwritten(registers)}

    def on_journalled(self, kind: RecordKind, error: str, now_s: float) -> None:
        """A record of the user's outputs is on the disk, or failed with `error`."""
        kept = self.outputs.on_journalled(kind, error)
        if self.phase is Phase.CLOSING and kind is RecordKind.OUTPUTS_BACK:
            self._finish(None)
        elif self.phase is Phase.KEEPING and not kept:
            if not self._journal_refused:
                self._warn("the user's outputs cannot be journalled, so no others are set up")
            self.phase, self._journal_refused = Phase.READY, True
            self.watchdog.schedule_retry(now_s, *KEEP_AGAIN_S)

    def identify_again(self, now_s: float) -> list[Event]:
        """The device may be another one, or have been reset: identify and read it again."""
        if self.mode is Mode.PASSIVE or self.phase in _ENDING:
            return []
        events = self._abandon(now_s)
        self.phase = Phase.IDENTIFYING
        return events + self._process(self._start(identify_surely(), Purpose.READ, now_s), now_s)

    def receive(self, data: bytes, now_s: float) -> list[Event]:
        """Take bytes; returns measurements, faults and strays, in order."""
        events = self._process(self.session.receive(data, now_s), now_s)
        if self._own_layout and self._own_output_lost(events) and self.idle:
            self._warn("the session's output is gone: the device restarted, or somebody changed it")
            events += self.identify_again(now_s)
        if any(isinstance(event, Measurement) for event in events):
            self.watchdog.on_measurement(now_s)
        return events + self._handle_deadlines(now_s)

    def tick(self, now_s: float) -> list[Event]:
        """Handle the deadlines that have passed."""
        return self._process(self.session.tick(now_s), now_s) + self._handle_deadlines(now_s)

    def on_link_lost(self, now_s: float) -> list[Event]:
        """The port was lost."""
        events = self._abandon(now_s)
        if self.phase is not Phase.DONE:
            self.phase = Phase.CLOSED
        self.identity = None
        return events

    def _abandon(self, now_s: float) -> list[Event]:
        """End the running procedure without sending; only the write-back and clients hear of it."""
        self._own_layout = ""
        if self.phase is Phase.SERVING:
            self._events.append(Served(None, LinkGone()))
        if self.phase not in (Phase.RUNNING, Phase.RESTORING):
            self.phase = Phase.CLOSED
        return self._process(self.session.link_lost(now_s), now_s)

    def run(
        self,
        name: str,
        procedure: Procedure[object],
        purpose: Purpose,
        now_s: float,
        gate: Callable[[Command], bool] | None = None,
    ) -> list[Event]:
        """Start a procedure of the write-back; only while `idle`. `gate` allows each command."""
        self.phase, self._name, self._extra_gate = Phase.RUNNING, name, gate
        return self._process(self._start(procedure, purpose, now_s), now_s)

    def look(self, unit: Unit, expected: Mapping[int, Values], now_s: float) -> list[Event]:
        """Read identity and registers without pausing the output; only while `idle`."""
        self.phase = Phase.LOOKING
        return self._process(self._start(look(unit, expected), Purpose.READ, now_s), now_s)

    def stop_looking(self, now_s: float) -> list[Event]:
        """Cancel a look, or a client's read, for something more urgent; never a client's write."""
        reading = self.phase is Phase.SERVING and isinstance(self._serving, Read)
        if not (reading or self.phase is Phase.LOOKING):
            return []
        return self._process(self.session.cancel(now_s), now_s)

    def serve(
        self,
        command: Speech,
        now_s: float,
        purpose: Purpose = Purpose.CLIENT,
        known: Seen | None = None,
    ) -> list[Event]:
        """Send a client's command without pausing the output; only while `idle`.

        known: send it only to this unit while it holds these values; otherwise NotAsKnown
        """
        self.phase, self._serving = Phase.SERVING, command
        procedure = asked(command) if known is None else asked_of(known, command)
        return self._process(self._start(procedure, purpose, now_s), now_s)

    def cancel(self, name: str, now_s: float) -> list[Event]:
        """Cancel the procedure of this name if it runs; it may still send commands that restore."""
        if self.phase is not Phase.RUNNING or self._name != name:
            return []
        return self._process(self.session.cancel(now_s), now_s)

    def set_up_again(self, now_s: float) -> list[Event]:
        """Set up the session's outputs; the user's were restored for a save, or journaled."""
        if self.clients.now and self.idle:
            self.phase, wanted = Phase.SETTING_UP, dict(self.clients.now)
            return self._process(self._start(restore(wanted, wanted), Purpose.CLIENT, now_s), now_s)
        may = self.change_stream and self._writable
        if not (may and (self.idle or self.phase is Phase.KEEPING)):
            return []
        if not self.outputs.kept:  # the disk was full until now: journal first
            self.phase = Phase.KEEPING
            self.outputs.request_set_up()
            return []
        self.phase = Phase.SETTING_UP
        self._journal_refused = False
        self._outputs_changed = True  # from the first byte on, even if the procedure fails half way
        procedure = configure_stream(self.rate_hz, self._baud, self.outputs.users)
        return self._process(self._start(procedure, Purpose.STREAM, now_s), now_s)

    def restore_and_close(self, now_s: float) -> list[Event]:
        """Restore what the session changed, then report Closed. Ends what is under way."""
        linked, self.limit.closing = self.phase is not Phase.CLOSED, True
        if self.phase is Phase.RUNNING and not self._must_restore:
            return self._give_up(now_s)
        events = [] if self.idle else self._abandon(now_s)
        if not (self._must_restore and linked):
            self._finish(LinkGone() if self._must_restore else None)
            return events
        return events + self._restore(0.0, now_s)

    def cleanup(self) -> Procedure[object] | None:
        """Procedure that restores the device's output after this program failed; None: not needed.

        Not for `run`: the caller trusts no state of this object except the saved one.
        """
        if self._must_restore and self.identity is not None:
            return quiet(restore(self.outputs.users, SESSION_SETTINGS))
        paused = self.phase in (Phase.RUNNING, Phase.RESTORING) and self.mode >= Mode.STAGE
        return resume() if paused else None

    def allows_cleanup(self, command: Command) -> bool:
        """The gate of `cleanup`."""
        return permitted(command, self.mode, self.change_stream, self._resume_purpose)

    @property
    def _writable(self) -> bool:
        """False for a device that is only observed: another model, or an unknown firmware."""
        return self.identity is None or self.identity.profile.writable

    @property
    def _must_restore(self) -> bool:
        """Whether the device that was read may hold settings of this session."""
        left = self.change_stream and bool(self.outputs.left)
        return (self._outputs_changed or left) and bool(self.outputs.users) and self._writable

    def _handle_deadlines(self, now_s: float) -> list[Event]:
        """Act on expired deadlines: the end of a stop, a retry, a silent device."""
        if self.limit.expired(now_s):
            return [] if self.phase is Phase.DONE else self._give_up(now_s)
        if not (self.idle and self._may_resume and self._writable):
            return []
        if self.watchdog.retry_due(now_s):
            if not self._journal_refused:
                return self.identify_again(now_s)
            self.phase = Phase.KEEPING
            self.outputs.request_set_up()
            return []
        if not self.watchdog.expired(now_s):
            return []
        if self.watchdog.times_asked == 1:
            self._warn("the device is silent: asking for its output again and again")
        if self.watchdog.times_asked > 1 and self.change_stream:
            return self.identify_again(now_s)
        self._resume_blindly()  # harmless if the device is only slow
        return []

    def _resume_blindly(self) -> None:
        """Send VNASY,1 without waiting for the reply."""
        self._purpose, self._extra_gate = self._resume_purpose, None
        self.session.last_word(RESUME)

    def _give_up(self, now_s: float) -> list[Event]:
        """End a stop that takes too long; send a last VNASY,1 without waiting for the reply."""
        linked, self.phase = self.phase is not Phase.CLOSED, Phase.CLOSED
        events = self._abandon(now_s)
        if linked and self._may_resume and self._writable:
            self._resume_blindly()
        self._finish(OutOfTime(self._failure) if self._must_restore else None)
        return events

    def _warn(self, text: str) -> None:
        self._events.append(StreamChanged(text, "warning"))

    def _finish(self, error: Exception | None) -> None:
        self.phase = Phase.DONE
        self._events.append(Closed(error))

    def _restore(self, wait_s: float, now_s: float) -> list[Event]:
        self.phase = Phase.RESTORING
        procedure = put_back_to(self._serial, self.outputs.users, wait_s)
        return self._process(self._start(procedure, Purpose.STREAM, now_s), now_s)

    def _own_output_lost(self, events: list[Event]) -> bool:
        names = [event.layout.name for event in events if isinstance(event, Measurement)]
        self._foreign = 0 if self._own_layout in names else self._foreign + len(names)
        return self._foreign >= _FOREIGN

    def _start(self, procedure: Procedure[object], purpose: Purpose, now_s: float) -> list[Event]:
        self._purpose = purpose
        return self.session.start(procedure, now_s)

    def _process(self, events: list[Event], now_s: float) -> list[Event]:
        """Return the events for the core; advance the phase for each procedure that ended."""
        kept: list[Event] = []
        queue = list(events)
        while queue:
            event = queue.pop(0)
            if isinstance(event, ProcedureFinished):
                queue = self._advance(event.result, None, now_s) + queue
            elif isinstance(event, ProcedureFailed):
                queue = self._advance(None, event.error, now_s) + queue
            else:
                kept.append(event)
        return kept

    def _advance(self, result: object, error: Exception | None, now_s: float) -> list[Event]:
        phase = self.phase
        if phase is Phase.RUNNING:
            self._extra_gate = None
            self._enter_ready(now_s)
            self._events.append(Completed(self._name, result, error))
            return []
        if phase is Phase.LOOKING:
            self._enter_ready(now_s)
            self._events.append(Looked(result if isinstance(result, Seen) else None, error))
            return []
        if phase is Phase.SERVING:
            self._enter_ready(now_s)
            self._events.append(Served(result, error))
            return []
        if phase is Phase.CLOSED:
            return []
        if phase is Phase.RESTORING:
            return self._on_restored(error, now_s)
        if phase is Phase.SETTING_UP and error is not None:
            return self._on_set_up_failed(error, now_s)
        if error is not None:
            self._report_unanswered(f"{phase.value}: {error}")
            self.phase = Phase.IDENTIFYING
            later, self._ask_again_s = self._ask_again_s, min(2 * self._ask_again_s, ASK_AGAIN_S[1])
            return self._start(identify_in(later), Purpose.READ, now_s)
        return self._continue_from(phase, result, now_s)

    def _on_restored(self, error: Exception | None, now_s: float) -> list[Event]:
        """Retry if restoring failed; `StopLimit` ends the retries."""
        if isinstance(error, LinkGone | WrongDevice):
            self._finish(error)
        elif error is not None:
            self._failure = str(error)
            return self._restore(RESTORE_AGAIN_S, now_s)
        else:
            self._outputs_changed, self.phase = False, Phase.CLOSING
            self._events.append(StreamChanged("outputs put back as they were"))
            self.outputs.record_restored()
        return []

    def _on_set_up_failed(self, error: Exception, now_s: float) -> list[Event]:
        waits = retry_waits(error)
        own = "" if waits is PUT_BACK_AGAIN_S else ", its own output stays"
        if not self.watchdog.retrying:
            self._warn(f"the session's output cannot be set up{own}: {error}")
        else:
            self._events.append(StreamChanged(""))
        if waits is not None:
            self.watchdog.schedule_retry(now_s, *waits)
        self._enter_ready(now_s)
        return []

    def _enter_ready(self, now_s: float) -> None:
        self.phase = Phase.READY
        self.watchdog.start(now_s)

    def _report_unanswered(self, text: str) -> None:
        """Report once. The samples of a known device are not used until it has been read."""
        if not self._unanswered:
            known = StreamChanged(f"{text}; asking again", "warning")
            self._events.append(Unanswered(text) if self._serial is None else known)
        self._unanswered = True

    def _continue_from(self, phase: Phase, result: object, now_s: float) -> list[Event]:
        if phase is Phase.IDENTIFYING and isinstance(result, Identity):
            if result.serial != self._serial:
                self._outputs_changed = False  # never restore another device's values
            self.identity, self._serial = result, result.serial
            self.clients.select_device(result.serial)
            self._events.append(Identified(result))
            self.phase = Phase.READING
            twice = (*CALIBRATION, *(SESSION_SETTINGS if self.change_stream else ()))
            return self._start(read_surely(result, twice), Purpose.READ, now_s)
        if phase is Phase.READING and isinstance(result, dict) and self.identity is not None:
            self._unanswered, self._ask_again_s = False, ASK_AGAIN_S[0]
            self.identity = self.identity.observed_without(result)
            if not self._writable:
                why = self.identity.profile.observed_for
                self._warn(f"observed only, nothing is written to it: {why}")
            self._events.append(ConfigurationRead(result))
            if self.change_stream and self._writable:
                self.phase = Phase.KEEPING
                return []
        if isinstance(result, CalibrationStream):
            self._own_layout, self._foreign = result.layout, 0
            self.watchdog.cancel_retry()
            self._events.append(StreamChanged(f"output set up for the session: {result}"))
        self._enter_ready(now_s)
        return []


def retry_waits(error: Exception) -> tuple[float, float] | None:
    """First and longest wait after a set-up failed with `error`; None if it can never succeed."""
    if isinstance(error, NotPutBack):
        return PUT_BACK_AGAIN_S
    return None if isinstance(error, DoesNotFit | NoStream) else SET_UP_AGAIN_S
