"""What the emulated VN-100 sends: messages by itself, as far as they fit the line, and answers.

Registers 6 and 7 choose the ASCII message of a port, registers 75 to 77 the binary ones. A write
that would ask for more than the port's baud rate carries is refused (vn100-protocol 1.5).

The transmitter (`Wire`) sends whole messages at the pace of the baud rate. Up to `QUEUE_BYTES`
wait; a message that does not fit is dropped, and as soon as there is room error 0B says so
(vn100-protocol 3.1). A message reaches the host when its last byte has left.

**Answers to commands** (vn100-protocol 3, 4 and 10). A command that the device refuses raises
RegisterValueError with the VNERR code. What a command does beyond its reply is returned as a
`SideEffect`; the emulator sees to the times.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from drivers.vn100.emulator.faults import FaultPlan
from drivers.vn100.emulator.memory import PER_PORT, PORTS, Memory
from drivers.vn100.emulator.physics import GRAVITY_M_S2, HISTORY_TICKS, TICK_HZ, EmulatedWorld
from drivers.vn100.emulator.sensor import (
    KNOWN_ACCELERATION,
    KNOWN_MAGNETIC,
    MEASURED,
    Sensor,
    quantities_of,
)
from drivers.vn100.messages import (
    MESSAGES,
    BinaryLayout,
    Message,
    binary_layout,
    encode_packet,
    encode_sentence,
)
from drivers.vn100.register_codec import RegisterValueError, Values
from drivers.vn100.registers import format_reply

# -- Streams ---------------------------------------------------------------------------------------


# -- The transmitter -------------------------------------------------------------------------------


QUEUE_BYTES = 2048
BITS_PER_BYTE = 10  # 8N1


class Transmitter:
    """Orders messages in time. Messages must be sent in order of time.

    connected: whether anybody hears them;  overflows: messages that found no room
    """

    def __init__(self, plan: FaultPlan, baud: int, overflow: Callable[[], bytes]) -> None:
        self.baud = baud
        self.overflows = 0
        self.connected = True
        self._plan = plan
        self._overflow = overflow
        self._overflowed = False
        self._free_s = 0.0  # when the last byte of the queue will have left
        self._released_s = 0.0
        self._queue: deque[tuple[float, float, int, bytes]] = deque()

    def send(self, message: bytes, now_s: float) -> None:
        """Put a message into the queue at `now_s`."""
        if self._overflowed and self._room(now_s) >= QUEUE_BYTES // 2:
            self._overflowed = False
            self._put(self._overflow(), now_s)
        if self._room(now_s) < len(message):
            self._overflowed = True
            self.overflows += 1
            return
        self._put(message, now_s)

    def empty_at_s(self, now_s: float) -> float:
        """When everything that is in the queue will have left."""
        return max(self._free_s, now_s)

    def cut(self, now_s: float) -> None:
        """Power or plug is gone: what has not arrived is lost."""
        while self._queue and self._queue[-1][0] > now_s:
            self._queue.pop()
        self._free_s = 0.0
        self._released_s = 0.0
        self._overflowed = False

    def collect(self, now_s: float) -> list[tuple[int, bytes]]:
        """Messages that have reached the host by `now_s`, as the faults left them.

        With each the baud rate at which it was sent.
        """
        arrived = []
        while self._queue and self._queue[0][0] <= now_s:
            _, sent_s, baud, message = self._queue.popleft()
            arrived.append((baud, self._plan.distort(message, sent_s)))
        return arrived

    def _room(self, now_s: float) -> float:
        waiting = max(0.0, self._free_s - now_s) * self.baud / BITS_PER_BYTE
        return QUEUE_BYTES - waiting

    def _put(self, message: bytes, now_s: float) -> None:
        if not message:
            return
        start_s = self.empty_at_s(now_s)
        self._free_s = start_s + len(message) * BITS_PER_BYTE / self.baud
        self._released_s = max(self._released_s, self._plan.release_s(self._free_s))
        if self.connected:
            self._queue.append((self._released_s, self._free_s, self.baud, message))


# -- Which messages --------------------------------------------------------------------------------


BINARY_OUTPUTS = (75, 76, 77)
ASCII_OUTPUTS: dict[int, Message] = {row.output_type: row for row in MESSAGES.values()}

# Bytes of a line with a 2-digit checksum, by ADOR (vn100-protocol 1.5; VNHVE by its format).
LINE_BYTES = {1: 38, 2: 51, 8: 135, 10: 38, 11: 35, 12: 44, 13: 95, 14: 122, 16: 95, 17: 95}
LINE_BYTES |= {19: 110, 30: 75, 34: 38}


@dataclass(frozen=True, slots=True)
class OutputStream:
    """One asynchronous output: `message(tick)` is due at every multiple of `step_ticks`."""

    step_ticks: int
    message: Callable[[int], bytes]


def streams(memory: Memory, sensor: Sensor, port: int) -> list[OutputStream]:
    """What comes out of `port`, in the order in which it comes at a common instant."""
    found = []
    for output in BINARY_OUTPUTS:
        values = memory.get(output)
        if _routed(values, port):
            found.append(_binary_stream(values, sensor))
    ador, adof = memory.number(6, port), memory.number(7, port)
    if ador and adof:
        found.append(_ascii_stream(ador, TICK_HZ // adof, memory, sensor))
    return found


def _routed(values: Values, port: int) -> bool:
    mode, divisor, groups = (int(value) for value in values[:3])
    return bool(mode >> (port - 1) & 1 and divisor and groups)


def _binary_stream(values: Values, sensor: Sensor) -> OutputStream:
    step = int(values[1])
    return OutputStream(step, lambda tick: binary_packet(values, sensor, tick, step))


def _ascii_stream(ador: int, step: int, memory: Memory, sensor: Sensor) -> OutputStream:
    return OutputStream(step, lambda tick: ascii_message(ador, memory, sensor, tick, step))


def ascii_message(ador: int, memory: Memory, sensor: Sensor, tick: int, step: int) -> bytes:
    """The sentence of a code of register 6, with count and status where register 30 wants them."""
    row = ASCII_OUTPUTS[ador]
    values = sensor.row(quantities_of(row.columns), tick, step)
    protocol = [int(value) for value in memory.get(30)]
    count = _count(protocol[0], sensor, tick) if protocol[0] else None
    status = int(sensor.row(("vpe_status",), tick, step)[0]) if protocol[1] else None
    return encode_sentence(row.name, values, count, status, "crc" if protocol[4] == 3 else "xor")


def _count(kind: int, sensor: Sensor, tick: int) -> int:
    names = {1: "sync_in_count", 2: "time_sync_in_s", 3: "sync_out_count"}
    value = sensor.row((names[kind],), tick, 1)[0]
    return int(value * 1e6) % 10**10 if kind == 2 else int(value)


def binary_packet(values: Values, sensor: Sensor, tick: int, step: int) -> bytes:
    """The packet that registers 75 to 77 with these values select; empty where there is none."""
    layout = _layout(values)
    if layout is None:
        return b""
    return encode_packet(layout, sensor.row(quantities_of(layout.columns), tick, step))


def _layout(values: Values) -> BinaryLayout | None:
    groups = int(values[2])
    return binary_layout(groups, [int(word) for word in values[3:]]) if groups else None


def fits(memory: Memory, register: int, port: int, values: Values) -> bool:
    """Whether the line carries the output of every port that this write addresses."""
    if register in PER_PORT:
        ports: tuple[int, ...] = (port,)
    elif register in BINARY_OUTPUTS:
        ports = tuple(p for p in PORTS if _routed(values, p))
    else:
        return True
    ram = {**memory.ram, (register, port): values}
    return all(_load(ram, p) <= int(ram[5, p][0]) / BITS_PER_BYTE for p in ports)


def _load(ram: dict[tuple[int, int], Values], port: int) -> float:
    """Bytes per second that registers 6, 7 and 75 to 77 ask of a port."""
    ador, adof = int(ram[6, port][0]), int(ram[7, port][0])
    load = float(LINE_BYTES[ador] * adof) if ador else 0.0
    for output in BINARY_OUTPUTS:
        values = ram[output, 0]
        layout = _layout(values)
        if layout is not None and _routed(values, port):
            load += layout.size * TICK_HZ / int(values[1])
    return load


# -- Answers to commands ---------------------------------------------------------------------------


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
