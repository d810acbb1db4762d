"""What happens to the emulated device once, at its time: power, plugs and other people.

Some faults strike at the instant of their schedule, some are armed then and strike when the host
does something: power that fails after the n-th write, or in the middle of a save.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Protocol

from drivers.vn100.emulator.faults import Fault
from drivers.vn100.emulator.memory import Memory
from drivers.vn100.emulator.physics import TICK_HZ
from drivers.vn100.emulator.sensor import Sensor
from drivers.vn100.register_codec import Values
from drivers.vn100.registers import REGISTERS, format_reply


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
