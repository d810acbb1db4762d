"""What the core says to the device, and when: identify, read, set up the stream, put it back.

```
 CLOSED -> IDENTIFYING -> READING -> [SETTING_UP] -> READY -> RESTORING -> DONE
                                                     READY <-> RUNNING (the write-back)
```
In mode `passive` the port goes from CLOSED to READY at once and no byte is ever sent. A device that
answers nothing is listened to and asked again now and then: it stays IDENTIFYING, without an
identity, so nothing can be written to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from ahrsd.writeback.permissions import Mode, Purpose, permitted
from drivers.vn100.calibration_stream import CalibrationStream, configure_stream
from drivers.vn100.commands import Command, LinkGone, Pause, Procedure
from drivers.vn100.decode import Measurement
from drivers.vn100.procedures import (
    SESSION_SETTINGS,
    Identity,
    identify,
    quiet,
    read_configuration,
    restore,
    resume,
)
from drivers.vn100.registers import Values
from drivers.vn100.session import Event, Failed, Finished, Session

ASK_AGAIN_S = (0.5, 8.0)  # a device that does not answer: first wait, longest wait
_FOREIGN = 20  # messages without one of the session's own output: it is gone


class Phase(Enum):
    """Where the conversation stands."""

    CLOSED = "closed"
    IDENTIFYING = "identifying"
    READING = "reading registers"
    SETTING_UP = "setting up the stream"
    READY = "ready"
    RUNNING = "running a procedure"
    RESTORING = "restoring"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class Identified:
    """The device said who it is."""

    identity: Identity


@dataclass(frozen=True, slots=True)
class ConfigurationRead:
    """All registers; `first` where this reading is what must be put back at the end."""

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
class Closed:
    """Everything is put back; `error` says what is not."""

    error: Exception | None


Said = Identified | ConfigurationRead | StreamChanged | Unanswered | Completed | Closed


class Conversation:
    """Owns the session. `said` collects what the core must know; measurements come back at once."""

    def __init__(
        self,
        mode: Mode,
        *,
        change_stream: bool = False,
        rate_hz: float = 100.0,
        reply_timeout_s: float = 0.4,
    ) -> None:
        self.mode = mode
        self.change_stream = change_stream and mode is not Mode.PASSIVE
        self.rate_hz = rate_hz
        self.phase = Phase.CLOSED
        self.identity: Identity | None = None
        self.saved: dict[int, Values] = {}
        self.session = Session(self._allowed, reply_timeout_s=reply_timeout_s)
        self._purpose = Purpose.READ
        self._extra_gate: Callable[[Command], bool] | None = None
        self._serial: int | None = None
        self._name = ""
        self._baud = 115200
        self._touched = self._unanswered = False
        self._ask_again_s = ASK_AGAIN_S[0]
        self._own, self._foreign = "", 0  # layout of the session's output; others without it
        self._said: list[Said] = []

    def _allowed(self, command: Command) -> bool:
        if not permitted(command, self.mode, self.change_stream, self._purpose):
            return False
        return self._extra_gate is None or self._extra_gate(command)

    @property
    def idle(self) -> bool:
        """Whether a procedure may be started now."""
        return self.phase is Phase.READY and not self.session.busy

    @property
    def may_close(self) -> bool:
        """Nothing is under way that must end before the port may be given back."""
        only_reads = self.phase in (Phase.IDENTIFYING, Phase.READING) and not self._must_restore
        return self.phase is Phase.CLOSED or self.idle or only_reads

    @property
    def session_keys(self) -> frozenset[int]:
        """Registers that this session changes and puts back."""
        return frozenset(SESSION_SETTINGS) if self.change_stream else frozenset()

    def take_said(self) -> list[Said]:
        """What happened since the last call."""
        said, self._said = self._said, []
        return said

    # -- inputs ----------------------------------------------------------------------------------

    def opened(self, baud: int, now_s: float) -> list[Event]:
        """The port is open."""
        self._baud, self._ask_again_s = baud, ASK_AGAIN_S[0]
        if self.mode is Mode.PASSIVE:
            self.phase = Phase.READY
            return []
        return self.identify_again(now_s)

    def identify_again(self, now_s: float) -> list[Event]:
        """The device may be another one, or itself after a reset: ask it everything again."""
        if self.mode is Mode.PASSIVE or self.phase is Phase.DONE:
            return []
        events = self._abandon(now_s)
        self.phase = Phase.IDENTIFYING
        return events + self._digest(self._start(identify(), Purpose.READ, now_s), now_s)

    def received(self, data: bytes, now_s: float) -> list[Event]:
        """Bytes came; returns measurements, faults and strays, in order."""
        events = self._digest(self.session.receive(data, now_s), now_s)
        if self._own and self._own_is_gone(events) and self.idle:
            text = "the session's output is gone: the device restarted, or somebody changed it"
            self._said.append(StreamChanged(text, "warning"))
            events += self.identify_again(now_s)
        return events

    def tick(self, now_s: float) -> list[Event]:
        """Time passed."""
        return self._digest(self.session.tick(now_s), now_s)

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

    def cancel(self, name: str, now_s: float) -> list[Event]:
        """End the procedure of this name, if it runs; it may still send what puts things back."""
        if self.phase is not Phase.RUNNING or self._name != name:
            return []
        return self._digest(self.session.cancel(now_s), now_s)

    def set_up_again(self, now_s: float) -> list[Event]:
        """The user's own outputs are back for a save: set the session's up again."""
        if not (self.change_stream and self.idle):
            return []
        return self._digest(self._set_up(now_s), now_s)

    def restore_and_close(self, now_s: float) -> list[Event]:
        """Put back what was changed for the session, then say Closed. Ends mere reading."""
        known = self.phase is not Phase.CLOSED and self.identity is not None
        events = [] if self.idle else self._abandon(now_s)
        if not (self._must_restore and known):
            self.phase = Phase.DONE
            self._said.append(Closed(LinkGone() if self._must_restore else None))
            return events
        self.phase = Phase.RESTORING
        procedure = quiet(restore(self.saved, SESSION_SETTINGS))
        return events + self._digest(self._start(procedure, Purpose.STREAM, now_s), now_s)

    def amends(self) -> Procedure[object] | None:
        """What puts the device's output back after this program broke down; None: nothing need be.

        Not for `run`: whoever calls this trusts no state of the conversation but what was saved.
        """
        if self._must_restore and self.identity is not None:
            return quiet(restore(self.saved, SESSION_SETTINGS))
        paused = self.phase in (Phase.RUNNING, Phase.RESTORING) and self.mode >= Mode.STAGE
        return resume() if paused else None

    def allows_amends(self, command: Command) -> bool:
        """The gate of `amends`."""
        purpose = Purpose.STREAM if self.change_stream else Purpose.ROLL_BACK
        return permitted(command, self.mode, self.change_stream, purpose)

    # -- inside ----------------------------------------------------------------------------------

    @property
    def _must_restore(self) -> bool:
        """The device that was read, and no other, may hold settings of this session."""
        return self._touched and bool(self.saved)

    def _own_is_gone(self, events: list[Event]) -> bool:
        names = [event.layout.name for event in events if isinstance(event, Measurement)]
        self._foreign = 0 if self._own in names else self._foreign + len(names)
        return self._foreign >= _FOREIGN

    def _set_up(self, now_s: float) -> list[Event]:
        self.phase = Phase.SETTING_UP
        self._touched = True  # from the first byte on, also where it breaks off half way
        return self._start(configure_stream(self.rate_hz, self._baud), Purpose.STREAM, now_s)

    def _start(self, procedure: Procedure[object], purpose: Purpose, now_s: float) -> list[Event]:
        self._purpose = purpose
        return self.session.start(procedure, now_s)

    def _digest(self, events: list[Event], now_s: float) -> list[Event]:
        """Keep what is for the core's stream; let ends of procedures move the phase."""
        kept: list[Event] = []
        queue = list(events)
        while queue:
            event = queue.pop(0)
            if isinstance(event, Finished):
                queue = self._advance(event.result, None, now_s) + queue
            elif isinstance(event, Failed):
                queue = self._advance(None, event.error, now_s) + queue
            else:
                kept.append(event)
        return kept

    def _advance(self, result: object, error: Exception | None, now_s: float) -> list[Event]:
        phase = self.phase
        if phase is Phase.RUNNING:
            self.phase, self._extra_gate = Phase.READY, None
            self._said.append(Completed(self._name, result, error))
            return []
        if phase is Phase.RESTORING:
            self.phase = Phase.DONE
            if error is None:
                self._touched = False
                self._said.append(StreamChanged("outputs put back as they were"))
            self._said.append(Closed(error))
            return []
        if phase is Phase.CLOSED:
            return []
        if phase is Phase.SETTING_UP and error is not None:
            self.phase = Phase.READY
            text = f"the session's output cannot be set up, the device's own stays: {error}"
            self._said.append(StreamChanged(text, "warning"))
            return []
        if error is not None:
            self._say_unanswered(f"{phase.value}: {error}")
            self.phase = Phase.IDENTIFYING
            later, self._ask_again_s = self._ask_again_s, min(2 * self._ask_again_s, ASK_AGAIN_S[1])
            return self._start(_identify_in(later), Purpose.READ, now_s)
        return self._next(phase, result, now_s)

    def _say_unanswered(self, text: str) -> None:
        """Once. What a device that was known sends now is not used: its registers will be read."""
        if not self._unanswered:
            known = StreamChanged(f"{text}; asking again", "warning")
            self._said.append(Unanswered(text) if self._serial is None else known)
        self._unanswered = True

    def _next(self, phase: Phase, result: object, now_s: float) -> list[Event]:
        if phase is Phase.IDENTIFYING and isinstance(result, Identity):
            if result.serial != self._serial:
                self.saved = {}  # another device: nothing of the first one's is put back to it
                self._touched = False
            self.identity, self._serial = result, result.serial
            self._said.append(Identified(result))
            self.phase = Phase.READING
            return self._start(read_configuration(result.profile), Purpose.READ, now_s)
        if phase is Phase.READING and isinstance(result, dict):
            if not self.saved:
                self.saved = dict(result)
            self._unanswered, self._ask_again_s = False, ASK_AGAIN_S[0]
            self._said.append(ConfigurationRead(result))
            if self.change_stream:
                return self._set_up(now_s)
        if isinstance(result, CalibrationStream):
            self._own, self._foreign = result.layout, 0
            self._said.append(StreamChanged(f"output set up for the session: {result}"))
        self.phase = Phase.READY
        return []


def _identify_in(seconds: float) -> Procedure[Identity]:
    yield Pause(seconds)
    return (yield from identify())
