"""An emulated VN-100: bytes and time in, bytes out. No port, no clock, no thread.

    device = Emulator(truth, motion, seed=1, faults=["byte_drop=0.001@30+5"])
    device.receive(b"$VNRRG,23*72\r\n", now_s=1.0)
    wire = device.advance(now_s=1.1)      # everything that reached the host by then

Time is the emulator's own, in seconds from 0; both methods must be called in order of time. Between
calls four things happen, strictly in order of time: blocks of sensor values end, scheduled actions
(a save that completes, a fault) take place, commands that were received are carried out 1 to 5 ms
later, and output falls due on the 800 Hz grid: binary 1, 2, 3 and then the ASCII message. Whatever
is sent goes through the transmitter, whole messages one after the other at the pace of the baud
rate. Two emulators with equal arguments give equal bytes, however the calls are spaced.

Behaviour: vn100-protocol section 10. What is this emulator's own choice: after power-up or a reset
it is deaf and silent for `BOOT_S`; `VNWNV` does not interrupt the output.

Some faults strike at the instant of their schedule: power, plugs, other people. Some are armed then
and strike when the host does something: power that fails after the n-th write, or in the middle of
a save.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from drivers.vn100.deframer import Cause, Deframer, Sentence
from drivers.vn100.emulator.faults import Fault, FaultPlan
from drivers.vn100.emulator.memory import Memory
from drivers.vn100.emulator.physics import TICK_HZ, EmulatedTruth, EmulatedWorld, Further, Motion
from drivers.vn100.emulator.sensor import Sensor
from drivers.vn100.emulator.streams import (
    CommandReply,
    Interpreter,
    OutputStream,
    SideEffect,
    Transmitter,
    streams,
)
from drivers.vn100.messages import encode
from drivers.vn100.register_codec import RegisterValueError, Values
from drivers.vn100.registers import REGISTERS, format_reply

# -- What happens to it once -----------------------------------------------------------------------


class EventTarget(Protocol):
    """What events need of the emulator."""

    memory: Memory
    sensor: Sensor
    serial: int

    def at(self, when_s: float, what: Callable[[float], None], *, any_life: bool = False) -> None:
        """Do something later."""

    def restart(self, now_s: float) -> None:
        """Power comes back."""

    def lose_power(self, now_s: float) -> None:
        """Power goes."""

    def plug(self, connected: bool, now_s: float) -> None:
        """The host's port comes or goes."""

    @property
    def powered(self) -> bool:
        """Whether it has power."""

    def replace_unit(self, serial: int) -> None:
        """Another unit."""

    def log(self, line: str) -> None:
        """Tell."""

    def send_foreign(self, body: str, now_s: float) -> None:
        """A reply to somebody else."""


class Events:
    """The faults of a schedule that strike once."""

    def __init__(self, device: EventTarget, faults: Iterable[Fault]) -> None:
        self._device = device
        self._armed: list[Fault] = []
        self._writes_left = 0
        strike: dict[str, Callable[[Fault, float], None]] = {
            "reset": self._reset,
            "unplug": self._unplug,
            "replug_other_serial": self._unplug,
            "power_cut": self._power_cut,
            "power_cut_wrg": self._arm,
            "power_cut_wnv": self._arm,
            "torn_flash": self._arm,
            "third_party_write": self._third_party,
            "third_party_change": self._third_party,
            "clock_step": self._clock_step,
            "clock_wrap": self._clock_wrap,
        }
        for fault in faults:
            what = strike.get(fault.name)
            if what is not None:  # the others act on the field, by themselves
                device.at(fault.start_s, partial(self._strike, what, fault), any_life=True)
            if fault.name.startswith("third_party"):
                nudged(device.memory, int(fault.parameter))  # refuse a bad number now

    def written(self, now_s: float) -> None:
        """The host has written a register."""
        for fault in self._armed:
            if fault.name == "power_cut_wrg":
                self._writes_left -= 1
                if self._writes_left <= 0:
                    self._armed.remove(fault)
                    self._power_cut(fault, now_s)
                return

    def save_begins(self, now_s: float, takes_s: float) -> bool:
        """The host has sent VNWNV; true where it will not end."""
        for fault in self._armed:
            if fault.name in ("power_cut_wnv", "torn_flash"):
                self._armed.remove(fault)
                self._device.at(now_s + takes_s / 2, partial(self._fail_in_save, fault))
                return True
        return False

    def _strike(self, what: Callable[[Fault, float], None], fault: Fault, now_s: float) -> None:
        self._device.log(f"fault {fault.name}")
        what(fault, now_s)

    def _arm(self, fault: Fault, _: float) -> None:
        self._armed.append(fault)
        self._writes_left = int(fault.parameter)

    def _fail_in_save(self, fault: Fault, now_s: float) -> None:
        if fault.name == "torn_flash":
            self._device.memory.save_torn()
        self._power_cut(fault, now_s)

    def _reset(self, _: Fault, now_s: float) -> None:
        self._device.lose_power(now_s)
        self._device.restart(now_s)

    def _power_cut(self, fault: Fault, now_s: float) -> None:
        self._device.lose_power(now_s)
        self._device.at(now_s + fault.duration_s, self._device.restart)

    def _unplug(self, fault: Fault, now_s: float) -> None:
        self._device.plug(False, now_s)
        if fault.parameter or fault.name == "replug_other_serial":
            self._device.lose_power(now_s)
        self._device.at(now_s + fault.duration_s, partial(self._replug, fault), any_life=True)

    def _replug(self, fault: Fault, now_s: float) -> None:
        self._device.plug(True, now_s)
        if fault.name == "replug_other_serial":
            self._device.lose_power(now_s)  # another fault may have started the unit that goes
            self._device.replace_unit(self._device.serial + 1)
        if not self._device.powered:
            self._device.restart(now_s)

    def _third_party(self, fault: Fault, now_s: float) -> None:
        device, register = self._device, int(fault.parameter)
        values = nudged(device.memory, register)
        device.memory.ram[register, 0] = values
        device.sensor.changed()
        if fault.name == "third_party_write":
            device.send_foreign(f"VNWRG,{format_reply(register, values)}", now_s)

    def _clock_step(self, fault: Fault, _: float) -> None:
        sensor = self._device.sensor
        sensor.clock = replace(sensor.clock, step_s=sensor.clock.step_s + fault.parameter)
        sensor.changed()

    def _clock_wrap(self, _: Fault, now_s: float) -> None:
        sensor = self._device.sensor
        clock = sensor.clock
        age_s = (now_s - clock.boot_tick / TICK_HZ) * (1.0 + clock.ppm * 1e-6)
        sensor.clock = replace(clock, step_s=-age_s)
        sensor.changed()


def nudged(memory: Memory, register: int) -> Values:
    """A register's values as somebody else could have written them.

    The last number 0.01 higher, or the on-board HSI switched on. Raises ValueError for a register
    that does not end in an f32.
    """
    row = REGISTERS.get(register)
    values = memory.ram.get((register, 0), ())
    if register == 44:
        return (1, 3, 5)
    if row is None or row.access == "R" or not values or row.fields[-1].kind != "f32":
        raise ValueError(f"nobody else writes register {register}; try 23, 25, 84 or 44")
    return memory.stored(register, (*values[:-1], float(values[-1]) + 0.01))


# -- The device ------------------------------------------------------------------------------------


BOOT_S = 0.5
SAVE_S = 0.5
REPLY_DELAY_S = (0.001, 0.005)
COLLISION_BYTES = 100
NEVER = 1 << 60

BUFFER_OVERFLOW, INVALID_CHECKSUM, OUTPUT_OVERFLOW = 0x02, 0x03, 0x0B


class Emulator:
    """One emulated device with one of its two ports connected.

    truth, motion: what it senses;  firmware: as register 4 says it;  serial: register 3
    faults:  schedules as `faults.parse_fault` takes them
    port:    the serial port that the host is connected to, 1 or 2
    presets: register values that were saved long ago;  further: physics that the caller adds
    plugged: false while the host's port does not exist;  counters: what happened how often
    """

    def __init__(
        self,
        truth: EmulatedTruth,
        motion: Motion,
        firmware: str = "3.1.0.0",
        seed: int = 0,
        *,
        serial: int = 100130608,
        faults: Sequence[str] = (),
        port: int = 1,
        presets: Mapping[int, Sequence[float | int | str]] | None = None,
        further: Further | None = None,
    ) -> None:
        self.truth = truth
        self.serial = serial
        self.plugged = True
        self.counters = {"messages": 0, "commands": 0, "refused": 0, "restarts": 0, "saves": 0}
        self._firmware, self._port = firmware, port
        self._presets = dict(presets or {})
        self._plan = FaultPlan(faults, seed)
        self._world = EmulatedWorld(truth, motion, seed, self._plan.disturbances(), further)
        self._delays = np.random.default_rng([seed, 5])
        self._make_unit(serial)
        self._wire = Transmitter(self._plan, self.memory.number(5, port), self._overflowed)
        self._actions: list[tuple[float, int, Callable[[float], None]]] = []
        self._numbers = 0  # orders actions of the same instant
        self._life = 0  # grows with every start; actions of an earlier life are void
        self._commands: deque[tuple[float, str, int]] = deque()  # when, body, error code
        self._ready_s = 0.0  # the processor is busy until then
        self._deframer = Deframer(host_side=True)
        self._log: list[str] = []
        self._awake_s = 0.0  # listens and sends from then on; infinity without power
        self._boot_tick = 0
        self._streams: list[OutputStream] = []
        self._due_tick = NEVER
        self._output_changed(-1)
        self._events = Events(self, self._plan.events)

    def _make_unit(self, serial: int) -> None:
        self.memory = Memory(self._firmware, serial)
        for register, values in self._presets.items():
            self.memory.preset(register, values)
        self.sensor = Sensor(self._world, self.memory)
        self._interpreter = Interpreter(self.memory, self.sensor, self._world, self._port)

    @property
    def baud(self) -> int:
        """The rate at which the connected port sends and receives now."""
        return self._wire.baud

    @property
    def overflows(self) -> int:
        """Messages that were dropped because the queue was full."""
        return self._wire.overflows

    def take_log(self) -> list[str]:
        """What happened since the last call, a line each."""
        lines, self._log = self._log, []
        return lines

    def advance(self, now_s: float) -> bytes:
        """Everything that reached the host since the last call, whole messages, in order."""
        return b"".join(message for _, message in self.deliver(now_s))

    def deliver(self, now_s: float) -> list[tuple[int, bytes]]:
        """As `advance`, message by message, each with the baud rate at which it was sent."""
        self._run(now_s)
        return self._wire.collect(now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """The host's bytes, as they arrive at `now_s`."""
        self._run(now_s)
        if not self.plugged or now_s < self._awake_s:
            return
        found: list[tuple[int, str, int]] = [
            (sentence.offset, sentence.body, 0)
            for sentence in self._deframer.feed(self._plan.distort_command(data, now_s))
            if isinstance(sentence, Sentence)
        ]
        for skipped in self._deframer.take_skipped():
            if skipped.cause in _ERRORS:
                found.append((skipped.offset, "", _ERRORS[skipped.cause]))
        for _, body, error in sorted(found):
            delay_s = float(self._delays.uniform(*REPLY_DELAY_S))
            self._commands.append((now_s + delay_s, body, error))

    # ── the order of events ──────────────────────────────────────────────────────────────────────

    def _run(self, now_s: float) -> None:
        while True:
            block_s = self.sensor.block_end_tick / TICK_HZ
            action_s = self._actions[0][0] if self._actions else math.inf
            command_s = max(self._commands[0][0], self._ready_s) if self._commands else math.inf
            next_s = min(block_s, action_s, command_s, self._due_tick / TICK_HZ)
            if next_s > now_s:
                return
            if next_s == block_s:
                self.sensor.next_block()
            elif next_s == action_s:
                heapq.heappop(self._actions)[2](next_s)
            elif next_s == command_s:
                _, body, error = self._commands.popleft()
                self._carry_out(body, error, next_s)
            else:
                self._emit(self._due_tick)

    def _emit(self, tick: int) -> None:
        now_s = tick / TICK_HZ
        self._look_stuck(now_s)
        for stream in self._streams:
            if (tick - self._boot_tick) % stream.step_ticks == 0:
                self.counters["messages"] += 1
                self._wire.send(stream.message(tick), now_s)
        self._due_tick = self._next_due(tick)

    def _next_due(self, tick: int) -> int:
        """The first tick behind `tick` at which a stream has something to send."""
        if not self._streams:
            return NEVER
        since = max(tick, math.ceil(self._awake_s * TICK_HZ) - 1) - self._boot_tick
        steps = [stream.step_ticks for stream in self._streams]
        return self._boot_tick + min((since // step + 1) * step for step in steps)

    def _output_changed(self, tick: int) -> None:
        gate = self._interpreter.streaming and self._awake_s < math.inf
        self._streams = streams(self.memory, self.sensor, self._port) if gate else []
        self._due_tick = self._next_due(tick)

    def _look_stuck(self, now_s: float) -> None:
        self.sensor.stuck = self._plan.active("stuck", now_s) is not None

    # ── commands ─────────────────────────────────────────────────────────────────────────────────

    def _carry_out(self, body: str, error: int, now_s: float) -> None:
        self.counters["commands"] += 1
        self._look_stuck(now_s)
        write = body.startswith("VNWRG")
        try:
            if error:
                raise RegisterValueError("the line was damaged", error)
            if refusal := self._plan.active("refused_command", now_s):
                raise RegisterValueError("refused by fault", int(refusal.parameter))
            if write:
                self._refuse_by_fault(body, now_s)
            kept = dict(self.memory.ram)
            answer = self._interpreter.answer(body, int(now_s * TICK_HZ + 1e-6))
        except RegisterValueError as refused:
            self.counters["refused"] += 1
            self._wire.send(self._error(refused.code), now_s)
            return
        if write and self._ignores(body, now_s):
            self.memory.ram = kept
            self.sensor.changed()
        self._follow(answer, now_s)
        if write:
            self._events.written(now_s)

    def _refuse_by_fault(self, body: str, now_s: float) -> None:
        refusal = self._plan.active("refused_write", now_s)
        if refusal is not None:
            raise RegisterValueError("refused by fault", int(refusal.parameter))
        long = len(body) > COLLISION_BYTES and bool(self._streams)
        if long and self._plan.strikes("collision", now_s):
            raise RegisterValueError("a byte was lost", INVALID_CHECKSUM)

    def _ignores(self, body: str, now_s: float) -> bool:
        fault = self._plan.active("silent_refusal", now_s)
        return fault is not None and fault.parameter in (0, int(body.split(",")[1]))

    def _follow(self, answer: CommandReply, now_s: float) -> None:
        if answer.packet:
            self._reply(answer.body, now_s)
            self._wire.send(answer.packet, now_s)
            return
        if answer.effect is SideEffect.SAVE:
            self._ready_s = now_s + SAVE_S
            if not self._events.save_begins(now_s, SAVE_S):
                self.at(self._ready_s, self._saved)
            return
        self._reply(answer.body, now_s)
        if answer.effect is SideEffect.OUTPUT:
            self._output_changed(int(now_s * TICK_HZ + 1e-6))
        elif answer.effect is SideEffect.BAUD:
            self.at(self._wire.empty_at_s(now_s), self._switch_baud)
        elif answer.effect in (SideEffect.RESTART, SideEffect.FACTORY):
            if answer.effect is SideEffect.FACTORY:
                self.memory.restore_factory()
            self._fall_silent()
            self.at(self._wire.empty_at_s(now_s) + 1e-3, self.restart)

    def _saved(self, now_s: float) -> None:
        self.memory.save()
        self.counters["saves"] += 1
        self._reply("VNWNV", now_s)

    def _switch_baud(self, _: float) -> None:
        self._wire.baud = self.memory.number(5, self._port)
        self.log(f"baud rate {self._wire.baud}")

    def _reply(self, body: str, now_s: float) -> None:
        if self._plan.strikes("lost_reply", now_s):
            return
        if self._plan.strikes("wrong_reply", now_s):
            body = self._foreign(body)
        if self._plan.strikes("altered_reply", now_s):
            body = _altered(body)
        message = self._framed(body)
        late = self._plan.active("late_reply", now_s)
        if late is None:
            self._wire.send(message, now_s)
        else:
            self.at(now_s + late.parameter, lambda at_s: self._wire.send(message, at_s))

    def _foreign(self, body: str) -> str:
        """The reply to a read of another register."""
        register = 30 if body.split(",")[1:2] == ["21"] else 21
        return f"VNRRG,{format_reply(register, self.memory.get(register))}"

    def _framed(self, body: str) -> bytes:
        return encode(body, crc=self.memory.get(30)[4] == 3)

    def _error(self, code: int) -> bytes:
        """A VNERR line, as the error mode of register 30 wants it."""
        mode = self.memory.get(30)[6]
        if mode == 2:
            self.memory.ram[6, self._port] = (0,)
            self._output_changed(self._due_tick - 1)
        return self._framed(f"VNERR,{code:02X}") if mode else b""

    def _overflowed(self) -> bytes:
        return self._error(OUTPUT_OVERFLOW)

    # ── power, plugs and people ──────────────────────────────────────────────────────────────────

    def at(self, when_s: float, what: Callable[[float], None], *, any_life: bool = False) -> None:
        """Do `what` at `when_s`, unless the device has been restarted or cut off by then."""
        life = self._life

        def guarded(at_s: float) -> None:
            if any_life or life == self._life:
                what(at_s)

        self._numbers += 1
        heapq.heappush(self._actions, (when_s, self._numbers, guarded))

    def restart(self, now_s: float) -> None:
        """Power comes back: registers from flash, filters and TimeStartup from the beginning."""
        self._fall_silent()
        self._life += 1
        self._ready_s = 0.0
        self._awake_s = now_s + BOOT_S
        self._boot_tick = math.ceil(now_s * TICK_HZ)
        self.memory.start()
        self.sensor.start(self._boot_tick)
        self._interpreter.streaming = True
        self._wire.baud = self.memory.number(5, self._port)
        self._output_changed(self._boot_tick)
        self.counters["restarts"] += 1
        self.log("restart")

    def plug(self, connected: bool, now_s: float) -> None:
        """The host's port comes or goes."""
        self.plugged = self._wire.connected = connected
        if not connected:
            self._wire.cut(now_s)
            self._commands.clear()
            self._deframer = Deframer(host_side=True)

    def lose_power(self, now_s: float) -> None:
        """Silence until `restart`; what was under way is lost."""
        self._life += 1
        self._wire.cut(now_s)
        self._fall_silent()

    @property
    def streaming(self) -> bool:
        """Whether the host lets asynchronous output through."""
        return self._interpreter.streaming

    @property
    def powered(self) -> bool:
        """Whether the device runs or is about to."""
        return self._awake_s < math.inf

    def replace_unit(self, serial: int) -> None:
        """Another unit in factory state is connected; it still has to `restart`."""
        self.serial = serial
        self._presets.clear()
        self._make_unit(serial)

    def log(self, line: str) -> None:
        """Tell what happened."""
        self._log.append(line)

    def send_foreign(self, body: str, now_s: float) -> None:
        """Send the reply to somebody else's command."""
        self._wire.send(self._framed(body), now_s)

    def _fall_silent(self) -> None:
        """No output and no ear."""
        self._awake_s = math.inf
        self._commands.clear()
        self._deframer = Deframer(host_side=True)
        self._output_changed(0)


_ERRORS = {Cause.CHECKSUM: INVALID_CHECKSUM, Cause.TOO_LONG: BUFFER_OVERFLOW}


def _altered(body: str) -> str:
    """The same reply with its last digit changed; unchanged where it has no values."""
    head, comma, values = body.partition(",")
    number, second, values = values.partition(",")
    digits = [index for index, character in enumerate(values) if character.isdigit()]
    if not digits:
        return body
    last = digits[-1]
    changed = f"{values[:last]}{(int(values[last]) + 1) % 10}{values[last + 1 :]}"
    return f"{head}{comma}{number}{second}{changed}"
