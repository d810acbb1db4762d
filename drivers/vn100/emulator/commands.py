"""What the emulated VN-100 answers to a command (vn100-protocol 3, 4 and 10).

A command that the device refuses raises RegisterValueError with the VNERR code. What a command does
beyond its reply is returned as an `SideEffect`; the emulator sees to the times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from drivers.vn100.emulator.memory import PER_PORT, Memory
from drivers.vn100.emulator.physics import GRAVITY_M_S2, HISTORY_TICKS, EmulatedWorld
from drivers.vn100.emulator.sensor import (
    KNOWN_ACCELERATION,
    KNOWN_MAGNETIC,
    MEASURED,
    Sensor,
    quantities_of,
)
from drivers.vn100.emulator.streams import BINARY_OUTPUTS, binary_packet, fits
from drivers.vn100.register_codec import RegisterValueError, Values
from drivers.vn100.registers import format_reply

INVALID_COMMAND, TOO_FEW, TOO_MANY, INVALID_PARAMETER, INVALID_REGISTER = 4, 5, 6, 7, 8
INSUFFICIENT_BAUD = 0x0C
MAGNETIC_MODEL, GRAVITY_MODEL = 0, 1  # fields of register 83


class SideEffect(Enum):
    """What happens besides the reply."""

    NONE = auto()
    OUTPUT = auto()  # what is sent, or how fast, may be different now
    BAUD = auto()  # the rate changes once the reply has left
    SAVE = auto()  # RAM to flash takes half a second, then the reply
    RESTART = auto()
    FACTORY = auto()  # factory settings, then a restart


@dataclass(frozen=True, slots=True)
class CommandReply:
    """A reply: the body of a sentence, and a packet as it goes on the wire behind it."""

    body: str = ""
    packet: bytes = b""
    effect: SideEffect = SideEffect.NONE


def _refused(code: int, message: str) -> RegisterValueError:
    return RegisterValueError(message, code)


def _one(arguments: list[str], allowed: tuple[int, ...]) -> int:
    """The only argument, one of `allowed`."""
    if not arguments:
        raise _refused(TOO_FEW, "an argument is missing")
    if len(arguments) > 1:
        raise _refused(TOO_MANY, "one argument only")
    if not arguments[0].isdecimal() or int(arguments[0]) not in allowed:
        raise _refused(INVALID_PARAMETER, f"{arguments[0]} is not one of {allowed}")
    return int(arguments[0])


def _none(arguments: list[str]) -> None:
    if arguments:
        raise _refused(TOO_MANY, "no arguments here")


class Interpreter:
    """Answers the commands that arrive on one port.

    streaming: whether VNASY lets async messages out on this port
    """

    def __init__(self, memory: Memory, sensor: Sensor, world: EmulatedWorld, port: int) -> None:
        self.memory = memory
        self.sensor = sensor
        self.port = port
        self.streaming = True
        self._world = world
        self._integrated_tick = 0
        self._words: dict[str, Callable[[list[str], int], CommandReply]] = {
            "VNRRG": self._read,
            "VNWRG": self._write,
            "VNWNV": self._plain("VNWNV", SideEffect.SAVE),
            "VNRST": self._plain("VNRST", SideEffect.RESTART),
            "VNRFS": self._plain("VNRFS", SideEffect.FACTORY),
            "VNASY": self._gate,
            "VNKMD": self._disturbance("VNKMD", KNOWN_MAGNETIC),
            "VNKAD": self._disturbance("VNKAD", KNOWN_ACCELERATION),
            "VNSGB": self._keep_bias_as("VNSGB"),
            "VNBOM": self._poll,
        }
        if memory.generation == 2:
            self._words["VNTAR"] = self._tare
        else:  # known to the vendor's current library
            self._words["VNSIH"] = self._initial_heading
            self._words["VNSFB"] = self._keep_bias_as("VNSFB")

    def answer(self, body: str, tick: int) -> CommandReply:
        """Carry out a command at `tick`. Raises RegisterValueError where it is refused."""
        word, *arguments = body.split(",")
        handler = self._words.get(word)
        if handler is None:
            raise _refused(INVALID_COMMAND, f"no command {word}")
        return handler(arguments, tick)

    def values(self, register: int, tick: int) -> Values:
        """What a read of the register shows, without the port of registers 5 to 7."""
        memory = self.memory
        if register in MEASURED:
            step = 1
            if register == 80:  # reading it begins a new integration
                step = min(max(tick - self._integrated_tick, 1), HISTORY_TICKS)
                self._integrated_tick = tick
            columns = MEASURED[register]
            values = self.sensor.row(quantities_of(columns), tick, step)
            return tuple(v * c.per_si for v, c in zip(values, columns, strict=True))
        if register == 33:
            counts = self.sensor.row(("sync_in_count", "time_sync_in_s", "sync_out_count"), tick, 1)
            return int(counts[0]), int(counts[1] * 1e6) & 0xFFFF_FFFF, int(counts[2])
        if register == 47:
            hsi = self.sensor.hsi
            return (*hsi.matrix.ravel().tolist(), *hsi.offset.tolist())
        if register == 21:
            return self._reference()
        return memory.get(register, self.port)

    def _reference(self) -> Values:
        """Register 21: as written, or what the world's model says (register 83)."""
        values, models = self.memory.get(21), self.memory.get(83)
        if models[MAGNETIC_MODEL] == 1:
            values = (*self._world.truth.field_n_gauss.tolist(), *values[3:])
        if models[GRAVITY_MODEL] == 1:
            values = (*values[:3], 0.0, 0.0, -GRAVITY_M_S2)
        return values

    def _register(self, arguments: list[str]) -> int:
        if not arguments:
            raise _refused(TOO_FEW, "no register number")
        if not (arguments[0].isdecimal() and len(arguments[0]) <= 3):
            raise _refused(INVALID_REGISTER, f"no register {arguments[0]}")
        return self.memory.row(int(arguments[0])).id

    def _read(self, arguments: list[str], tick: int) -> CommandReply:
        register = self._register(arguments)
        if register in PER_PORT and len(arguments) == 2:
            port = _one(arguments[1:], (1, 2))
            return self._echo("VNRRG", register, (*self.memory.get(register, port), port))
        _none(arguments[1:])
        return self._echo("VNRRG", register, self.values(register, tick))

    def _write(self, arguments: list[str], _: int) -> CommandReply:
        register = self._register(arguments)
        values = self.memory.parsed(register, arguments[1:])
        stored, port = values, 0
        if register in PER_PORT:
            stored, port = values[:1], int(values[1]) if len(values) > 1 else self.port
        if not fits(self.memory, register, port, stored):
            raise _refused(INSUFFICIENT_BAUD, "more output than the baud rate carries")
        self.memory.ram[register, port] = stored
        if register == 44 and stored[0] == 2:
            self.sensor.hsi.reset()
        self.sensor.changed()
        here = register == 5 and port == self.port
        return self._echo("VNWRG", register, values, SideEffect.BAUD if here else SideEffect.OUTPUT)

    def _echo(
        self, word: str, register: int, values: Values, effect: SideEffect = SideEffect.NONE
    ) -> CommandReply:
        return CommandReply(f"{word},{format_reply(register, values)}", effect=effect)

    def _plain(self, word: str, effect: SideEffect) -> Callable[[list[str], int], CommandReply]:
        def handler(arguments: list[str], _: int) -> CommandReply:
            _none(arguments)
            return CommandReply(word, effect=effect)

        return handler

    def _gate(self, arguments: list[str], _: int) -> CommandReply:
        self.streaming = _one(arguments, (0, 1)) == 1
        return CommandReply(f"VNASY,{int(self.streaming)}", effect=SideEffect.OUTPUT)

    def _disturbance(self, word: str, bit: int) -> Callable[[list[str], int], CommandReply]:
        def handler(arguments: list[str], _: int) -> CommandReply:
            present = _one(arguments, (0, 1))
            known = self.sensor.known_disturbance & ~bit
            self.sensor.known_disturbance = known | (bit if present else 0)
            self.sensor.changed()
            return CommandReply(f"{word},{present}")

        return handler

    def _keep_bias_as(self, word: str) -> Callable[[list[str], int], CommandReply]:
        """The filter's gyro bias into its start-up register (VNSGB, in newer words VNSFB)."""

        def handler(arguments: list[str], _: int) -> CommandReply:
            _none(arguments)
            register = self.memory.bias_register
            rest = self.memory.get(register)[3:]
            bias = self.memory.stored(register, (*self.sensor.filter_bias(), *rest))
            self.memory.ram[register, 0] = bias
            return CommandReply(word)

        return handler

    def _initial_heading(self, arguments: list[str], tick: int) -> CommandReply:
        """VNSIH: the heading of now, in degrees, until the next start."""
        if len(arguments) != 1:
            raise _refused(TOO_MANY if arguments else TOO_FEW, "one heading, in degrees")
        try:
            heading_deg = float(arguments[0])
        except ValueError:
            heading_deg = math.nan
        if not abs(heading_deg) <= 360.0:
            raise _refused(INVALID_PARAMETER, f"{arguments[0]} is no heading in degrees")
        self.sensor.set_heading(tick, math.radians(heading_deg))
        return CommandReply(f"VNSIH,{arguments[0]}")

    def _tare(self, arguments: list[str], tick: int) -> CommandReply:
        """The present attitude becomes the zero attitude until the next start (2.x)."""
        _none(arguments)
        self.sensor.tare(tick)
        return CommandReply("VNTAR")

    def _poll(self, arguments: list[str], tick: int) -> CommandReply:
        number = _one(arguments, (1, 2, 3))
        output = BINARY_OUTPUTS[number - 1]
        packet = binary_packet(self.memory.get(output), self.sensor, tick, 1)
        if not packet:
            raise _refused(INVALID_PARAMETER, f"register {output} selects nothing")
        return CommandReply(f"VNBOM,{number}", packet)
