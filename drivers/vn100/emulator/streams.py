"""Which messages the emulated VN-100 sends by itself, how often, and whether they fit the line.

Registers 6 and 7 choose the ASCII message of a port, registers 75 to 77 the binary ones. A write
that would ask for more than the port's baud rate carries is refused (vn100-protocol 1.5).

The transmitter (`Wire`) sends whole messages at the pace of the baud rate. Up to `QUEUE_BYTES`
wait; a message that does not fit is dropped, and as soon as there is room error 0B says so
(vn100-protocol 3.1). A message reaches the host when its last byte has left.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers.vn100.emulator.faults import FaultPlan
from drivers.vn100.emulator.memory import PER_PORT, PORTS, Memory
from drivers.vn100.emulator.physics import TICK_HZ
from drivers.vn100.emulator.sensor import Sensor, quantities_of
from drivers.vn100.messages import (
    MESSAGES,
    BinaryLayout,
    Message,
    binary_layout,
    encode_packet,
    encode_sentence,
)
from drivers.vn100.register_codec import Values

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
