"""One device, from the open port to the closed one: identify, read, set up the stream, put it back.

```
 CLOSED -> IDENTIFYING -> READING -> [KEEPING -> SETTING_UP] -> READY -> RESTORING -> DONE
                                                                READY <-> RUNNING (the write-back)
                                                                READY <-> LOOKING (who answers?)
                                                                READY <-> SERVING (a client's)
```
Before the session's outputs are set up, the journal keeps the user's (KEEPING, `KeptOutputs`).
A device that stops sending although its output may be switched on is asked for it
(`OutputWatchdog`), and a stop ends within `STOP_S`, whatever the device does (`StopLimit`).

In mode `passive` the port goes from CLOSED to READY at once and no byte is ever sent. A device that
answers nothing is listened to and asked again now and then: it stays IDENTIFYING, without an
identity, so nothing can be written to it.

**The user's outputs.** A session changes registers 6 and 75 to 77. A program that is killed cannot
put them back, and the next one would take what it finds for the user's. So the user's values go
into the journal before the first byte (`OUTPUTS_KEPT`), and are done with when they were put back
(`OUTPUTS_BACK`).

A record that is still open tells a run whose outputs it finds, register by register: what only a
session leaves there (`calibration_stream.left_by_session`) stands for the value that was kept; any
other value was put there since, by a person or by a restart of the device, and is the user's own.

**Settings of clients.** A driver sets its outputs at every start, in RAM. For the user's own
configuration they count as little as a session of ours: they are put back before a save and set
again behind it, so that a save of a calibration makes nothing else permanent. When the device
restarts they are gone, and what a client saves itself is the user's from then on.
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
    """What is known of the user's outputs of one device, the one that was read last.

    users: by register, empty before a device was read
    left:  registers in which a session that did not end left its own values
    """

    def __init__(self) -> None:
        self.users: dict[int, Values] = {}
        self.left: tuple[int, ...] = ()
        self._serial: int | None = None
        self._kept: dict[int, Values] | None = None  # as the open record has them
        self._actions: list[Action] = []

    @property
    def kept(self) -> bool:
        """Whether the journal has the user's outputs as they are."""
        return self._kept == self.users

    def read(
        self, serial: int, registers: Mapping[int, Values], journal: Sequence[JournalRecord] | None
    ) -> None:
        """A device and its journal were read; None: the journal cannot be trusted.

        Then what this run itself has kept for the device is better than nothing.
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

    def keep(self) -> None:
        """Set up the session's outputs, behind a record of the user's where there is none yet."""
        if self.kept:
            self._actions.append(SetUpStream())
        else:
            self._actions.append(AppendToJournal(RecordKind.OUTPUTS_KEPT, self._facts()))

    def give_back(self) -> None:
        """The user's outputs are in the device again."""
        self._actions.append(AppendToJournal(RecordKind.OUTPUTS_BACK, {"serial": self._serial}))

    def journalled(self, kind: RecordKind, error: str) -> bool:
        """A record of this kind is on the disk, or is not; what waited for it follows."""
        if error:
            return False
        self._kept = dict(self.users) if kind is RecordKind.OUTPUTS_KEPT else None
        if kind is RecordKind.OUTPUTS_KEPT:
            self._actions.append(SetUpStream())
        return True

    def take_actions(self) -> list[Action]:
        """What the core is to do now."""
        actions, self._actions = self._actions, []
        return actions

    def describe_left(self, *, put_back: bool) -> str:
        """For the log: what a killed session left, and what a person may do."""
        lines = " ".join(register_lines({n: self.users[n] for n in self.left}))
        text = f"outputs of a session that was killed are in the device; the user's are {lines}"
        if put_back:
            return text
        return f"{text}; type that or set device.configure_stream, until then nothing is saved"

    def _facts(self) -> dict[str, Any]:
        """`old` is what a person goes back to."""
        values = {str(number): list(row) for number, row in sorted(self.users.items())}
        return {"serial": self._serial, "old": values}


def open_record(journal: Sequence[JournalRecord], serial: int) -> dict[int, Values] | None:
    """The outputs that were kept and not put back; None where nothing is open."""
    kept: dict[int, Values] | None = None
    for record in journal:
        if record.kind == RecordKind.OUTPUTS_BACK:
            kept = None
        elif record.kind == RecordKind.OUTPUTS_KEPT and record.facts.get("serial") == serial:
            kept = {int(number): tuple(row) for number, row in record.facts["old"].items()}
    return kept


# -- Settings of clients ---------------------------------------------------------------------------


class ClientSettings:
    """Of one device. `now`: what the clients set; `users`: what these registers held before."""

    def __init__(self) -> None:
        self.now: dict[int, Values] = {}
        self.users: dict[int, Values] = {}
        self._serial: int | None = None

    def of(self, serial: int) -> None:
        """This device was identified; another one has none of it."""
        if self._serial != serial:
            self._serial = serial
            self.forget()

    def written(self, number: int, values: Values, before: Values | None) -> None:
        """A client's write was carried out; `before` None: nobody knows what was there."""
        if before is None:
            return
        users = self.users.setdefault(number, before)
        self.now[number] = values
        if same(number, users, values):  # the user's own again
            del self.users[number], self.now[number]

    def read(self, registers: Mapping[int, Values]) -> dict[int, Values]:
        """All registers were read; those that still hold a client's value, as the user had them."""
        for number in list(self.now):
            if not same(number, self.now[number], registers.get(number, ())):
                del self.users[number], self.now[number]
        return dict(self.users)

    def forget(self) -> None:
        """They are saved, and so the user's."""
        self.now, self.users = {}, {}


# -- The session -----------------------------------------------------------------------------------


ASK_AGAIN_S = (0.5, 8.0)  # a device that does not answer: first wait, longest wait
RESTORE_AGAIN_S = 0.1
_FOREIGN = 20  # messages without one of the session's own output: it is gone
FIRST_S, LONGEST_S = 2.0, 5.0  # outputs have 1 Hz at least, so 2 s without one is a silence
# First and longest wait: after the journal refused the user's outputs; where they could not be put
# back; where they were, but the session's not be set up (a trial fits into the last one)
KEEP_AGAIN_S, PUT_BACK_AGAIN_S, SET_UP_AGAIN_S = (30.0, 30.0), (0.5, 5.0), (5.0, 1800.0)
USUAL_REPLY_S = 0.4  # where replies may take longer, so may all of this
PATIENCE_S, STOP_S = 1.0, 1.5  # after a stop: for the write-back to end, and for everything


class Phase(Enum):
    """Where the session with the device stands."""

    CLOSED = "closed"
    IDENTIFYING = "identifying"
    READING = "reading registers"
    KEEPING = "keeping the user's outputs"
    SETTING_UP = "setting up the stream"
    READY = "ready"
    RUNNING = "running a procedure"
    LOOKING = "asking who answers and what it holds"
    SERVING = "asking for a client"
    RESTORING = "restoring"
    CLOSING = "noting that all is put back"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class Identified:
    """The device said who it is."""

    identity: Identity


@dataclass(frozen=True, slots=True)
class ConfigurationRead:
    """All registers, as they were read."""

    values: dict[int, Values]


@dataclass(frozen=True, slots=True)
class StreamChanged:
    """Outputs were set up or put back: samples before and after do not follow each other."""

    text: str
    level: str = "info"


@dataclass(frozen=True, slots=True)
class Unanswered:
    """The device does not say who it is; it is only listened to, and asked again now and then."""

    text: str


@dataclass(frozen=True, slots=True)
class Completed:
    """A procedure that was asked for with `run` ended: `error` None where it did what it should."""

    name: str
    result: object
    error: Exception | None


@dataclass(frozen=True, slots=True)
class Looked:
    """Who answered and what it holds; None where there was no answer, and why."""

    seen: Seen | None
    error: Exception | None = None


@dataclass(frozen=True, slots=True)
class Served:
    """A client's command was answered with `result` (a Reply), or ended with `error`."""

    result: object
    error: Exception | None


@dataclass(frozen=True, slots=True)
class Closed:
    """Everything is put back; `error` says what is not."""

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
    """A stop took too long; the journal tells the next run what is to be put back."""

    def __init__(self, why: str) -> None:
        super().__init__(f"{why}; the next run with device.configure_stream puts it back")


@dataclass(slots=True)
class StopLimit:
    """The two times that a stop sets; None before it. `closing`: the first one is over."""

    scale: float = 1.0
    patience_s: float | None = None
    end_s: float | None = None
    closing: bool = False

    @property
    def due_s(self) -> float | None:
        """When to look next."""
        return self.end_s if self.closing else self.patience_s

    def begin(self, now_s: float) -> None:
        """A stop was asked for; a second one changes nothing."""
        if self.end_s is None:
            self.patience_s = now_s + self.scale * PATIENCE_S
            self.end_s = now_s + self.scale * STOP_S

    def patient(self, now_s: float) -> bool:
        """Whether others may still end what they have under way."""
        return self.patience_s is None or now_s < self.patience_s

    def over(self, now_s: float) -> bool:
        """Whether nothing more may be waited for."""
        return self.end_s is not None and now_s >= self.end_s


@dataclass(slots=True)
class OutputWatchdog:
    """When a device that ought to stream is asked for its output: again and again, for ever.

    Two things call for it: no measurement came for a while (the output was paused for a command
    and not resumed, because the reply or the command got lost), or a change of the outputs failed
    (the user's could not be put back, or the session's not be set up). A retry of such a change
    does not wait for silence and, where the device streams by itself, may wait longer.
    """

    scale: float = 1.0  # of all waits
    times_asked: int = 0  # since the newest measurement
    _silent_until_s: float | None = None
    _retry_at_s: float | None = None
    _retry_wait_s: float = 0.0

    @property
    def due_s(self) -> float | None:
        """When to ask; None where nothing is waited for."""
        due = [time_s for time_s in (self._silent_until_s, self._retry_at_s) if time_s is not None]
        return min(due, default=None)

    @property
    def retrying(self) -> bool:
        """Whether the newest change of the outputs failed."""
        return self._retry_wait_s > 0.0

    def start(self, now_s: float) -> None:
        """From now on the device ought to stream."""
        wait_s = min(FIRST_S * 2 ** max(0, self.times_asked - 1), LONGEST_S)
        self._silent_until_s = now_s + self.scale * wait_s

    def heard(self, now_s: float) -> None:
        """A measurement came."""
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
        """Whether to retry now; then `schedule_retry` or `cancel_retry` says how that went."""
        due = self._retry_at_s is not None and now_s >= self._retry_at_s
        if due:
            self._retry_at_s = None
        return due

    def expired(self, now_s: float) -> bool:
        """Whether no measurement came for too long; then the next wait is longer."""
        if self._silent_until_s is None or now_s < self._silent_until_s:
            return False
        self.times_asked += 1
        self.start(now_s)
        return True


class DeviceSession:
    """Owns the driver's session. Calls return measurements; what else happened, `take_events`."""

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
        self._may_ask = self.change_stream or mode >= Mode.STAGE  # may send VNASY,1, as what:
        self._asking = Purpose.STREAM if self.change_stream else Purpose.ROLL_BACK
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
        self._touched = self._unanswered = self._unkept = False
        self._failure = "no answer in time"  # why something was not put back
        self._ask_again_s = ASK_AGAIN_S[0]
        self._serving: Speech = RESUME
        self._own, self._foreign = "", 0  # layout of the session's output; others without it
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
        """Whether the device's output runs as it is, undisturbed by a procedure."""
        return self.phase in (Phase.READY, Phase.LOOKING, Phase.SERVING)

    @property
    def may_close(self) -> bool:
        """Nothing is under way that must end before the port may be given back."""
        return self.phase not in (Phase.RUNNING, Phase.RESTORING)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` wants to be called if nothing arrives before."""
        due = [self.session.deadline_s, self.limit.due_s]
        if self.idle and self._may_ask and self._writable:
            due.append(self.watchdog.due_s)
        return min((d for d in due if d is not None), default=None)

    @property
    def session_keys(self) -> frozenset[int]:
        """Registers that this session, or one before it that was killed, changed."""
        ours = SESSION_SETTINGS if self.change_stream or self.outputs.left else ()
        return frozenset((*ours, *self.clients.now))

    def take_events(self) -> list[DeviceEvent]:
        """What happened since the last call."""
        events, self._events = self._events, []
        return events

    def opened(self, baud: int, now_s: float) -> list[Event]:
        """The port is open."""
        self._baud, self._ask_again_s = baud, ASK_AGAIN_S[0]
        if self.mode is Mode.PASSIVE:
            self.phase = Phase.READY
            return []
        return self.identify_again(now_s)

    def known(
        self, registers: Mapping[int, Values], journal: Sequence[JournalRecord] | None
    ) -> dict[int, Values]:
        """Registers and journal of the device are there; returns them as the user has them.

        With `change_stream`, the session's outputs follow as soon as the journal has the user's.
        """
        if self._serial is None or self.mode is Mode.PASSIVE:
            return dict(registers)
        self.outputs.read(self._serial, registers, journal)
        if self.outputs.left and not self._touched:
            self._warn(self.outputs.describe_left(put_back=self.change_stream))
        if self.phase is Phase.KEEPING:
            self.outputs.keep()
        return {**registers, **self.outputs.users, **self.clients.read(registers)}

    def journalled(self, kind: RecordKind, error: str, now_s: float) -> None:
        """A record of the user's outputs is on the disk, or is not."""
        kept = self.outputs.journalled(kind, error)
        if self.phase is Phase.CLOSING and kind is RecordKind.OUTPUTS_BACK:
            self._done(None)
        elif self.phase is Phase.KEEPING and not kept:
            if not self._unkept:
                self._warn("the user's outputs cannot be journalled, so no others are set up")
            self.phase, self._unkept = Phase.READY, True
            self.watchdog.schedule_retry(now_s, *KEEP_AGAIN_S)

    def identify_again(self, now_s: float) -> list[Event]:
        """The device may be another one, or itself after a reset: ask it everything again."""
        if self.mode is Mode.PASSIVE or self.phase in _ENDING:
            return []
        events = self._abandon(now_s)
        self.phase = Phase.IDENTIFYING
        return events + self._digest(self._start(identify_surely(), Purpose.READ, now_s), now_s)

    def received(self, data: bytes, now_s: float) -> list[Event]:
        """Bytes came; returns measurements, faults and strays, in order."""
        events = self._digest(self.session.receive(data, now_s), now_s)
        if self._own and self._own_is_gone(events) and self.idle:
            self._warn("the session's output is gone: the device restarted, or somebody changed it")
            events += self.identify_again(now_s)
        if any(isinstance(event, Measurement) for event in events):
            self.watchdog.heard(now_s)
        return events + self._on_time(now_s)

    def tick(self, now_s: float) -> list[Event]:
        """Time passed."""
        return self._digest(self.session.tick(now_s), now_s) + self._on_time(now_s)

    def lost(self, now_s: float) -> list[Event]:
        """The port went away."""
        events = self._abandon(now_s)
        if self.phase is not Phase.DONE:
            self.phase = Phase.CLOSED
        self.identity = None
        return events

    def _abandon(self, now_s: float) -> list[Event]:
        """End what runs without another byte; only the write-back is told how its own ended."""
        self._own = ""
        if self.phase is Phase.SERVING:
            self._events.append(Served(None, LinkGone()))
        if self.phase not in (Phase.RUNNING, Phase.RESTORING):
            self.phase = Phase.CLOSED
        return self._digest(self.session.link_lost(now_s), now_s)

    def run(
        self,
        name: str,
        procedure: Procedure[object],
        purpose: Purpose,
        now_s: float,
        gate: Callable[[Command], bool] | None = None,
    ) -> list[Event]:
        """Start a procedure of the write-back; only while `idle`. `gate` is asked per command."""
        self.phase, self._name, self._extra_gate = Phase.RUNNING, name, gate
        return self._digest(self._start(procedure, purpose, now_s), now_s)

    def look(self, unit: Unit, expected: Mapping[int, Values], now_s: float) -> list[Event]:
        """Ask who answers and what it holds, beside the running output; only while `idle`."""
        self.phase = Phase.LOOKING
        return self._digest(self._start(look(unit, expected), Purpose.READ, now_s), now_s)

    def stop_looking(self, now_s: float) -> list[Event]:
        """Something more urgent waits; a client's question too, but nothing that changes things."""
        asks = self.phase is Phase.SERVING and isinstance(self._serving, Read)
        if not (asks or self.phase is Phase.LOOKING):
            return []
        return self._digest(self.session.cancel(now_s), now_s)

    def serve(
        self,
        command: Speech,
        now_s: float,
        purpose: Purpose = Purpose.CLIENT,
        known: Seen | None = None,
    ) -> list[Event]:
        """Send a client's command, beside the running output; only while `idle`.

        known: send it only to this unit while it holds these values; else NotAsKnown
        """
        self.phase, self._serving = Phase.SERVING, command
        procedure = asked(command) if known is None else asked_of(known, command)
        return self._digest(self._start(procedure, purpose, now_s), now_s)

    def cancel(self, name: str, now_s: float) -> list[Event]:
        """End the procedure of this name, if it runs; it may still send what puts things back."""
        if self.phase is not Phase.RUNNING or self._name != name:
            return []
        return self._digest(self.session.cancel(now_s), now_s)

    def set_up_again(self, now_s: float) -> list[Event]:
        """The user's own outputs are back for a save, or kept: set the session's up (again)."""
        if self.clients.now and self.idle:
            self.phase, wanted = Phase.SETTING_UP, dict(self.clients.now)
            return self._digest(self._start(restore(wanted, wanted), Purpose.CLIENT, now_s), now_s)
        may = self.change_stream and self._writable
        if not (may and (self.idle or self.phase is Phase.KEEPING)):
            return []
        if not self.outputs.kept:  # the disk was full until now: the journal first
            self.phase = Phase.KEEPING
            self.outputs.keep()
            return []
        self.phase = Phase.SETTING_UP
        self._unkept = False
        self._touched = True  # from the first byte on, also where it breaks off half way
        procedure = configure_stream(self.rate_hz, self._baud, self.outputs.users)
        return self._digest(self._start(procedure, Purpose.STREAM, now_s), now_s)

    def restore_and_close(self, now_s: float) -> list[Event]:
        """Put back what was changed for the session, then say Closed. Ends what is under way."""
        linked, self.limit.closing = self.phase is not Phase.CLOSED, True
        if self.phase is Phase.RUNNING and not self._must_restore:
            return self._give_up(now_s)
        events = [] if self.idle else self._abandon(now_s)
        if not (self._must_restore and linked):
            self._done(LinkGone() if self._must_restore else None)
            return events
        return events + self._restore(0.0, now_s)

    def cleanup(self) -> Procedure[object] | None:
        """What puts the device's output back after this program broke down; None: nothing need be.

        Not for `run`: whoever calls this trusts no state of this object but what was saved.
        """
        if self._must_restore and self.identity is not None:
            return quiet(restore(self.outputs.users, SESSION_SETTINGS))
        paused = self.phase in (Phase.RUNNING, Phase.RESTORING) and self.mode >= Mode.STAGE
        return resume() if paused else None

    def allows_cleanup(self, command: Command) -> bool:
        """The gate of `cleanup`."""
        return permitted(command, self.mode, self.change_stream, self._asking)

    @property
    def _writable(self) -> bool:
        """False for a device that is only observed: another model, or a firmware not known."""
        return self.identity is None or self.identity.profile.writable

    @property
    def _must_restore(self) -> bool:
        """The device that was read, and no other, may hold settings of this session."""
        left = self.change_stream and bool(self.outputs.left)
        return (self._touched or left) and bool(self.outputs.users) and self._writable

    def _on_time(self, now_s: float) -> list[Event]:
        """What is due without a word from the device: the end of a stop, a silence to be ended."""
        if self.limit.over(now_s):
            return [] if self.phase is Phase.DONE else self._give_up(now_s)
        if not (self.idle and self._may_ask and self._writable):
            return []
        if self.watchdog.retry_due(now_s):
            if not self._unkept:
                return self.identify_again(now_s)
            self.phase = Phase.KEEPING
            self.outputs.keep()
            return []
        if not self.watchdog.expired(now_s):
            return []
        if self.watchdog.times_asked == 1:
            self._warn("the device is silent: it is asked for its output, again and again")
        if self.watchdog.times_asked > 1 and self.change_stream:
            return self.identify_again(now_s)
        self._resume_blindly()  # costs nothing, should the device only be slow
        return []

    def _resume_blindly(self) -> None:
        """VNASY,1, and nobody waits for the reply."""
        self._purpose, self._extra_gate = self._asking, None
        self.session.last_word(RESUME)

    def _give_up(self, now_s: float) -> list[Event]:
        """What takes too long ends here; a last VNASY,1 goes out, its reply is not waited for."""
        linked, self.phase = self.phase is not Phase.CLOSED, Phase.CLOSED
        events = self._abandon(now_s)
        if linked and self._may_ask and self._writable:
            self._resume_blindly()
        self._done(OutOfTime(self._failure) if self._must_restore else None)
        return events

    def _warn(self, text: str) -> None:
        self._events.append(StreamChanged(text, "warning"))

    def _done(self, error: Exception | None) -> None:
        self.phase = Phase.DONE
        self._events.append(Closed(error))

    def _restore(self, wait_s: float, now_s: float) -> list[Event]:
        self.phase = Phase.RESTORING
        procedure = put_back_to(self._serial, self.outputs.users, wait_s)
        return self._digest(self._start(procedure, Purpose.STREAM, now_s), now_s)

    def _own_is_gone(self, events: list[Event]) -> bool:
        names = [event.layout.name for event in events if isinstance(event, Measurement)]
        self._foreign = 0 if self._own in names else self._foreign + len(names)
        return self._foreign >= _FOREIGN

    def _start(self, procedure: Procedure[object], purpose: Purpose, now_s: float) -> list[Event]:
        self._purpose = purpose
        return self.session.start(procedure, now_s)

    def _digest(self, events: list[Event], now_s: float) -> list[Event]:
        """Keep what is for the core's stream; let ends of procedures move the phase."""
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
            self._ready(now_s)
            self._events.append(Completed(self._name, result, error))
            return []
        if phase is Phase.LOOKING:
            self._ready(now_s)
            self._events.append(Looked(result if isinstance(result, Seen) else None, error))
            return []
        if phase is Phase.SERVING:
            self._ready(now_s)
            self._events.append(Served(result, error))
            return []
        if phase is Phase.CLOSED:
            return []
        if phase is Phase.RESTORING:
            return self._restored(error, now_s)
        if phase is Phase.SETTING_UP and error is not None:
            return self._not_set_up(error, now_s)
        if error is not None:
            self._report_unanswered(f"{phase.value}: {error}")
            self.phase = Phase.IDENTIFYING
            later, self._ask_again_s = self._ask_again_s, min(2 * self._ask_again_s, ASK_AGAIN_S[1])
            return self._start(identify_in(later), Purpose.READ, now_s)
        return self._next(phase, result, now_s)

    def _restored(self, error: Exception | None, now_s: float) -> list[Event]:
        """Once more where it failed: a stop has a limit of its own."""
        if isinstance(error, LinkGone | WrongDevice):
            self._done(error)
        elif error is not None:
            self._failure = str(error)
            return self._restore(RESTORE_AGAIN_S, now_s)
        else:
            self._touched, self.phase = False, Phase.CLOSING
            self._events.append(StreamChanged("outputs put back as they were"))
            self.outputs.give_back()
        return []

    def _not_set_up(self, error: Exception, now_s: float) -> list[Event]:
        again = again_after(error)
        own = "" if again is PUT_BACK_AGAIN_S else ", the device's own stays"
        if not self.watchdog.retrying:
            self._warn(f"the session's output cannot be set up{own}: {error}")
        else:
            self._events.append(StreamChanged(""))
        if again is not None:
            self.watchdog.schedule_retry(now_s, *again)
        self._ready(now_s)
        return []

    def _ready(self, now_s: float) -> None:
        self.phase = Phase.READY
        self.watchdog.start(now_s)

    def _report_unanswered(self, text: str) -> None:
        """Once. What a device that was known sends now is not used: its registers will be read."""
        if not self._unanswered:
            known = StreamChanged(f"{text}; asking again", "warning")
            self._events.append(Unanswered(text) if self._serial is None else known)
        self._unanswered = True

    def _next(self, phase: Phase, result: object, now_s: float) -> list[Event]:
        if phase is Phase.IDENTIFYING and isinstance(result, Identity):
            if result.serial != self._serial:
                self._touched = False  # nothing of another device's is put back to this one
            self.identity, self._serial = result, result.serial
            self.clients.of(result.serial)
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
            self._own, self._foreign = result.layout, 0
            self.watchdog.cancel_retry()
            self._events.append(StreamChanged(f"output set up for the session: {result}"))
        self._ready(now_s)
        return []


def again_after(error: Exception) -> tuple[float, float] | None:
    """The waits after a set-up that failed with `error`; None where it would fail for ever."""
    if isinstance(error, NotPutBack):
        return PUT_BACK_AGAIN_S
    return None if isinstance(error, DoesNotFit | NoStream) else SET_UP_AGAIN_S
