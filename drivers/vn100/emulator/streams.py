"""Which messages the emulated VN-100 sends by itself, how often, and whether they fit the line.

Registers 6 and 7 choose the ASCII message of a port, registers 75 to 77 the binary ones. A write
that would ask for more than the port's baud rate carries is refused (vn100-protocol 1.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.vn100.binary import BinaryLayout, binary_layout, encode_packet
from drivers.vn100.emulator.memory import PER_PORT, PORTS, Memory
from drivers.vn100.emulator.output import quantities_of
from drivers.vn100.emulator.physics import TICK_HZ
from drivers.vn100.emulator.sensor import Sensor
from drivers.vn100.emulator.wire import BITS_PER_BYTE
from drivers.vn100.register_codec import Values
from drivers.vn100.sentences import MESSAGES, Message, encode_sentence

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
