"""What a program may say to a VN-100, how long an answer takes, and what may go wrong.

Only what is in these tables can be constructed. VNFWU (firmware update), VNSBL, VNBLD, VNMCU,
VNDBS, VNCMD and the other words of vendor tools are not, so no mistake can send them; VNBOM is not,
because its answer is a measurement and no reply. Source: UM001 "System Commands", "System Error
Codes".
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TypeVar

from drivers.vn100.errors import ERRORS, DriverError, Remedy
from drivers.vn100.messages import Reply
from drivers.vn100.registers import (
    REGISTERS,
    RegisterValueError,
    Values,
    format_command,
    parse,
    same,
)

WORDS: dict[str, tuple[tuple[int, ...], ...]] = {  # word: the arguments that it takes
    "VNWNV": ((),),
    "VNRST": ((),),
    "VNRFS": ((),),
    "VNSGB": ((),),
    "VNTAR": ((),),
    "VNASY": ((0,), (1,)),
    "VNKMD": ((0,), (1,)),
    "VNKAD": ((0,), (1,)),
}


class SessionError(DriverError):
    """A command sequence could not be carried out; one of the classes below."""


class NoReply(SessionError):
    """The device did not answer `command`, as often as the command may be repeated."""

    def __init__(self, command: Command) -> None:
        super().__init__(
            f"no reply to {command}: check the cable, the baud rate and that the device is powered"
        )
        self.command = command


class LinkGone(SessionError):
    """The port went away; nothing more can be sent, not even to tidy up."""

    def __init__(self) -> None:
        super().__init__("the port went away in the middle of a command sequence")


class Cancelled(SessionError):
    """The caller stopped the sequence; what it changed is put back before it ends."""

    def __init__(self) -> None:
        super().__init__("the command sequence was cancelled")


class TooLate(SessionError):
    """`command` is only sent right behind an answer, and the question before it is too old."""

    def __init__(self, command: Command) -> None:
        super().__init__(f"{command} was held back: the answers before it come too slowly")
        self.command = command


class NotPermitted(SessionError):
    """The gate of this session (its mode) does not let `command` out; nothing was sent."""

    def __init__(self, command: Command) -> None:
        super().__init__(f"{command} is not permitted in this mode")
        self.command = command


@dataclass(frozen=True, slots=True)
class Read:
    """Read a register; `port` for registers 5 to 7 of the port that is not in use."""

    register: int
    port: int | None = None

    def __post_init__(self) -> None:
        if self.register not in REGISTERS:
            raise ValueError(f"the VN-100 has no register {self.register}")
        if self.port is not None and (self.register not in (5, 6, 7) or self.port not in (1, 2)):
            raise ValueError(f"register {self.register} has no port {self.port}")

    @property
    def body(self) -> str:
        """What goes between $ and *."""
        port = "" if self.port is None else f",{self.port}"
        return f"VNRRG,{self.register:02d}{port}"

    def answered_by(self, reply: Reply) -> bool:
        """Whether `reply` is one to this: the word, the register, and values that it can have."""
        if not reply.tokens and self.register != USER_TAG:  # a command's echo, not an answer
            return False
        values = _values(self.register, "VNRRG", reply)
        return values is not None and (self.port is None or values[1:] == (self.port,))

    def __str__(self) -> str:
        return f"read of register {self.register}"


@dataclass(frozen=True, slots=True)
class Write:
    """Write a register in RAM. RegisterValueError where the device would refuse the values.

    held: the device itself held these values, so they may go back whatever the manual says of them
    once: not repeated after a silence, in which another device may have taken over the cable, and
          only sent right behind an answer (see `Session`); else TooLate. Its echo may show other
          values: what the device made of them
    """

    register: int
    values: Values
    held: bool = field(default=False, compare=False)
    once: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        format_command(self.register, self.values, held=self.held)

    @property
    def body(self) -> str:
        """What goes between $ and *."""
        return f"VNWRG,{format_command(self.register, self.values, held=self.held)}"

    def answered_by(self, reply: Reply) -> bool:
        """Whether `reply` echoes these values, or with `once` any; else it is another program's."""
        values = _values(self.register, "VNWRG", reply)
        if values is None:
            return False
        return self.once or same(self.register, self.values, values[: len(self.values)])

    def __str__(self) -> str:
        return f"write of register {self.register}"


@dataclass(frozen=True, slots=True)
class Word:
    """A command that is no register access, such as ``Word("VNASY", (0,))``.

    behind: only sent right behind an answer (see `Session`); else TooLate
    """

    word: str
    arguments: tuple[int, ...] = ()
    behind: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        if self.arguments not in WORDS.get(self.word, ()):
            raise ValueError(f"{self.body} is never sent; possible are {', '.join(WORDS)}")

    @property
    def body(self) -> str:
        """What goes between $ and *."""
        return ",".join([self.word, *map(str, self.arguments)])

    def answered_by(self, reply: Reply) -> bool:
        """Whether `reply` is the echo of this, arguments included."""
        return (
            reply.word == self.word
            and reply.register is None
            and [token.lstrip("0") for token in reply.tokens]
            == [str(argument).lstrip("0") for argument in self.arguments]
        )

    def __str__(self) -> str:
        return self.body


@dataclass(frozen=True, slots=True)
class Pause:
    """Send nothing for a while. The Reply has the names of the layouts that were heard as tokens.

    watch_errors: a VNERR in that time is thrown into the procedure (the window after VNWNV).
    """

    seconds: float
    watch_errors: bool = False


Command = Read | Write | Word | Pause
Speech = Read | Write | Word
USER_TAG = 0
RESUME = Word("VNASY", (1,))
QUIET = Word("VNASY", (0,))

T = TypeVar("T")
Procedure = Generator[Command, Reply, T]


@dataclass(frozen=True, slots=True)
class Patience:
    """How long one reply may take (None: the session's own figure) and how often to ask.

    tries:   where no reply comes
    damaged: where a VNERR says at once that the command arrived damaged
    """

    reply_s: float | None = None
    tries: int = 3
    damaged: int = 3


# Never repeated without an answer: a second VNWNV costs flash, a second reset restarts the filter
# again. Whoever gets NoReply reads registers to see what happened.
_PATIENCE = {
    "VNWNV": Patience(2.0, 1, 1),
    "VNRST": Patience(3.0, 1, 1),
    "VNRFS": Patience(3.0, 1, 1),
}


def patience(command: Speech) -> Patience:
    """Timing of a command: UM001 gives none, these are what works in the field."""
    if isinstance(command, Write) and command.once:
        return Patience(tries=1)
    return _PATIENCE.get(command.word, Patience()) if isinstance(command, Word) else Patience()


def must_follow(command: Speech) -> bool:
    """Whether it is only sent right behind an answer of the device."""
    return (isinstance(command, Write) and command.once) or (
        isinstance(command, Word) and command.behind
    )


def reply_time_s(baud: int) -> float:
    """How long to wait for an ordinary reply: 250 ms, and the device's full transmit buffer."""
    return 0.25 + 2048 * 10 / baud


def confusable(earlier: Speech, later: Speech) -> bool:
    """Whether a reply to `earlier` could be taken for one to `later`."""
    if isinstance(earlier, Word) or isinstance(later, Word):
        return earlier == later
    return type(earlier) is type(later) and earlier.register == later.register


# Damaged on the way to the device, so nothing was carried out.
RETRIED_ERRORS = frozenset(code for code, row in ERRORS.items() if row.outcome is Remedy.RETRY)
# Answers to a command; the others (01, 0A, 0B, FF, unknown ones) are about the device's own state.
REFUSALS = frozenset({0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0C})


def _values(register: int, word: str, reply: Reply) -> Values | None:
    """The values of `reply` where it is one of `word` and `register`, else None."""
    if reply.word != word or reply.register != register:
        return None
    try:
        return parse(register, reply.tokens)
    except RegisterValueError:
        return None
