"""Command sequences of a VN-100, as generators for `session.Session`.

A procedure yields commands, is sent their replies and returns its result; `session` carries it out.
DeviceRefused, NoReply, LinkGone, Cancelled and NotPermitted come out of a `yield` as exceptions.
Everything that is written lives in RAM until `save_settings`, which saves all of RAM, so session
settings are put back (`restore`) before it. Source: UM001 "System Commands", the write sequence of
`write_verified` from the field.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeVar

from drivers.vn100.commands import (
    QUIET,
    RESUME,
    NoReply,
    Pause,
    Procedure,
    Read,
    SessionError,
    Word,
    Write,
)
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.firmware import Profile, profile_of
from drivers.vn100.registers import BINARY_OUTPUT_OFF, BINARY_OUTPUTS, Values, parse, same

T = TypeVar("T")

WRITE_TRIES = 3
ERROR_WINDOW_S = 1.5  # after VNWNV: the device may still report an error
INVALID_REGISTER = 0x08
SESSION_SETTINGS = (*BINARY_OUTPUTS, 7, 6)  # in the order in which `restore` puts them back

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
class Unit:
    """One device and no other, from registers 1, 3 and 4."""

    model: str
    serial: int
    firmware: str

    def __str__(self) -> str:
        return f"{self.model} serial {self.serial} firmware {self.firmware}"


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


def write_verified(register: int, values: Values, *, held: bool = False) -> Procedure[Values]:
    """Write, see the echo, read afresh, compare; up to three times. Returns what was read.

    held: the device itself held the values (`commands.Write`)
    An echo that never came is no failure as long as the fresh read shows the values. Raises
    VerifyFailed; ValueError before anything is sent where the device would refuse the values.
    """
    command = Write(register, values, held)
    back: Values = ()
    for _ in range(WRITE_TRIES):
        with suppress(NoReply):  # carried out or not: the read says which
            yield command
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


def restore(saved: Mapping[int, Values], keys: Iterable[int]) -> Procedure[tuple[int, ...]]:
    """Put the registers `keys` back to `saved`; returns those that had to be written.

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
            if (yield from _attempted(errors, number, step(number, saved[number]))):
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


def _put_back(number: int, values: Values) -> Procedure[bool]:
    present = yield from read(number)
    if same(number, values, present):
        return False
    yield from write_verified(number, values, held=True)
    return True


def _switch_off(number: int, values: Values) -> Procedure[bool]:
    if number not in BINARY_OUTPUTS:
        return False
    present = yield from read(number)
    if same(number, values, present) or same(number, BINARY_OUTPUT_OFF, present):
        return False
    yield from write_verified(number, BINARY_OUTPUT_OFF)
    return True


def _attempted(
    errors: dict[int, Exception], number: int, procedure: Procedure[bool]
) -> Procedure[bool]:
    """`procedure`, its failure noted; a link that is gone or a cancel ends everything."""
    try:
        return (yield from procedure)
    except (DeviceRefused, NoReply, VerifyFailed, ValueError) as error:
        errors[number] = error
        return False
