"""What a program may say to a VN-100, how long an answer takes, and what may go wrong.

Only what is in these tables can be constructed. VNFWU (firmware update), VNSBL, VNBLD, VNMCU,
VNDBS, VNCMD and the other words of vendor tools are not, so no mistake can send them; VNBOM is not,
because its answer is a measurement and no reply.

**Sequences of commands** are generators (`Procedure`): one yields commands, is sent their replies
and returns its result; `session.Session` carries it out. DeviceRefused, NoReply, LinkGone,
Cancelled and NotPermitted come out of a `yield` as exceptions. Everything that is written lives in
RAM until `save_settings`, which saves all of RAM, so session settings are put back (`restore`)
before it. Source: UM001 "System Commands", "System Error Codes"; the write sequence of
`write_verified` from the field.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TypeVar

from drivers.vn100.errors import ERRORS, DeviceRefused, DriverError, Remedy
from drivers.vn100.messages import Reply
from drivers.vn100.registers import (
    BINARY_OUTPUT_OFF,
    BINARY_OUTPUTS,
    REGISTERS,
    SESSION_SETTINGS,
    Profile,
    RegisterValueError,
    Unit,
    Values,
    format_command,
    parse,
    profile_of,
    same,
)

# -- One command -----------------------------------------------------------------------------------


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
        super().__init__("the port disappeared during a command sequence")


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


# -- Sequences of commands -------------------------------------------------------------------------


WRITE_TRIES = 3
ERROR_WINDOW_S = 1.5  # after VNWNV: the device may still report an error
INVALID_REGISTER = 0x08

# Without one of these not everything can be said about the samples or put back later, so a device
# that lacks one is only observed. The others may be missing on some firmware.
_ESSENTIAL = (5, 6, 7, 23, 26, 30, 44, 47, 75, 76, 77, 84, 85)
_OPTIONAL = (21, 25, 32, 35, 36, 38, 43, 74, 82, 83)
CONFIGURATION = tuple(sorted(_ESSENTIAL + _OPTIONAL))


class VerifyFailed(SessionError):
    """The device does not hold what was written: `sent` against `read`, after `tries`.

    echoed: the device had answered the write with what was read: it made this of the values
    """

    def __init__(
        self,
        register: int,
        sent: Values,
        read: Values,
        tries: int = WRITE_TRIES,
        *,
        echoed: bool = False,
    ) -> None:
        super().__init__(
            f"register {register} holds {read} after {tries} write{'s' * (tries > 1)} of {sent}: "
            "the device is not as it was asked to be"
        )
        self.register, self.sent, self.read, self.echoed = register, sent, read, echoed


class RestoreFailed(SessionError):
    """Some settings could not be put back; `errors` says which and why."""

    def __init__(self, errors: Mapping[int, Exception]) -> None:
        reasons = "; ".join(f"register {number}: {error}" for number, error in errors.items())
        super().__init__(f"settings not put back: {reasons}")
        self.errors = dict(errors)


@dataclass(frozen=True, slots=True)
class Seen:
    """Who answers, and some registers read in the same breath."""

    unit: Unit
    values: dict[int, Values]


@dataclass(frozen=True, slots=True)
class Identity:
    """Who the device is, from registers 1 to 4; `hardware` is None where it cannot be read."""

    model: str
    hardware: int | None
    serial: int
    firmware: str
    profile: Profile

    @property
    def unit(self) -> Unit:
        """What tells it from every other device."""
        return Unit(self.model, self.serial, self.firmware)

    def observed_without(self, values: Mapping[int, Values]) -> Identity:
        """The same, not to be written where an essential register is not among `values`."""
        absent = [n for n in _ESSENTIAL if self.profile.has(n) and n not in values]
        if not absent:
            return self
        numbers = ", ".join(map(str, absent))
        many = "s" if len(absent) > 1 else ""
        why = f"firmware {self.firmware} has no register{many} {numbers}"
        return replace(self, profile=self.profile.observed(why))


def identify() -> Procedure[Identity]:
    """Registers 1 to 4. What an earlier program left half-sent may spoil the first query."""
    try:
        first = yield from read(1)
    except DeviceRefused:
        first = yield from read(1)
    hardware: int | None = None
    with suppress(NoReply, DeviceRefused):  # newer firmware may print it in a way of its own
        hardware = int((yield from read(2))[0])
    serial = yield from read(3)
    firmware = str((yield from read(4))[0])
    model = str(first[0])
    return Identity(model, hardware, int(serial[0]), firmware, profile_of(firmware, model))


def read(register: int, port: int | None = None) -> Procedure[Values]:
    """One register's values."""
    reply = yield Read(register, port)
    return parse(register, reply.tokens)


def read_unit() -> Procedure[Unit]:
    """Who answers now. The serial number is the last that is read: only that of whoever has the
    cable by then counts, whatever was heard of another unit before.
    """
    values = yield from read_registers((1, 4, 3))
    return Unit(str(values[1][0]), int(values[3][0]), str(values[4][0]))


def look(unit: Unit, expected: Mapping[int, Values]) -> Procedure[Seen]:
    """Who answers, and the registers of `expected`; needs no pause of the output.

    What is not as expected is read once more, for a reply may be altered on its way.
    """
    seen = yield from _seen(expected)
    if seen.unit == unit and not differences(expected, seen.values):
        return seen
    return (yield from _seen(expected))


def _seen(expected: Mapping[int, Values]) -> Procedure[Seen]:
    """The serial number is asked at both ends: the cable may be moved between two questions."""
    unit = yield from read_unit()
    values = yield from read_registers(expected)
    last = int((yield from read(3))[0])
    return Seen(unit if last == unit.serial else replace(unit, serial=last), values)


def read_registers(ids: Iterable[int]) -> Procedure[dict[int, Values]]:
    """Several registers; DeviceRefused where one does not exist."""
    values: dict[int, Values] = {}
    for number in ids:
        values[number] = yield from read(number)
    return values


def read_configuration(profile: Profile) -> Procedure[dict[int, Values]]:
    """Every configuration register of this firmware: what must be put back and what un-maps data.

    A register that the device does not have (VNERR 08) is left out, so `missing` can name it. So is
    one of another model whose answer does not read like a VN-100's.
    """
    values: dict[int, Values] = {}
    for number in CONFIGURATION:
        if not profile.has(number):
            continue
        try:
            values[number] = yield from read(number)
        except DeviceRefused as error:
            if error.code != INVALID_REGISTER:
                raise
        except NoReply:
            if profile.writable or not values:
                raise
    return values


def read_present(ids: Iterable[int]) -> Procedure[dict[int, Values]]:
    """Several registers, without those that the device does not have (VNERR 08)."""
    values: dict[int, Values] = {}
    for number in ids:
        try:
            values[number] = yield from read(number)
        except DeviceRefused as error:
            if error.code != INVALID_REGISTER:
                raise
    return values


def missing(profile: Profile, values: Mapping[int, Values]) -> tuple[int, ...]:
    """Configuration registers that this firmware should have and `values` lacks."""
    return tuple(n for n in CONFIGURATION if profile.has(n) and n not in values)


def write_verified(
    register: int, values: Values, *, held: bool = False, unit: Unit | None = None
) -> Procedure[Values]:
    """Write, see the echo, read afresh, compare; up to three times. Returns what was read.

    held: the device itself held the values (`commands.Write`)
    unit: each attempt is one command right behind the answer that this unit is still the one that
          answers, for in a silence another may take over the cable; else NotAsKnown or TooLate
    An echo that never came is no failure as long as the fresh read shows the values. Raises
    VerifyFailed; ValueError before anything is sent where the device would refuse the values.
    """
    command = Write(register, values, held)
    back: Values = ()
    for _ in range(WRITE_TRIES):
        with suppress(NoReply):  # carried out or not: the read says which
            yield from asked(command) if unit is None else asked_of(Seen(unit, {}), command)
        back = yield from read(register)
        if same(register, values, back[: len(values)]):
            return back
    raise VerifyFailed(register, values, back)


def quiet(procedure: Procedure[T]) -> Procedure[T]:
    """`procedure` with the asynchronous output paused, and resumed whatever happens.

    Also where VNASY,0 itself got no reply: it may have been carried out. The device cannot be asked
    whether output was paused before; it is on afterwards.
    """
    abandoned = False
    try:
        yield QUIET
        return (yield from procedure)
    except GeneratorExit:  # dropped without an end: nobody is there to carry out a command
        abandoned = True
        raise
    finally:
        if not abandoned:
            yield from resume()


def resume() -> Procedure[None]:
    """Asynchronous output on; asked for twice as often as anything else: silence is no use."""
    try:
        yield RESUME
    except NoReply:
        yield RESUME


def save_settings(*, behind: bool = False) -> Procedure[None]:
    """VNWNV: all of RAM to flash; raises DeviceRefused also for an error shortly behind the echo.

    behind: only right behind an answer of the device; else TooLate and nothing is sent

    Sent once: after NoReply nobody knows whether it was carried out, and flash wears. Keep the
    sensor still, its filter is hardly served for half a second.
    """
    yield Word("VNWNV", behind=behind)
    yield Pause(ERROR_WINDOW_S, watch_errors=True)


def restore(
    saved: Mapping[int, Values], keys: Iterable[int], unit: Unit | None = None
) -> Procedure[tuple[int, ...]]:
    """Put the registers `keys` back to `saved`; returns those that had to be written.

    unit: only this one is written (`write_verified`)
    Binary outputs that differ are switched off first, so that the device's check whether all output
    fits the baud rate cannot refuse an intermediate state; then the rest, the output type (6) last.
    One that fails does not keep the others from being restored: RestoreFailed at the end.
    """
    errors: dict[int, Exception] = {}
    wanted = [number for number in keys if number in saved]
    order = [n for n in wanted if n not in SESSION_SETTINGS]
    order += [n for n in SESSION_SETTINGS if n in wanted]
    written = set()
    for step in (_switch_off, _put_back):
        for number in order:
            if (yield from _attempted(errors, number, step(number, saved[number], unit))):
                written.add(number)
    if errors:
        raise RestoreFailed(errors)
    return tuple(number for number in order if number in written)


def differences(
    saved: Mapping[int, Values], now: Mapping[int, Values]
) -> dict[int, tuple[Values | None, Values | None]]:
    """Registers that differ between two readings, with both values; None where one lacks it.

    Both were printed by the device, so they are compared as printed.
    """
    result: dict[int, tuple[Values | None, Values | None]] = {}
    for number in sorted({*saved, *now}):
        before, after = saved.get(number), now.get(number)
        if before is None or after is None or not same(number, before, after):
            result[number] = (before, after)
    return result


def _put_back(number: int, values: Values, unit: Unit | None) -> Procedure[bool]:
    present = yield from read(number)
    if same(number, values, present):
        return False
    yield from write_verified(number, values, held=True, unit=unit)
    return True


def _switch_off(number: int, values: Values, unit: Unit | None) -> Procedure[bool]:
    if number not in BINARY_OUTPUTS:
        return False
    present = yield from read(number)
    if same(number, values, present) or same(number, BINARY_OUTPUT_OFF, present):
        return False
    yield from write_verified(number, BINARY_OUTPUT_OFF, unit=unit)
    return True


def _attempted(
    errors: dict[int, Exception], number: int, procedure: Procedure[bool]
) -> Procedure[bool]:
    """`procedure`, its failure noted; a link that is gone or a cancel ends everything."""
    try:
        return (yield from procedure)
    except (DeviceRefused, NoReply, TooLate, VerifyFailed, ValueError) as error:
        errors[number] = error
        return False


# -- Sequences that make sure who answers ----------------------------------------------------------


BEHIND_TRIES = 5  # to have the answers and the command right behind them


class WrongDevice(SessionError):
    """Another device than the one whose outputs were to be put back."""


class Unsteady(SessionError):
    """A register does not read the same twice."""


class NotAsKnown(SessionError):
    """Another device answers than the one that was read, or it holds something else."""


def asked(command: Speech) -> Procedure[Reply]:
    """One command and its reply."""
    return (yield command)


def asked_of(known: Seen, command: Speech) -> Procedure[Reply]:
    """The same, once it is sure who answers and what it holds, and right behind that answer.

    Raises NotAsKnown, where nothing was sent, and TooLate on a line that answers too slowly.
    """
    if isinstance(command, Write):
        command = replace(command, once=True)
    elif isinstance(command, Word):
        command = replace(command, behind=True)
    for left in reversed(range(BEHIND_TRIES)):
        try:
            seen = yield from look(known.unit, known.values)
        except (NoReply, DeviceRefused) as error:
            raise NotAsKnown(f"the device does not say what it holds: {error}") from error
        if seen.unit != known.unit:
            raise NotAsKnown(f"another device answers: {seen.unit}")
        if changed := differences(known.values, seen.values):
            raise NotAsKnown(f"registers {', '.join(map(str, sorted(changed)))} changed")
        try:
            return (yield command)
        except TooLate:
            if not left:
                raise
    raise AssertionError("no attempt is left")


def save_settings_of(known: Seen) -> Procedure[None]:
    """`save_settings` of this unit while it holds these values; raises as `asked_of`."""
    yield from asked_of(known, Word("VNWNV"))
    yield Pause(ERROR_WINDOW_S, watch_errors=True)


def identify_in(seconds: float) -> Procedure[Identity]:
    """`identify_surely` after a while."""
    yield Pause(seconds)
    return (yield from identify_surely())


def identify_surely() -> Procedure[Identity]:
    """Who answers, asked twice: an altered reply must not pass for another device.

    Raises Unsteady.
    """
    identity = yield from identify()
    again = yield from read_unit()
    if again != identity.unit:
        raise Unsteady(f"the device says that it is {identity.unit}, then {again}")
    return identity


def read_twice(ids: Iterable[int]) -> Procedure[dict[int, Values]]:
    """Registers whose values will be put back; raises Unsteady where two readings differ."""
    values = yield from read_registers(ids)
    return (yield from _read_again(values, values))


def _read_again(values: Mapping[int, Values], ids: Iterable[int]) -> Procedure[dict[int, Values]]:
    """Those of `ids` once more; raises Unsteady where that differs from `values`."""
    again: dict[int, Values] = {}
    for number in ids:
        again[number] = yield from read(number)
        if not same(number, values[number], again[number]):
            raise Unsteady(f"register {number} reads {values[number]}, then {again[number]}")
    return again


def read_surely(identity: Identity, twice: Iterable[int]) -> Procedure[dict[int, Values]]:
    """The configuration of this device, and at the end it still is this device that answers.

    Some registers are read `twice`; those that will be put back can be written.

    A reading that was altered on the way would else become what the user had. Raises Unsteady,
    RegisterValueError.
    """
    values = yield from read_configuration(identity.profile)
    for number, again in (
        yield from _read_again(values, (n for n in twice if n in values))
    ).items():
        if number in SESSION_SETTINGS:
            format_command(number, again, held=True)
    if (unit := (yield from read_unit())) != identity.unit:
        raise Unsteady(f"{unit} answers, and a moment ago it was {identity.unit}")
    return values


def put_back_to(
    serial: int | None, users: Mapping[int, Values], wait_s: float
) -> Procedure[object]:
    """The user's outputs, to the device with this serial number and to no other."""
    if wait_s:
        yield Pause(wait_s)
    answered = int((yield from read(3))[0])
    if answered != serial:
        raise WrongDevice(f"the device has the serial number {answered}, not {serial}")
    return (yield from quiet(restore(users, SESSION_SETTINGS)))
