"""One conversation with a VN-100, sans I/O: bytes and time in, events and bytes out.

Theory of operation
===================

A *procedure* is a generator: it yields commands and is sent replies; errors are thrown into it.
The session carries out one procedure at a time and has one command in flight, because VNERR does
not say which command it answers. Everything else on the wire passes through, in order.

**Which reply answers.** Word and register must match, a write's echo must equal the sent values,
and a read's values must be ones that the register can have. Names of measurements differ from
``VNRRG``, so none can be taken for a reply. All other replies come out as `Stray`.

**Echoes.** A line that sends commands back is recognised (`Echo`); an echo answers nothing.

**Late replies.** The device carries out commands in the order of arrival and the wire keeps the
order of its replies. So what can go wrong is only this: an attempt timed out (or was ended by a
VNERR that was not its own), its reply is still under way (a *ghost*), and it would answer a later
command. A repeated attempt of the same command
may take it: nothing of ours lay between. Before any *other* command the session therefore reads an
identity register that is not among the ghosts, a *barrier*: when its reply arrives, every ghost has
arrived before it or never will. Replies and errors that come during the barrier are the ghosts'.
Two barriers are tried. If both stay silent, a command that no ghost could answer still goes out
(the closing VNASY,1 must), one that a ghost could answer fails with NoReply instead. A ghost is
forgotten after `GHOST_LIFE_S`, far more than a USB adapter or the device can hold a reply back.
Another program's read of the same register on the same wire cannot be told from ours; its reply is
a true reading too, and the order of the wire still puts it behind the echo of our last write.

**The gate.** `allow` sees every command before it becomes bytes; there is no other way out.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers.vn100.commands import (
    REFUSALS,
    RESUME,
    RETRIED_ERRORS,
    Cancelled,
    Command,
    LinkGone,
    NoReply,
    NotPermitted,
    Pause,
    Procedure,
    Read,
    SessionError,
    Speech,
    TooLate,
    confusable,
    must_follow,
    patience,
)
from drivers.vn100.decode import ErrorReply, Measurement, Undecodable, Unused, decode
from drivers.vn100.deframer import Deframer, Frame, Sentence
from drivers.vn100.errors import DeviceRefused, DriverError
from drivers.vn100.messages import Reply, encode

# -- Echoes ----------------------------------------------------------------------------------------


_MOST_WAITING = 16  # commands whose echo may be under way
# A read whose answer has values; that of an empty user tag has none, and one with a port parameter
# ("VNRRG,06,1") reads like an answer.
_PLAIN_READ = re.compile(r"VNRRG,(?!00$)[0-9]+")


class Echo:
    """Of one link. `echoes`: whether the line was seen to echo."""

    def __init__(self) -> None:
        self.echoes = False
        self._waiting: deque[str] = deque(maxlen=_MOST_WAITING)

    def sent(self, body: str) -> None:
        """A command goes out; `body` is what is between $ and *."""
        self._waiting.append(body)

    def is_echo(self, body: str) -> bool:
        """Whether a line with this body is the echo of a command; each command has one."""
        if body not in self._waiting:
            return False
        if not self.echoes and not _PLAIN_READ.fullmatch(body):
            return False
        self.echoes = True
        while self._waiting.popleft() != body:
            pass  # an echo that was lost will not come any more
        return True

    def forget(self) -> None:
        """The link is gone; the next one may be another adapter."""
        self.echoes = False
        self._waiting.clear()


# -- The session -----------------------------------------------------------------------------------


GHOST_LIFE_S = 5.0
# Without a byte for so long, half a message is no message any more: longer than a retransmission
# of TCP takes (0.2 to 0.4 s), behind which the other half comes.
SILENCE_S = 0.5
_BARRIERS = (Read(1), Read(3), Read(4), Read(2))
_BARRIER_TRIES = 2
_MOST_FINALLY_BLOCKS = 32  # each of a procedure's may try to send once when the link goes


@dataclass(frozen=True, slots=True)
class DeviceFault:
    """A VNERR that answers no command: the device's own state, or an error nobody asked for."""

    code: int


@dataclass(frozen=True, slots=True)
class Stray:
    """A reply that nobody waits for: a late one, or another program talks to the device."""

    reply: Reply


@dataclass(frozen=True, slots=True)
class ProcedureFinished:
    """The procedure ended and returned `result`."""

    result: object


@dataclass(frozen=True, slots=True)
class ProcedureFailed:
    """The procedure ended with `error`: a SessionError, DeviceRefused or ValueError."""

    error: Exception


@dataclass(frozen=True, slots=True)
class LineEchoes:
    """What is sent comes back before the answer; told once per link."""


ECHOES = (
    "the line sends back what is sent (an adapter or terminal that echoes): echoes are "
    "distinguished from answers and left out"
)


Event = (
    Measurement
    | Unused
    | Undecodable
    | DeviceFault
    | Stray
    | LineEchoes
    | ProcedureFinished
    | ProcedureFailed
)


@dataclass(slots=True)
class _Flight:
    """The command under way. `attempts` made so far; `due_s`: when it counts as unanswered."""

    command: Speech
    attempts: int = 0
    sent_s: float = 0.0
    due_s: float = 0.0
    waiting: Speech | None = None  # set in a barrier: the command that goes out behind it


@dataclass(frozen=True, slots=True)
class _Ghost:
    command: Speech
    forget_s: float


class Session:
    """See the module. `allow` decides for each command whether it may be sent.

    A command that must be right behind an answer is sent while the question before it is no older
    than a quarter of the reply timeout (0.1 s): no hand moves a cable in so short a time.
    """

    def __init__(
        self,
        allow: Callable[[Command], bool],
        deframer: Deframer | None = None,
        reply_timeout_s: float = 0.4,
    ) -> None:
        self.deframer = deframer or Deframer()
        self._allow = allow
        self._reply_timeout_s = reply_timeout_s
        self._asked_s = float("-inf")  # when the question was sent that was answered last
        self._procedure: Procedure[object] | None = None
        self._flight: _Flight | None = None
        self._pause: tuple[Pause, float] | None = None
        self._heard: dict[str, None] = {}
        self._ghosts: list[_Ghost] = []
        self._cancelling = False
        self._output = bytearray()
        self._silent_from_s: float | None = None
        self._echo = Echo()

    @property
    def busy(self) -> bool:
        """Whether a procedure is running."""
        return self._procedure is not None

    @property
    def deadline_s(self) -> float | None:
        """When `tick` wants to be called if nothing arrives before."""
        candidates = [self._silent_from_s]
        if self._flight is not None:
            candidates.append(self._flight.due_s)
        if self._pause is not None:
            candidates.append(self._pause[1])
        return min((c for c in candidates if c is not None), default=None)

    def take_output(self) -> bytes:
        """The bytes to write to the port now."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def start(self, procedure: Procedure[object], now_s: float) -> list[Event]:
        """Begin `procedure`; RuntimeError while another runs. May end it at once."""
        if self._procedure is not None:
            raise RuntimeError("a command sequence is already running in this session")
        self._procedure = procedure
        self._cancelling = False
        events: list[Event] = []
        self._advance(None, now_s, events)
        return events

    def cancel(self, now_s: float) -> list[Event]:
        """Throw Cancelled into the procedure, which may still send what puts the device back."""
        events: list[Event] = []
        if self._procedure is not None and not self._cancelling:
            self._cancelling = True
            self._abandon_flight(now_s)
            self._advance(Cancelled(), now_s, events)
        return events

    def link_lost(self, now_s: float) -> list[Event]:
        """The port is gone: end the procedure, send nothing, forget half a message."""
        events: list[Event] = []
        self._abandon_flight(now_s)
        for _ in range(_MOST_FINALLY_BLOCKS):
            if self._resume(LinkGone(), events) is None:
                break
        else:
            raise RuntimeError("a command sequence goes on although its link is gone")
        self._output.clear()
        self._echo.forget()
        self.deframer.drop_pending()
        self._silent_from_s = None
        return events

    def receive(self, chunk: bytes, now_s: float) -> list[Event]:
        """Bytes from the device, cut anywhere; the events that they completed, in order."""
        events: list[Event] = []
        self._take(chunk, now_s, events)
        self._silent_from_s = now_s + SILENCE_S if self.deframer.pending else None
        return events

    def tick(self, now_s: float) -> list[Event]:
        """Time passed and nothing came: give up on half a message, repeat, or end a pause."""
        events: list[Event] = []
        if self._silent_from_s is not None and now_s >= self._silent_from_s:
            self.deframer.drop_pending()
            self._silent_from_s = None
            self._take(b"", now_s, events)
        if self._pause is not None and now_s >= self._pause[1]:
            self._pause = None
            self._advance(Reply("", None, tuple(self._heard)), now_s, events)
        elif self._flight is not None and now_s >= self._flight.due_s:
            self._unanswered(self._flight, now_s, events)
        return events

    def last_word(self, command: Speech) -> None:
        """Send a command whose reply nobody waits for, where the gate lets it out."""
        if self._allow(command):
            self._say(command)

    def _say(self, command: Speech) -> None:
        self._echo.sent(command.body)
        self._output += encode(command.body)

    def _is_echo(self, frame: Frame, events: list[Event]) -> bool:
        """Whether the wire sent back a command of ours, which answers nothing."""
        known = self._echo.echoes
        if not isinstance(frame, Sentence) or not self._echo.is_echo(frame.body):
            return False
        if not known:
            events.append(LineEchoes())
        return True

    def _take(self, chunk: bytes, now_s: float, events: list[Event]) -> None:
        for frame in self.deframer.feed(chunk):
            if self._is_echo(frame, events):
                continue
            event = decode(frame)
            if isinstance(event, Measurement):
                events.append(event)
                if self._pause is not None:
                    self._heard[event.layout.name] = None
            elif isinstance(event, Reply):
                self._on_reply(event, now_s, events)
            elif isinstance(event, ErrorReply):
                self._on_error(event.code, now_s, events)
            else:
                events.append(event)

    def _on_reply(self, reply: Reply, now_s: float, events: list[Event]) -> None:
        flight = self._flight
        if flight is None or not flight.command.answered_by(reply):
            events.append(Stray(reply))
            return
        self._flight = None
        forget_s = now_s + GHOST_LIFE_S  # of the other attempts: which one this answers is unknown
        self._ghosts = [
            _Ghost(ghost.command, forget_s)
            for ghost in self._ghosts
            if confusable(ghost.command, flight.command)
        ]
        if flight.waiting is not None:
            self._launch(flight.waiting, now_s, events)
        else:
            self._asked_s = flight.sent_s
            self._advance(reply, now_s, events)

    def _on_error(self, code: int, now_s: float, events: list[Event]) -> None:
        flight = self._flight
        if code not in REFUSALS:
            events.append(DeviceFault(code))
        elif self._pause is not None and self._pause[0].watch_errors:
            self._pause = None
            self._advance(DeviceRefused(code), now_s, events)
        elif flight is None or flight.waiting is not None:
            events.append(DeviceFault(code))
        else:  # VNERR names no command, so it may be another one's and the reply may still come
            self._abandon_flight(now_s)
            if code in RETRIED_ERRORS and flight.attempts < patience(flight.command).damaged:
                self._repeat(flight, now_s, events)
            else:
                self._advance(DeviceRefused(code, flight.command), now_s, events)

    def _unanswered(self, flight: _Flight, now_s: float, events: list[Event]) -> None:
        self._abandon_flight(now_s)
        if flight.waiting is not None:
            if flight.attempts < _BARRIER_TRIES and self._barrier(flight.waiting, 1, now_s):
                return
            self._without_barrier(flight.waiting, now_s, events)
        elif flight.attempts < patience(flight.command).tries:
            self._repeat(flight, now_s, events)
        else:
            self._advance(NoReply(flight.command), now_s, events)

    def _advance(
        self, outcome: Reply | Exception | None, now_s: float, events: list[Event]
    ) -> None:
        """Hand `outcome` to the procedure and set its next command under way."""
        while (command := self._resume(outcome, events)) is not None:
            if isinstance(command, Pause):
                self._heard = {}
                self._pause = (command, now_s + command.seconds)
                return
            self._ghosts = [ghost for ghost in self._ghosts if ghost.forget_s > now_s]
            if self._ghosts:
                if not self._barrier(command, 0, now_s):
                    self._without_barrier(command, now_s, events)
                return
            outcome = self._transmit(_Flight(command), now_s)
            if outcome is None:
                return

    def _resume(self, outcome: Reply | Exception | None, events: list[Event]) -> Command | None:
        """One step of the procedure: its next command, or None and the event of its end."""
        procedure, self._procedure = self._procedure, None
        if procedure is None:
            return None
        try:
            if isinstance(outcome, Exception):
                command = procedure.throw(outcome)
            else:
                command = next(procedure) if outcome is None else procedure.send(outcome)
        except StopIteration as end:
            events.append(ProcedureFinished(end.value))
            return None
        except (DriverError, ValueError) as error:
            events.append(ProcedureFailed(error))
            return None
        self._procedure = procedure
        return command

    def _barrier(self, waiting: Speech, attempts: int, now_s: float) -> bool:
        """Ask for what no ghost can answer; false where that is not possible."""
        for probe in _BARRIERS:
            if not any(confusable(ghost.command, probe) for ghost in self._ghosts):
                return self._transmit(_Flight(probe, attempts, waiting=waiting), now_s) is None
        return False

    def _without_barrier(self, command: Speech, now_s: float, events: list[Event]) -> None:
        """Nothing is known of the ghosts. RESUME goes out even so: silence would be worse."""
        if command != RESUME and any(confusable(g.command, command) for g in self._ghosts):
            self._advance(NoReply(command), now_s, events)
        else:
            self._launch(command, now_s, events)

    def _launch(self, command: Speech, now_s: float, events: list[Event]) -> None:
        self._repeat(_Flight(command), now_s, events)

    def _repeat(self, flight: _Flight, now_s: float, events: list[Event]) -> None:
        if (held_back := self._transmit(flight, now_s)) is not None:
            self._advance(held_back, now_s, events)

    def _transmit(self, flight: _Flight, now_s: float) -> SessionError | None:
        """The one place where a command becomes bytes; why it is held back, None if it is not."""
        self._flight = None
        if must_follow(flight.command) and now_s - self._asked_s > 0.25 * self._reply_timeout_s:
            return TooLate(flight.command)
        if not self._allow(flight.command):
            return NotPermitted(flight.command)
        if not flight.attempts:  # a late answer may be to the first of several
            flight.sent_s = now_s
        flight.attempts += 1
        flight.due_s = now_s + (patience(flight.command).reply_s or self._reply_timeout_s)
        self._flight = flight
        self._say(flight.command)
        return None

    def _abandon_flight(self, now_s: float) -> None:
        """Stop waiting; a reply may still come."""
        if self._flight is not None:
            self._ghosts.append(_Ghost(self._flight.command, now_s + GHOST_LIFE_S))
        self._flight = None
        self._pause = None
