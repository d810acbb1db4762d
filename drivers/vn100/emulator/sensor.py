"""Feeds the world's blocks through the compensation chain as time goes on, and hands out readings.

What an output shows is computed for a whole block at a time and kept until a register changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drivers.vn100.emulator.chain import FilterState, SensorOutputs
from drivers.vn100.emulator.hsi import SAMPLE_TICKS, OnBoardHsi
from drivers.vn100.emulator.memory import Memory
from drivers.vn100.emulator.motion import Array
from drivers.vn100.emulator.output import EmulatedClock, OutputReadings, Switches
from drivers.vn100.emulator.physics import BLOCK_TICKS, HISTORY_TICKS, TICK_HZ, EmulatedWorld

Row = list[float]
_TIMES = ("time_startup_s", "time_sync_in_s", "delta_time_s")


class Sensor:
    """The measuring half of the device.

    known_disturbance: bits of VpeStatus that VNKMD and VNKAD set; the first of them also stops the
    on-board HSI and the correction of the heading
    stuck: all readings but time repeat the last values
    """

    def __init__(self, world: EmulatedWorld, memory: Memory) -> None:
        self.memory = memory
        self.hsi = OnBoardHsi()
        self.clock = EmulatedClock(0, world.truth.clock_ppm)
        self.known_disturbance = 0
        self.stuck = False
        self._world = world
        self._block = world.next_block()
        self._filter = FilterState(memory.startup_bias())
        self._outputs: SensorOutputs | None = None
        self._tare: Array | None = None
        self._columns: dict[tuple[str, int], list[Row]] = {}
        self._last: dict[str, Row] = {}

    @property
    def block_end_tick(self) -> int:
        """The first tick behind the present block."""
        return self._block.first_tick + BLOCK_TICKS

    def next_block(self) -> None:
        """Time has reached `block_end_tick`: let filter and HSI see the block, take the next."""
        outputs = self._present()
        self._filter = outputs.end_state()
        mode, _, rate = (int(value) for value in self.memory.get(44))
        if mode == 1 and not self._magnetic_disturbance:
            samples = outputs.uncompensated_field()[::SAMPLE_TICKS]
            self.hsi.add(samples, rate, SAMPLE_TICKS / TICK_HZ)
        self._block = self._world.next_block()
        self.changed()

    def changed(self) -> None:
        """A register, a switch or the on-board HSI is different now."""
        self._outputs = None
        self._columns.clear()

    def start(self, tick: int) -> None:
        """The device starts at `tick`: its filter begins anew."""
        self.clock = EmulatedClock(tick, self.clock.ppm)
        self.hsi.reset()
        self.known_disturbance = 0
        self._tare = None
        self._filter = FilterState(self.memory.startup_bias())
        self.changed()

    def tare(self, tick: int) -> None:
        """The attitude at `tick` counts as zero until the next start (VNTAR)."""
        self._tare = None
        self.changed()
        self._tare = np.array(self.row(("quat_x",), tick, 1))
        self.changed()

    def set_heading(self, tick: int, heading_rad: float) -> None:
        """The heading at `tick` becomes this one, about the vertical, until the next start."""
        self._tare = None
        self.changed()
        half = (self.row(("yaw_rad",), tick, 1)[0] - heading_rad) / 2
        self._tare = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
        self.changed()

    def row(self, names: Sequence[str], tick: int, step_ticks: int) -> Row:
        """The named quantities at `tick` (of the present block) for an output of that step."""
        offset = min(max(tick - self._block.first_tick, 0), BLOCK_TICKS - 1)
        row: Row = []
        for name in names:
            repeated = self.stuck and name in self._last and name not in _TIMES
            if not repeated:
                self._last[name] = self._column(name, step_ticks)[offset]
            row += self._last[name]
        return row

    def filter_bias(self) -> tuple[float, float, float]:
        """The filter's gyro bias, rad/s, at the start of the block."""
        x, y, z = self._filter.gyro_bias_rad_s.tolist()
        return x, y, z

    @property
    def _magnetic_disturbance(self) -> bool:
        return bool(self.known_disturbance & 0x0800)

    def _present(self) -> SensorOutputs:
        if self._outputs is None:
            settings = self.memory.settings(self.hsi, self._magnetic_disturbance)
            settings = replace(settings, tare=self._tare)
            self._outputs = SensorOutputs(self._block, settings, self._filter)
        return self._outputs

    def _column(self, name: str, step_ticks: int) -> list[Row]:
        key = name, step_ticks
        if key not in self._columns:
            step = max(1, min(step_ticks, HISTORY_TICKS))
            readings = OutputReadings(self._present(), self.clock, self._switches(), step)
            self._columns[key] = readings.column(name).tolist()
        return self._columns[key]

    def _switches(self) -> Switches:
        frame, gyro, accel = (int(value) for value in self.memory.get(82)[:3])
        sync = [int(value) for value in self.memory.get(32)]
        every = {1: 1, 2: 1, 3: 2}.get(sync[4], 0) * (sync[6] + 1)
        return Switches(
            vpe_status=self.known_disturbance,
            sync_out_ticks=every,
            delta_ned=frame == 1,
            delta_without_bias=gyro == 1,
            delta_without_gravity=accel in (1, 3),
        )
