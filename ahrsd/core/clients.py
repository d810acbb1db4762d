"""Programs on shared ports in the core: when their commands are sent, and the consequences.

`sharing.arbiter` decides whose command is next and who gets an answer. This module handles the
consequences for the device session and the write-back. A save or a reset waits until no unproven
values are in the device's RAM. A write changes the user's settings. A reset is an expected restart.
A write of calibration registers, if the share lets it pass, is a change by another program that is
journaled before it is sent.
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
_VERBS = {Kind.SAVE: "saves", Kind.RESET: "resets"}
RESTARTS_S = 2.5  # from the acknowledgement of VNRST to the device's start, at most


@dataclass(slots=True)
class ServedEffects:
    """What a client's command changed: registers, resulting actions, who restarted the device."""

    wrote: dict[int, Values] = field(default_factory=dict)
    actions: list[Action] = field(default_factory=list)
    reset_by: str = ""


@dataclass(frozen=True, slots=True)
class ClientTurn:
    """A client's command to send; `known`: only to this unit while it holds these values."""

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
        self._announced: Waiting | None = None  # a write that was journaled and is not sent yet
        self._reset = ("", float("-inf"))  # who reset the device last, and the time of the reply
        self._notes = [
            _describe_passing_share(s.name, writeback)
            for s in shares
            if any(map(s.passes, PASSABLE))
        ]

    @property
    def deadline_s(self) -> float | None:
        """When `next` must be called at the latest."""
        return self.arbiter.deadline_s

    def on_bytes(self, item: inputs.ClientSent, host_s: float) -> None:
        """Take bytes of a client."""
        data = item.text.encode("latin-1", "replace")
        self.arbiter.receive(item.client, data, self._session.identity, host_s)

    def on_disconnected(self, item: inputs.ClientLeft) -> None:
        """A client closed its port."""
        self.arbiter.disconnect(item.client)

    def broadcast_fault(self, code: int) -> None:
        """Pass on an error that the device reported unasked, as every driver would get it."""
        self.arbiter.broadcast(f"VNERR,{code:02X}")

    def take_answers(self) -> list[SendToClient]:
        """Bytes for clients."""
        return self.arbiter.take_answers()

    def take_notes(self) -> list[str]:
        """Messages for a person since the last call."""
        notes, self._notes = self._notes, []
        return notes + self.arbiter.take_notes()

    def counts(self, client: str) -> dict[str, int]:
        """How many commands this client sent, and how many had each result."""
        return {what: self.arbiter.counts[client, what] for what in COUNTED}

    def next_turn(self, host_s: float, *, free: bool) -> tuple[list[Action], ClientTurn | None]:
        """The next command to send if the wire is free, and actions that must come first."""
        waiting = self.arbiter.next_command(host_s)
        if self._announced is not None and self._announced is not waiting:
            self._announced = None
            if dropped := self._writeback.on_client_dropped(host_s):
                return dropped, None
        if waiting is None or not free or not self._session.idle:
            return [], None
        if (does := _VERBS.get(waiting.asked.kind)) is not None:
            back = self._writeback
            why_not = back.client_save_refusal if does == "saves" else back.client_reset_refusal
            if why_not is None:
                return back.on_client_wants(waiting.client, does, host_s), None
            if why_not:
                self.arbiter.refuse_next(Refusal(UNAUTHORIZED, f"{_NOT_SAVED}: {why_not}"))
                return [], None
        if waiting.asked.kind is Kind.CALIBRATE and isinstance(waiting.asked.command, Write):
            return self._next_calibration_write(waiting, waiting.asked.command, host_s)
        saves = waiting.asked.kind is Kind.SAVE
        known = self._writeback.expected_device if saves else None
        return [], ClientTurn(self.arbiter.start_next().asked, known)

    def _next_calibration_write(
        self, waiting: Waiting, command: Write, host_s: float
    ) -> tuple[list[Action], ClientTurn | None]:
        """A calibration write: refused as on a share that lets none pass, journaled, or sent."""
        why = self._writeback.client_write_refusal(command.register)
        if why is None:
            return [], None
        if why:
            refusal = f"register {command.register} was not written for it: {why}"
            self.arbiter.refuse_next(Refusal(UNAUTHORIZED, refusal))
            return [], None
        wanted = (waiting.client, command.register, command.values)
        actions, ready = self._writeback.on_client_writes(*wanted, host_s)
        self._announced = None if ready else waiting
        if not ready:
            return actions, None
        return actions, ClientTurn(self.arbiter.start_next().asked, self._writeback.expected_device)

    def on_served(
        self,
        result: object,
        error: Exception | None,
        registers: Mapping[int, Values],
        host_s: float,
    ) -> ServedEffects:
        """The command on the wire ended. `registers`: of the device, before it."""
        effects = ServedEffects()
        if isinstance(error, NotAsKnown | TooLate):  # nothing was sent
            self.arbiter.requeue_current()
            reason = "" if isinstance(error, TooLate) else str(error)
            effects.actions = self._writeback.on_client_waits(reason, host_s)
            return effects
        if (done := self.arbiter.finish_current(result, error)) is None:
            return effects
        if done.asked.kind is Kind.RESET and (isinstance(result, Reply) or _is_no_reply(error)):
            effects.reset_by, self._reset = done.client, (done.client, host_s)
        does = _VERBS.get(done.asked.kind)
        if done.asked.kind is Kind.CALIBRATE:
            effects.actions = self._writeback.on_client_wrote(host_s)
        elif does is not None and not isinstance(result, Reply):
            effects.actions = self._writeback.on_client_failed(does, str(error), host_s)
        elif done.asked.kind is Kind.RESET:
            effects.actions = self._writeback.on_client_reset(done.client, host_s)
        elif isinstance(result, Reply):
            self._record_change(done, registers, host_s, effects)
        return effects

    @property
    def resetting(self) -> bool:
        """Whether a client's VNRST is on the wire or its reply not processed yet."""
        under_way = self.arbiter.under_way
        return under_way is not None and under_way.asked.kind is Kind.RESET

    def reset_by(self, started_s: float) -> str:
        """The client whose VNRST explains a start-up of the device at this host time; empty: none.

        The stream may show the restart before the reply is processed.
        """
        under_way = self.arbiter.under_way
        if under_way is not None and self.resetting:
            return under_way.client
        client, acknowledged_s = self._reset
        early_s = acknowledged_s - LATENCY_S
        return client if early_s <= started_s <= acknowledged_s + RESTARTS_S else ""

    def _record_change(
        self,
        done: Waiting,
        registers: Mapping[int, Values],
        host_s: float,
        effects: ServedEffects,
    ) -> None:
        command, settings = done.asked.command, self._session.clients
        if isinstance(command, Write):
            number, values = command.register, command.values
            settings.record_write(number, values, registers.get(number))
            effects.wrote = {number: values} if number in registers else {}
            keys = self._session.session_keys
            clients = frozenset(settings.now)
            effects.actions = self._writeback.on_client_settings(keys, clients, host_s)
        elif done.asked.kind is Kind.SAVE:
            saved = dict(settings.now)
            settings.clear()
            keys = self._session.session_keys
            effects.actions = self._writeback.on_client_saved(done.client, saved, keys, host_s)


def _describe_passing_share(name: str, writeback: WriteBack) -> str:
    mode = writeback.policy.mode
    if mode < Mode.STAGE:
        return (
            f'{name}: calibration = "pass" lets nothing pass in mode {mode.name.lower()}: '
            "what calibrates is refused"
        )
    return f'{name} may write what calibrates (calibration = "pass")'


def _is_no_reply(error: Exception | None) -> bool:
    return isinstance(error, NoReply)
