"""What a client's command may do, whose command is next on the wire, and to whom an answer goes.

A client is another program's driver that believes to have the device to itself. Pure; time is an
argument.

**What a client may have.** Its commands are read like the device reads them, so what goes out on
its behalf is always a command of `drivers.vn100.commands`, and nothing else can.

| what | answer |
|---|---|
| read of registers 1 to 4 (who the device is) | from memory, once it is known |
| VNASY | by the port: only this client's stream stops and goes on |
| register 5 (baud rate) | as if it had worked; the line to the device stays as it is |
| registers 23, 25, 26, 43, 44, 74, 84 and the words that change them | VNERR 09: they are ahrsd's |
| the same registers, for an owner with `calibration_writes = "pass"` | the device's |
| VNWNV, VNRST | as the share's policy says |
| VNRFS and the words of vendor tools | VNERR 09 |
| any other read | the device's |
| any other write, VNKMD, VNKAD | the device's for the owner; VNERR 09 for everybody else |
| a write that would be VNERR 09, of what the register holds already | as if it had worked |

The last is how VectorNav's SDK finds out what belongs into a saved configuration: it writes back
what it has just read. The register is read instead, and only what differs is refused.

Sources: UM001 "System Commands"; what drivers send at their start
(tests/support/devices/drivers_at_start.py).

**Turns.** One command is on the wire at a time, the clients' in the order in which they came, and
the daemon's own in between. What a client asks again while its question waits is absorbed: drivers
repeat after 50 ms what takes 60. A question that waited for longer than any driver waits for its
answer is dropped: an answer that comes later would be taken for one to something else.

A client that floods the port, sends half a line for ever or goes away costs nobody else anything:
its line buffer and its questions are bounded.
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

# -- What a client may have ------------------------------------------------------------------------


IDENTITY: Final = (1, 2, 3, 4)
LINE_RATE: Final = 5
_OF_PORTS: Final = frozenset({5, 6, 7})  # which the device holds for each of its ports

BAD_CHECKSUM, BAD_COMMAND, TOO_FEW, BAD_REGISTER, UNAUTHORIZED = 0x03, 0x04, 0x05, 0x08, 0x09


class Kind(Enum):
    """What is to be done with a client's command."""

    MEMORY = "answer from memory"
    STREAM = "this client's own stream"
    RATE = "pretend"
    SAVE = "save"
    RESET = "reset"
    READ = "read"
    WRITE = "write"
    CALIBRATE = "write what calibrates"
    COMPARE = "read what is not to be written"
    REFUSE = "refuse"


_WORDS: Final[dict[str, Kind]] = {
    "VNWNV": Kind.SAVE,
    "VNRST": Kind.RESET,
    "VNASY": Kind.STREAM,
    "VNKMD": Kind.WRITE,  # the disturbances that the device's own filter is told of
    "VNKAD": Kind.WRITE,
}
_FORBIDDEN: Final = frozenset(
    {"VNRFS", "VNTAR", "VNSGB", "VNSFB", "VNSIH", "VNSPS", "VNFWU", "VNBLD", "VNSBL", "VNMCU"}
)


@dataclass(frozen=True, slots=True)
class SharePolicy:
    """What one share allows.

    name:  how people and the log call it: the path of its port
    owner: its output registers are the device's; at most one share is
    save:  what becomes of VNWNV: refused, or sent once nothing unproven is in the device's RAM
    reset: what becomes of VNRST: refused, or sent and told
    calibration_writes: what becomes of the owner's writes of what calibrates: refused, or journaled
           and sent
    """

    name: str
    owner: bool = False
    save: Literal["refuse", "clean"] = "clean"
    reset: Literal["refuse", "announce"] = "announce"
    calibration_writes: Literal["guard", "pass"] = "guard"

    def passes(self, number: int) -> bool:
        """Whether a write of this register, which calibrates, is the owner's to make."""
        return self.owner and self.calibration_writes == "pass" and number in PASSABLE


@dataclass(frozen=True, slots=True)
class ClientCommand:
    """A command that a client may have.

    body:    as the client wrote it, between $ and *
    command: what would go to the device
    unless:  of a write that is only compared: what it wants, and the answer where that differs
    """

    kind: Kind
    body: str
    command: Speech
    unless: tuple[Values, Refusal] | None = None

    @property
    def purpose(self) -> Purpose:
        """What the gate in front of the device is asked for."""
        calibrates = self.kind is Kind.CALIBRATE
        return Purpose.CLIENT_CALIBRATION if calibrates else Purpose.CLIENT


@dataclass(frozen=True, slots=True)
class Refusal:
    """The VNERR that answers; `why` is for the log, empty where the client's line was wrong."""

    code: int
    why: str = ""


def understand(body: str, policy: SharePolicy) -> ClientCommand | Refusal:
    """What a client's line, without frame and checksum, asks for by this policy."""
    word, _, rest = body.partition(",")
    tokens = rest.split(",") if rest else []
    if word in ("VNRRG", "VNWRG"):
        return _register(word, tokens, body, policy)
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


def _register(
    word: str, tokens: list[str], body: str, policy: SharePolicy
) -> ClientCommand | Refusal:
    if not tokens or not tokens[0].isascii() or not tokens[0].isdigit():
        return Refusal(TOO_FEW if not tokens or not tokens[0] else BAD_REGISTER)
    number = int(tokens[0])
    if number not in REGISTERS:
        return Refusal(BAD_REGISTER)
    if word == "VNRRG":
        return _read(number, tokens[1:], body)
    passes = policy.passes(number)
    if number in GUARDED and number != LINE_RATE and not passes:
        why = f"register {number} was not written for a client: what calibrates is ahrsd's"
        return _unless_held(number, tokens[1:], body, Refusal(UNAUTHORIZED, why))
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
        return _unless_held(number, tokens[1:], body, Refusal(UNAUTHORIZED, why))
    return ClientCommand(Kind.CALIBRATE if passes else Kind.WRITE, body, command)


def _unless_held(
    number: int, tokens: list[str], body: str, refusal: Refusal
) -> ClientCommand | Refusal:
    """A write that is refused, but where the register holds these values already."""
    if number in _OF_PORTS or not REGISTERS[number].writable:
        return refusal
    try:
        values = parse(number, tokens)
    except RegisterValueError:
        return refusal
    return ClientCommand(Kind.COMPARE, body, Read(number), (values, refusal))


def _read(number: int, tokens: list[str], body: str) -> ClientCommand | Refusal:
    try:
        command = Read(number, int(tokens[0]) if tokens else None)
    except ValueError:
        return Refusal(0x07)
    if number in IDENTITY:
        return ClientCommand(Kind.MEMORY, body, command)
    return ClientCommand(Kind.RATE if number == LINE_RATE else Kind.READ, body, command)


def _holds(reply: Reply, values: Values) -> bool:
    """Whether a device that replied so holds these values in the register that was read."""
    if reply.register is None:
        return False
    try:
        return same(reply.register, values, parse(reply.register, reply.tokens))
    except RegisterValueError:  # a reply that is damaged says nothing
        return False


# -- Turns -----------------------------------------------------------------------------------------


PATIENCE_S = 2.5  # the longest that a known driver waits for an answer
MOST_WAITING = 16  # commands of one client
COUNTED = ("commands", "answered", "refused", "absorbed", "dropped", "unanswered")


@dataclass(frozen=True, slots=True)
class Waiting:
    """A command that waits for its turn, or is on the wire; `gone`: its client does not listen."""

    client: str
    asked: ClientCommand
    since_s: float
    gone: bool = False


@dataclass(slots=True)
class _Client:
    policy: SharePolicy
    lines: Deframer = field(default_factory=lambda: Deframer(host_side=True))
    rate: Values | None = None  # of the line, as this client set it


class Arbiter:
    """See the module. `counts`: by client and one of `COUNTED`."""

    def __init__(self, policies: Iterable[SharePolicy]) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._clients = {policy.name: _Client(policy) for policy in policies}
        self._queue: deque[Waiting] = deque()
        self._under_way: Waiting | None = None
        self._answers: list[SendToClient] = []
        self._notes: list[str] = []

    @property
    def deadline_s(self) -> float | None:
        """When the oldest question has waited for too long."""
        return self._queue[0].since_s + PATIENCE_S if self._queue else None

    @property
    def under_way(self) -> Waiting | None:
        """The command that is on the wire."""
        return self._under_way

    def take_answers(self) -> list[SendToClient]:
        """What is due to clients since the last call."""
        answers, self._answers = self._answers, []
        return answers

    def take_notes(self) -> list[str]:
        """What a person should know of, since the last call."""
        notes, self._notes = self._notes, []
        return notes

    # -- from the clients --------------------------------------------------------------------------

    def received(self, name: str, data: bytes, identity: Identity | None, now_s: float) -> None:
        """Bytes of a client, cut anywhere. `identity` is the device's, where it is known."""
        client = self._clients.get(name)
        if client is None:
            return
        found = client.lines.feed(data)
        for piece in client.lines.take_skipped():
            if piece.cause is Cause.CHECKSUM:
                self._refuse(name, Refusal(BAD_CHECKSUM))
            if piece.data.strip():
                self._notes.append(f"{name} sends what is no command of a VN-100")
        for sentence in found:
            asked = understand(getattr(sentence, "body", ""), client.policy)
            self.counts[name, "commands"] += 1
            if isinstance(asked, Refusal):
                self._refuse(name, asked)
            elif self._answered_here(name, client, asked, identity):
                self.counts[name, "answered"] += 1
            else:
                self._wait(Waiting(name, asked, now_s))

    def left(self, name: str) -> None:
        """The client closed its port: what it asked is nobody's any more."""
        if (client := self._clients.get(name)) is not None:
            self._clients[name] = _Client(client.policy)
        self._queue = deque(one for one in self._queue if one.client != name)
        if self._under_way is not None and self._under_way.client == name:
            self._under_way = replace(self._under_way, gone=True)

    def _answered_here(
        self, name: str, client: _Client, asked: ClientCommand, identity: Identity | None
    ) -> bool:
        """Answer what needs no device; whether that was possible."""
        if asked.kind is Kind.STREAM:
            self._say(name, encode(asked.body), asked.body.endswith("1"))
        elif asked.kind is Kind.RATE and isinstance(asked.command, Write):
            client.rate = asked.command.values
            self._say(name, encode(asked.body))
        elif asked.kind is Kind.RATE and client.rate is not None:
            self._say(name, encode(f"VNRRG,{format_reply(5, client.rate)}"))
        elif isinstance(asked.command, Read) and asked.kind is Kind.MEMORY and identity is not None:
            return self._identify(name, asked.command.register, identity)
        else:
            return False
        return True

    def _identify(self, name: str, number: int, identity: Identity) -> bool:
        known = (identity.model, identity.hardware, identity.serial, identity.firmware)
        value = dict(zip(IDENTITY, known, strict=True))[number]
        if value is None:
            return False
        self._say(name, encode(f"VNRRG,{format_reply(number, (value,))}"))
        return True

    def _wait(self, waiting: Waiting) -> None:
        mine = [one for one in self._all() if one.client == waiting.client]
        if any(one.asked.body == waiting.asked.body for one in mine):
            self.counts[waiting.client, "absorbed"] += 1
        elif len(mine) >= MOST_WAITING:
            self.counts[waiting.client, "dropped"] += 1
            self._notes.append(f"{waiting.client} sends faster than the device answers")
        else:
            self._queue.append(waiting)

    def _all(self) -> list[Waiting]:
        return [*([] if self._under_way is None else [self._under_way]), *self._queue]

    # -- to and from the device --------------------------------------------------------------------

    def first(self, now_s: float) -> Waiting | None:
        """The next command for the wire, where none is on it; what waited too long is dropped."""
        while self._queue and now_s - self._queue[0].since_s >= PATIENCE_S:
            late = self._queue.popleft()
            self.counts[late.client, "dropped"] += 1
            self._notes.append(f"{late.client}: {late.asked.command} got no turn in time")
        return self._queue[0] if self._queue and self._under_way is None else None

    def begin(self) -> Waiting:
        """The first one goes on the wire. IndexError where nothing waits."""
        self._under_way = self._queue.popleft()
        return self._under_way

    def ended(self, result: object, error: Exception | None) -> Waiting | None:
        """What is on the wire was answered, refused, or not answered; returns it."""
        done, self._under_way = self._under_way, None
        if done is None:
            return None
        if done.gone:
            return done
        if done.asked.unless is not None:
            self._compared(done.client, *done.asked.unless, result)
        elif isinstance(result, Reply):
            self._reply(done.client, result.word, result)
        elif isinstance(error, DeviceRefused):
            self._say(done.client, encode(f"VNERR,{error.code:02X}"))
        else:
            self.counts[done.client, "unanswered"] += 1
        return done

    def _compared(self, name: str, wanted: Values, refusal: Refusal, result: object) -> None:
        """A write that is not sent: as if it had worked where the register holds that already."""
        if isinstance(result, Reply) and _holds(result, wanted):
            self._reply(name, "VNWRG", result)
        else:
            self._refuse(name, refusal)

    def _reply(self, name: str, word: str, reply: Reply) -> None:
        """What the device answered, behind the word of the question."""
        self.counts[name, "answered"] += 1
        number = [] if reply.register is None else [f"{reply.register:02d}"]
        self._say(name, encode(",".join([word, *number, *reply.tokens])))

    def again(self) -> None:
        """What is on the wire was not sent after all: it is the first one again."""
        held, self._under_way = self._under_way, None
        if held is not None and not held.gone:
            self._queue.appendleft(held)

    def refuse_first(self, refusal: Refusal) -> None:
        """The first one is not to be sent, for this reason."""
        if self._queue:
            self._refuse(self._queue.popleft().client, refusal)

    def tell_all(self, body: str) -> None:
        """Something that the device said by itself."""
        for name in self._clients:
            self._say(name, encode(body))

    def _refuse(self, name: str, refusal: Refusal) -> None:
        self.counts[name, "refused"] += 1
        if refusal.why:
            self._notes.append(f"{name}: {refusal.why}")
        self._say(name, encode(f"VNERR,{refusal.code:02X}"))

    def _say(self, name: str, data: bytes, stream: bool | None = None) -> None:
        if name in self._clients:
            self._answers.append(SendToClient(name, data, stream))
