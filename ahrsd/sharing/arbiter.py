"""Decides what a client may send, whose command is sent next, and which client gets an answer.

A client is the driver of another program; it assumes that it has the device to itself. Pure; time
is an argument.

**Permissions.** A client's commands are parsed as the device parses them, so only a command of
`drivers.vn100.commands` can be sent on its behalf.

| what | answer |
|---|---|
| read of registers 1 to 4 (who the device is) | from memory, once it is known |
| VNASY | by the port: only this client's stream stops and resumes |
| register 5 (baud rate) | success; the line to the device is not changed |
| registers 23, 25, 26, 43, 44, 74, 84 and the words that change them | VNERR 09: ahrsd owns them |
| the same registers, for an owner with `calibration = "pass"` | the device's |
| VNWNV, VNRST | as the share's policy says |
| VNRFS and the words of vendor tools | VNERR 09 |
| any other read | the device's |
| any other write, VNKMD, VNKAD | the device's for the owner; VNERR 09 for other clients |
| a write that would get VNERR 09, of the values that the register already holds | success |

VectorNav's SDK needs the last row: to find out what belongs in a saved configuration it writes back
what it has just read. The register is read instead, and the write is refused only if it differs.

Sources: UM001 "System Commands"; what drivers send when they start
(tests/support/devices/drivers_at_start.py).

**Order.** One command is on the wire at a time: clients' commands in order of arrival, the daemon's
own between them. A command that repeats one of the same client's pending commands is absorbed:
drivers repeat after 50 ms what takes 60. A command that waited longer than any driver waits for an
answer is dropped, because the driver would take a later answer for that of another command.

A client that floods the port, sends an endless line or disconnects does not affect the others: its
line buffer and its queue are bounded.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final, Literal

from ahrsd.events import SendToClient
from ahrsd.writeback.permissions import GUARDED, PASSABLE
from ahrsd.writeback.states import Purpose
from drivers.vn100.commands import Identity, Read, Speech, Word, Write
from drivers.vn100.deframer import Cause, Deframer
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.messages import Reply, encode
from drivers.vn100.registers import (
    REGISTERS,
    RegisterValueError,
    Values,
    format_reply,
    parse,
    same,
)

# -- Permissions -----------------------------------------------------------------------------------


IDENTITY: Final = (1, 2, 3, 4)
LINE_RATE: Final = 5
_PER_PORT: Final = frozenset({5, 6, 7})  # the device has one of each per port

BAD_CHECKSUM, BAD_COMMAND, TOO_FEW, BAD_REGISTER, UNAUTHORIZED = 0x03, 0x04, 0x05, 0x08, 0x09


class Kind(Enum):
    """How to handle a client's command."""

    MEMORY = "answer from memory"
    STREAM = "this client's own stream"
    RATE = "pretend"
    SAVE = "save"
    RESET = "reset"
    READ = "read"
    WRITE = "write"
    CALIBRATE = "write what calibrates"
    COMPARE = "read what is not to be written"


_WORDS: Final[dict[str, Kind]] = {
    "VNWNV": Kind.SAVE,
    "VNRST": Kind.RESET,
    "VNASY": Kind.STREAM,
    "VNKMD": Kind.WRITE,  # known disturbances, for the device's own filter
    "VNKAD": Kind.WRITE,
}
_FORBIDDEN: Final = frozenset(
    {"VNRFS", "VNTAR", "VNSGB", "VNSFB", "VNSIH", "VNSPS", "VNFWU", "VNBLD", "VNSBL", "VNMCU"}
)


@dataclass(frozen=True, slots=True)
class SharePolicy:
    """What one share allows.

    name:  for people and the log: the path of its port
    owner: it may set the device's output registers; at most one share is the owner
    save:  VNWNV is refused, or sent once the device's RAM holds no unproven values
    reset: VNRST is refused, or sent and reported
    calibration: the owner's writes of calibration registers are refused, or journaled and sent
    """

    name: str
    owner: bool = False
    save: Literal["refuse", "clean"] = "clean"
    reset: Literal["refuse", "announce"] = "announce"
    calibration: Literal["guard", "pass"] = "guard"

    def passes(self, number: int) -> bool:
        """Whether this share may write this calibration register."""
        return self.owner and self.calibration == "pass" and number in PASSABLE


@dataclass(frozen=True, slots=True)
class ClientCommand:
    """A command that a client may send.

    body:    as the client wrote it, between $ and *
    command: what would be sent to the device
    unless:  for a write that is only compared: the wanted values, and the refusal if they differ
    """

    kind: Kind
    body: str
    command: Speech
    unless: tuple[Values, Refusal] | None = None

    @property
    def purpose(self) -> Purpose:
        """The purpose for which `writeback.permissions` must permit the command."""
        calibrates = self.kind is Kind.CALIBRATE
        return Purpose.CLIENT_CALIBRATION if calibrates else Purpose.CLIENT


@dataclass(frozen=True, slots=True)
class Refusal:
    """A VNERR as the answer; `why` is for the log, empty if the client's line was malformed."""

    code: int
    why: str = ""


def parse_client_command(body: str, policy: SharePolicy) -> ClientCommand | Refusal:
    """Parse a client's line, without frame and checksum, under this policy."""
    word, _, rest = body.partition(",")
    tokens = rest.split(",") if rest else []
    if word in ("VNRRG", "VNWRG"):
        return _parse_register_command(word, tokens, body, policy)
    if word in _FORBIDDEN:
        return Refusal(UNAUTHORIZED, f"{word} is nothing that a client may send")
    if (kind := _WORDS.get(word)) is None:
        return Refusal(BAD_COMMAND)
    try:
        command = Word(word, tuple(int(token) for token in tokens))
    except ValueError:
        return Refusal(BAD_COMMAND)
    if kind is Kind.SAVE and policy.save == "refuse":
        return Refusal(UNAUTHORIZED, f"{word} is refused by this share's policy (save)")
    if kind is Kind.RESET and policy.reset == "refuse":
        return Refusal(UNAUTHORIZED, f"{word} is refused by this share's policy (reset)")
    if kind is not Kind.STREAM and not policy.owner:
        return Refusal(UNAUTHORIZED, f"{word} is for the share with owner = true")
    return ClientCommand(kind, body, command)


def _parse_register_command(
    word: str, tokens: list[str], body: str, policy: SharePolicy
) -> ClientCommand | Refusal:
    if not tokens or not tokens[0].isascii() or not tokens[0].isdigit():
        return Refusal(TOO_FEW if not tokens or not tokens[0] else BAD_REGISTER)
    number = int(tokens[0])
    if number not in REGISTERS:
        return Refusal(BAD_REGISTER)
    if word == "VNRRG":
        return _parse_read(number, tokens[1:], body)
    passes = policy.passes(number)
    if number in GUARDED and number != LINE_RATE and not passes:
        why = f"register {number} was not written for a client: what calibrates is ahrsd's"
        return _compare_or_refuse(number, tokens[1:], body, Refusal(UNAUTHORIZED, why))
    if not REGISTERS[number].writable:
        return Refusal(UNAUTHORIZED)
    try:
        command = Write(number, parse(number, tokens[1:]), held=True)
    except RegisterValueError as error:
        return Refusal(error.code)
    if number == LINE_RATE:
        return ClientCommand(Kind.RATE, body, command)
    if not policy.owner:
        why = f"writes of register {number} are for the share with owner"
        return _compare_or_refuse(number, tokens[1:], body, Refusal(UNAUTHORIZED, why))
    return ClientCommand(Kind.CALIBRATE if passes else Kind.WRITE, body, command)


def _compare_or_refuse(
    number: int, tokens: list[str], body: str, refusal: Refusal
) -> ClientCommand | Refusal:
    """A write that is refused unless the register already holds these values."""
    if number in _PER_PORT or not REGISTERS[number].writable:
        return refusal
    try:
        values = parse(number, tokens)
    except RegisterValueError:
        return refusal
    return ClientCommand(Kind.COMPARE, body, Read(number), (values, refusal))


def _parse_read(number: int, tokens: list[str], body: str) -> ClientCommand | Refusal:
    try:
        command = Read(number, int(tokens[0]) if tokens else None)
    except ValueError:
        return Refusal(0x07)
    if number in IDENTITY:
        return ClientCommand(Kind.MEMORY, body, command)
    return ClientCommand(Kind.RATE if number == LINE_RATE else Kind.READ, body, command)


def _reply_matches(reply: Reply, values: Values) -> bool:
    """Whether the reply shows these values in the register that was read."""
    if reply.register is None:
        return False
    try:
        return same(reply.register, values, parse(reply.register, reply.tokens))
    except RegisterValueError:  # a damaged reply proves nothing
        return False


# -- Order of commands -----------------------------------------------------------------------------


PATIENCE_S = 2.5  # a command expires in the queue: no known driver waits longer for an answer
MOST_WAITING = 16  # pending commands of one client
COUNTED = ("commands", "answered", "refused", "absorbed", "dropped", "unanswered")


@dataclass(frozen=True, slots=True)
class Waiting:
    """A command that is queued or on the wire; `gone`: its client has disconnected."""

    client: str
    asked: ClientCommand
    since_s: float
    gone: bool = False


@dataclass(slots=True)
class _Client:
    policy: SharePolicy
    lines: Deframer = field(default_factory=lambda: Deframer(host_side=True))
    rate: Values | None = None  # line rate, as this client set it


class Arbiter:
    """See the module. `counts` is indexed by client and a member of `COUNTED`."""

    def __init__(self, policies: Iterable[SharePolicy]) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._clients = {policy.name: _Client(policy) for policy in policies}
        self._queue: deque[Waiting] = deque()
        self._under_way: Waiting | None = None
        self._answers: list[SendToClient] = []
        self._notes: list[str] = []

    @property
    def deadline_s(self) -> float | None:
        """When the oldest queued command expires."""
        return self._queue[0].since_s + PATIENCE_S if self._queue else None

    @property
    def under_way(self) -> Waiting | None:
        """The command that is on the wire."""
        return self._under_way

    def take_answers(self) -> list[SendToClient]:
        """Answers to clients since the last call."""
        answers, self._answers = self._answers, []
        return answers

    def take_notes(self) -> list[str]:
        """Messages for a person since the last call."""
        notes, self._notes = self._notes, []
        return notes

    # -- from the clients --------------------------------------------------------------------------

    def receive(self, name: str, data: bytes, identity: Identity | None, now_s: float) -> None:
        """Take bytes of a client, cut anywhere. `identity`: of the device; None if unknown."""
        client = self._clients.get(name)
        if client is None:
            return
        sentences = client.lines.feed(data)
        for piece in client.lines.take_skipped():
            if piece.cause is Cause.CHECKSUM:
                self._refuse(name, Refusal(BAD_CHECKSUM))
            if piece.data.strip():
                self._notes.append(f"{name} sends what is no command of a VN-100")
        for sentence in sentences:
            request = parse_client_command(getattr(sentence, "body", ""), client.policy)
            self.counts[name, "commands"] += 1
            if isinstance(request, Refusal):
                self._refuse(name, request)
            elif self._answer_locally(name, client, request, identity):
                self.counts[name, "answered"] += 1
            else:
                self._enqueue(Waiting(name, request, now_s))

    def disconnect(self, name: str) -> None:
        """The client closed its port: drop its commands and discard a pending reply."""
        if (client := self._clients.get(name)) is not None:
            self._clients[name] = _Client(client.policy)
        self._queue = deque(one for one in self._queue if one.client != name)
        if self._under_way is not None and self._under_way.client == name:
            self._under_way = replace(self._under_way, gone=True)

    def _answer_locally(
        self, name: str, client: _Client, request: ClientCommand, identity: Identity | None
    ) -> bool:
        """Answer without the device if possible; returns whether it was."""
        if request.kind is Kind.STREAM:
            self._send(name, encode(request.body), request.body.endswith("1"))
        elif request.kind is Kind.RATE and isinstance(request.command, Write):
            client.rate = request.command.values
            self._send(name, encode(request.body))
        elif request.kind is Kind.RATE and client.rate is not None:
            self._send(name, encode(f"VNRRG,{format_reply(5, client.rate)}"))
        elif (
            isinstance(request.command, Read)
            and request.kind is Kind.MEMORY
            and identity is not None
        ):
            return self._answer_identity(name, request.command.register, identity)
        else:
            return False
        return True

    def _answer_identity(self, name: str, number: int, identity: Identity) -> bool:
        known = (identity.model, identity.hardware, identity.serial, identity.firmware)
        value = dict(zip(IDENTITY, known, strict=True))[number]
        if value is None:
            return False
        self._send(name, encode(f"VNRRG,{format_reply(number, (value,))}"))
        return True

    def _enqueue(self, waiting: Waiting) -> None:
        pending = [one for one in self._pending() if one.client == waiting.client]
        if any(one.asked.body == waiting.asked.body for one in pending):
            self.counts[waiting.client, "absorbed"] += 1
        elif len(pending) >= MOST_WAITING:
            self.counts[waiting.client, "dropped"] += 1
            self._notes.append(f"{waiting.client} sends faster than the device answers")
        else:
            self._queue.append(waiting)

    def _pending(self) -> list[Waiting]:
        return [*([] if self._under_way is None else [self._under_way]), *self._queue]

    # -- to and from the device --------------------------------------------------------------------

    def next_command(self, now_s: float) -> Waiting | None:
        """The next command to send, None while one is on the wire. Drops expired commands."""
        while self._queue and now_s - self._queue[0].since_s >= PATIENCE_S:
            expired = self._queue.popleft()
            self.counts[expired.client, "dropped"] += 1
            self._notes.append(f"{expired.client}: {expired.asked.command} got no turn in time")
        return self._queue[0] if self._queue and self._under_way is None else None

    def start_next(self) -> Waiting:
        """Mark the next command as on the wire. IndexError if the queue is empty."""
        self._under_way = self._queue.popleft()
        return self._under_way

    def finish_current(self, result: object, error: Exception | None) -> Waiting | None:
        """The command on the wire was answered, refused or not answered; returns it."""
        done, self._under_way = self._under_way, None
        if done is None:
            return None
        if done.gone:
            return done
        if done.asked.unless is not None:
            self._answer_comparison(done.client, *done.asked.unless, result)
        elif isinstance(result, Reply):
            self._forward_reply(done.client, result.word, result)
        elif isinstance(error, DeviceRefused):
            self._send(done.client, encode(f"VNERR,{error.code:02X}"))
        else:
            self.counts[done.client, "unanswered"] += 1
        return done

    def _answer_comparison(
        self, name: str, wanted: Values, refusal: Refusal, result: object
    ) -> None:
        """Answer a write that is not sent: success if the register already holds the values."""
        if isinstance(result, Reply) and _reply_matches(result, wanted):
            self._forward_reply(name, "VNWRG", result)
        else:
            self._refuse(name, refusal)

    def _forward_reply(self, name: str, word: str, reply: Reply) -> None:
        """Send the device's answer, with the word of the client's command."""
        self.counts[name, "answered"] += 1
        number = [] if reply.register is None else [f"{reply.register:02d}"]
        self._send(name, encode(",".join([word, *number, *reply.tokens])))

    def requeue_current(self) -> None:
        """The command on the wire was not sent: put it back at the head of the queue."""
        unsent, self._under_way = self._under_way, None
        if unsent is not None and not unsent.gone:
            self._queue.appendleft(unsent)

    def refuse_next(self, refusal: Refusal) -> None:
        """Refuse the next command instead of sending it."""
        if self._queue:
            self._refuse(self._queue.popleft().client, refusal)

    def broadcast(self, body: str) -> None:
        """Send every client a message that the device sent unasked."""
        for name in self._clients:
            self._send(name, encode(body))

    def _refuse(self, name: str, refusal: Refusal) -> None:
        self.counts[name, "refused"] += 1
        if refusal.why:
            self._notes.append(f"{name}: {refusal.why}")
        self._send(name, encode(f"VNERR,{refusal.code:02X}"))

    def _send(self, name: str, data: bytes, stream: bool | None = None) -> None:
        if name in self._clients:
            self._answers.append(SendToClient(name, data, stream))
