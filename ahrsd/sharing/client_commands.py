"""What a client's line asks for, and the table of what a client may have.

A client is another program's driver that believes to have the device to itself. Its commands are
read like the device reads them, so what goes out on its behalf is always a command of
`drivers.vn100.commands`, and nothing else can.

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

Sources: UM001 "System Commands"; what drivers send at their start
(tests/support/devices/drivers_at_start.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal

from ahrsd.writeback.permissions import GUARDED, PASSABLE
from ahrsd.writeback.states import Purpose
from drivers.vn100.commands import Read, Speech, Word, Write
from drivers.vn100.registers import REGISTERS, RegisterValueError, parse

IDENTITY: Final = (1, 2, 3, 4)
LINE_RATE: Final = 5

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
    """

    kind: Kind
    body: str
    command: Speech

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
        return Refusal(UNAUTHORIZED, why)
    if not REGISTERS[number].writable:
        return Refusal(UNAUTHORIZED)
    try:
        command = Write(number, parse(number, tokens[1:]), held=True)
    except RegisterValueError as error:
        return Refusal(error.code)
    if number == LINE_RATE:
        return ClientCommand(Kind.RATE, body, command)
    if not policy.owner:
        return Refusal(UNAUTHORIZED, f"writes of register {number} are for the share with owner")
    return ClientCommand(Kind.CALIBRATE if passes else Kind.WRITE, body, command)


def _read(number: int, tokens: list[str], body: str) -> ClientCommand | Refusal:
    try:
        command = Read(number, int(tokens[0]) if tokens else None)
    except ValueError:
        return Refusal(0x07)
    if number in IDENTITY:
        return ClientCommand(Kind.MEMORY, body, command)
    return ClientCommand(Kind.RATE if number == LINE_RATE else Kind.READ, body, command)
