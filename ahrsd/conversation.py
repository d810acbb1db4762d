"""What the core says to the device, and when: identify, read, set up the stream, put it back.

```
 CLOSED -> IDENTIFYING -> READING -> [SETTING_UP] -> READY -> RESTORING -> DONE
                                                     READY <-> RUNNING (the write-back)
```
In mode `passive` the port goes from CLOSED to READY at once and no byte is ever sent. A device that
answers nothing is listened to: READY without an identity, so nothing can be written to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from ahrsd.writeback.permissions import Mode, Purpose, permitted
from drivers.vn100.calibration_stream import configure_stream
from drivers.vn100.commands import Command, Procedure
from drivers.vn100.procedures import (
    SESSION_SETTINGS,
    Identity,
    identify,
    quiet,
    read_configuration,
    restore,
)
from drivers.vn100.registers import Values
from drivers.vn100.session import Event, Failed, Finished, Session


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


@dataclass(frozen=True, slots=True)
class Unanswered:
    """A procedure of the conversation's own failed; the device is only listened to."""

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
        self._stream_is_ours = False
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
        return self.phase is Phase.CLOSED or self.idle

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
        self._baud = baud
        self._stream_is_ours = False
        if self.mode is Mode.PASSIVE:
            self.phase = Phase.READY
            return []
        return self.identify_again(now_s)

    def identify_again(self, now_s: float) -> list[Event]:
        """The device may be another one, or itself after a reset: ask it everything again."""
        self._stream_is_ours = False  # what we set up in RAM may be gone
        if self.mode is Mode.PASSIVE or self.phase is Phase.DONE:
            return []
        events = self._abandon(now_s)
        self.phase = Phase.IDENTIFYING
        return events + self._digest(self._start(identify(), Purpose.READ, now_s), now_s)

    def received(self, data: bytes, now_s: float) -> list[Event]:
        """Bytes came; returns measurements, faults and strays, in order."""
        return self._digest(self.session.receive(data, now_s), now_s)

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
        self.phase = Phase.SETTING_UP
        procedure = configure_stream(self.rate_hz, self._baud)
        return self._digest(self._start(procedure, Purpose.STREAM, now_s), now_s)

    def restore_and_close(self, now_s: float) -> list[Event]:
        """Put back what was changed for the session, then say Closed."""
        if self.phase is Phase.CLOSED or not self._stream_is_ours:
            self.phase = Phase.DONE
            self._said.append(Closed(None))
            return []
        self.phase = Phase.RESTORING
        procedure = quiet(restore(self.saved, SESSION_SETTINGS))
        return self._digest(self._start(procedure, Purpose.STREAM, now_s), now_s)

    # -- inside ----------------------------------------------------------------------------------

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
            self._stream_is_ours = False
            self._said.append(StreamChanged("outputs put back as they were"))
            self._said.append(Closed(error))
            return []
        if phase is Phase.CLOSED:
            return []
        if error is not None:
            self.phase = Phase.READY
            self._said.append(Unanswered(f"{phase.value}: {error}"))
            return []
        return self._next(phase, result, now_s)

    def _next(self, phase: Phase, result: object, now_s: float) -> list[Event]:
        if phase is Phase.IDENTIFYING and isinstance(result, Identity):
            if result.serial != self._serial:
                self.saved = {}  # another device: nothing of the first one's is put back to it
            self.identity, self._serial = result, result.serial
            self._said.append(Identified(result))
            self.phase = Phase.READING
            return self._start(read_configuration(result.profile), Purpose.READ, now_s)
        if phase is Phase.READING and isinstance(result, dict):
            if not self.saved:
                self.saved = dict(result)
            self._said.append(ConfigurationRead(result))
            if self.change_stream and not self._stream_is_ours:
                self.phase = Phase.SETTING_UP
                procedure = configure_stream(self.rate_hz, self._baud)
                return self._start(procedure, Purpose.STREAM, now_s)
        if phase is Phase.SETTING_UP:
            self._stream_is_ours = True
            self._said.append(StreamChanged(f"output set up for the session: {result}"))
        self.phase = Phase.READY
        return []
