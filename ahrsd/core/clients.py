"""Programs on shared ports, and the rest of the core: when their commands go out, what follows.

`sharing.arbiter` knows whose command is next and to whom an answer goes; here is what it means for
the device session and the write-back: a save or a reset waits until nothing unproven is in the
device's RAM, a write changes what is the user's, a reset is a restart that is known of, and a write
of what calibrates, where the share lets it pass, is somebody's change that is journaled before it
is sent.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from ahrsd import inputs
from ahrsd.core.device_session import DeviceSession
from ahrsd.events import SendToClient
from ahrsd.sharing.arbiter import (
    COUNTED,
    UNAUTHORIZED,
    Arbiter,
    ClientCommand,
    Kind,
    Refusal,
    SharePolicy,
    Waiting,
)
from ahrsd.writeback.actions import Action
from ahrsd.writeback.journal_history import LATENCY_S
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.permissions import PASSABLE
from ahrsd.writeback.states import Mode
from drivers.vn100.commands import NoReply, NotAsKnown, Seen, TooLate, Write
from drivers.vn100.messages import Reply
from drivers.vn100.registers import Values

_NOT_SAVED = "nothing is saved for a client"
_DOES = {Kind.SAVE: "saves", Kind.RESET: "resets"}
RESTARTS_S = 2.5  # from the acknowledgement of VNRST to the device's start, at most


@dataclass(slots=True)
class ServedEffects:
    """What a client's command changed: registers, actions that follow, who restarted the device."""

    wrote: dict[int, Values] = field(default_factory=dict)
    actions: list[Action] = field(default_factory=list)
    reset_by: str = ""


@dataclass(frozen=True, slots=True)
class ClientTurn:
    """A client's command for the wire; `known`: only for this unit while it holds these values."""

    asked: ClientCommand
    known: Seen | None = None


class Clients:
    """See the module."""

    def __init__(
        self, policies: Iterable[SharePolicy], session: DeviceSession, writeback: WriteBack
    ) -> None:
        shares = tuple(policies)
        self.arbiter = Arbiter(shares)
        self._session, self._writeback = session, writeback
        self._announced: Waiting | None = None  # a write that the journal was told of, not yet sent
        self._reset = ("", float("-inf"))  # who reset the device last, and when it was acknowledged
        self._notes = [_passing(s.name, writeback) for s in shares if any(map(s.passes, PASSABLE))]

    @property
    def deadline_s(self) -> float | None:
        """When `next` must be called at the latest."""
        return self.arbiter.deadline_s

    def sent(self, item: inputs.ClientSent, host_s: float) -> None:
        """Bytes of a client."""
        data = item.text.encode("latin-1", "replace")
        self.arbiter.receive(item.client, data, self._session.identity, host_s)

    def left(self, item: inputs.ClientLeft) -> None:
        """A client closed its port."""
        self.arbiter.disconnect(item.client)

    def fault(self, code: int) -> None:
        """The device reports an error of its own: each driver would have heard it."""
        self.arbiter.broadcast(f"VNERR,{code:02X}")

    def take_answers(self) -> list[SendToClient]:
        """Bytes for clients."""
        return self.arbiter.take_answers()

    def take_notes(self) -> list[str]:
        """What a person should know of."""
        notes, self._notes = self._notes, []
        return notes + self.arbiter.take_notes()

    def counts(self, client: str) -> dict[str, int]:
        """How many commands this client sent, and what became of them."""
        return {what: self.arbiter.counts[client, what] for what in COUNTED}

    def next(self, host_s: float, *, free: bool) -> tuple[list[Action], ClientTurn | None]:
        """The next command for the wire, where it is free, and what must happen before it."""
        waiting = self.arbiter.next_command(host_s)
        if self._announced is not None and self._announced is not waiting:
            self._announced = None
            if dropped := self._writeback.on_client_dropped(host_s):
                return dropped, None
        if waiting is None or not free or not self._session.idle:
            return [], None
        if (does := _DOES.get(waiting.asked.kind)) is not None:
            back = self._writeback
            why_not = back.no_client_save if does == "saves" else back.no_client_reset
            if why_not is None:
                return back.on_client_wants(waiting.client, does, host_s), None
            if why_not:
                self.arbiter.refuse_next(Refusal(UNAUTHORIZED, f"{_NOT_SAVED}: {why_not}"))
                return [], None
        if waiting.asked.kind is Kind.CALIBRATE and isinstance(waiting.asked.command, Write):
            return self._calibrate(waiting, waiting.asked.command, host_s)
        lasts = waiting.asked.kind is Kind.SAVE
        known = self._writeback.known if lasts else None
        return [], ClientTurn(self.arbiter.start_next().asked, known)

    def _calibrate(
        self, waiting: Waiting, command: Write, host_s: float
    ) -> tuple[list[Action], ClientTurn | None]:
        """A write of what calibrates: refused with the same code as where none passes, or next."""
        why = self._writeback.may_client_write(command.register)
        if why is None:
            return [], None
        if why:
            told = f"register {command.register} was not written for it: {why}"
            self.arbiter.refuse_next(Refusal(UNAUTHORIZED, told))
            return [], None
        wanted = (waiting.client, command.register, command.values)
        actions, ready = self._writeback.on_client_writes(*wanted, host_s)
        self._announced = None if ready else waiting
        if not ready:
            return actions, None
        return actions, ClientTurn(self.arbiter.start_next().asked, self._writeback.known)

    def served(
        self,
        result: object,
        error: Exception | None,
        registers: Mapping[int, Values],
        host_s: float,
    ) -> ServedEffects:
        """The command on the wire ended. `registers`: what the device held before it."""
        effects = ServedEffects()
        if isinstance(error, NotAsKnown | TooLate):  # nothing was sent
            self.arbiter.requeue_current()
            reason = "" if isinstance(error, TooLate) else str(error)
            effects.actions = self._writeback.on_client_waits(reason, host_s)
            return effects
        if (done := self.arbiter.finish_current(result, error)) is None:
            return effects
        if done.asked.kind is Kind.RESET and (isinstance(result, Reply) or _silent(error)):
            effects.reset_by, self._reset = done.client, (done.client, host_s)
        does = _DOES.get(done.asked.kind)
        if done.asked.kind is Kind.CALIBRATE:
            effects.actions = self._writeback.on_client_wrote(host_s)
        elif does is not None and not isinstance(result, Reply):
            effects.actions = self._writeback.on_client_failed(does, str(error), host_s)
        elif done.asked.kind is Kind.RESET:
            effects.actions = self._writeback.on_client_reset(done.client, host_s)
        elif isinstance(result, Reply):
            self._changed(done, registers, host_s, effects)
        return effects

    @property
    def resetting(self) -> bool:
        """Whether a client's VNRST is on the wire, or its answer not looked at."""
        under_way = self.arbiter.under_way
        return under_way is not None and under_way.asked.kind is Kind.RESET

    def reset_by(self, started_s: float) -> str:
        """Whose VNRST it was that the device started up at about this host time; empty: nobody's.

        The stream may tell it before the answer was looked at.
        """
        under_way = self.arbiter.under_way
        if under_way is not None and self.resetting:
            return under_way.client
        client, acknowledged_s = self._reset
        early_s = acknowledged_s - LATENCY_S
        return client if early_s <= started_s <= acknowledged_s + RESTARTS_S else ""

    def _changed(
        self,
        done: Waiting,
        registers: Mapping[int, Values],
        host_s: float,
        effects: ServedEffects,
    ) -> None:
        command, settings = done.asked.command, self._session.clients
        if isinstance(command, Write):
            number, values = command.register, command.values
            settings.written(number, values, registers.get(number))
            effects.wrote = {number: values} if number in registers else {}
            keys = self._session.session_keys
            clients = frozenset(settings.now)
            effects.actions = self._writeback.on_client_settings(keys, clients, host_s)
        elif done.asked.kind is Kind.SAVE:
            saved = dict(settings.now)
            settings.forget()
            keys = self._session.session_keys
            effects.actions = self._writeback.on_client_saved(done.client, saved, keys, host_s)


def _passing(name: str, writeback: WriteBack) -> str:
    mode = writeback.policy.mode
    if mode < Mode.STAGE:
        return (
            f'{name}: calibration_writes = "pass" lets nothing pass in mode {mode.name.lower()}: '
            "what calibrates is refused"
        )
    return f'{name} may write what calibrates (calibration_writes = "pass")'


def _silent(error: Exception | None) -> bool:
    return isinstance(error, NoReply)
