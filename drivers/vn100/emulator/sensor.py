"""Feeds the world's blocks through the compensation chain as time goes on, and hands out readings.

What an output shows is computed for a whole block at a time and kept until a register changes.

What can be put into a message is a table, quantity by quantity. A quantity has a row per tick of
the block. The gyro's value is the mean over the output's own step (`step_ticks`), as are the
increments of angle and velocity. Sources: vn100-protocol 1.3, 2, 4.2, 6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from drivers.vn100.emulator.chain import SAMPLE_TICKS, FilterState, OnBoardHsi, SensorOutputs
from drivers.vn100.emulator.memory import Memory
from drivers.vn100.emulator.physics import BLOCK_TICKS, HISTORY_TICKS, TICK_HZ, Array, EmulatedWorld
from drivers.vn100.messages import MESSAGES, Columns

# -- Quantities of a message -----------------------------------------------------------------------


KNOWN_MAGNETIC, KNOWN_ACCELERATION = 0x0800, 0x1000  # VpeStatus, after VNKMD and VNKAD
GYRO_FULL, MAG_FULL = 0x0004, 0x0040

# Registers that hold what an asynchronous message carries.
MEASURED: dict[int, Columns] = {
    row.register: row.columns for row in MESSAGES.values() if row.register
}


@dataclass(frozen=True, slots=True)
class EmulatedClock:
    """TimeStartup: runs from `boot_tick`, `ppm` fast, with resolution of a microsecond."""

    boot_tick: int
    ppm: float
    step_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Switches:
    """What else shows in messages.

    vpe_status:       the bits that commands set;  sync_out_ticks: from one SyncOut pulse to the
    next, 0 if none;  delta_frame, gyro_bias_out, gravity_out: register 82
    """

    vpe_status: int = 0
    sync_out_ticks: int = 0
    delta_ned: bool = False
    delta_without_bias: bool = False
    delta_without_gravity: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class OutputReadings:
    """One block as an output with a step of `step_ticks` sees it."""

    outputs: SensorOutputs
    clock: EmulatedClock
    switches: Switches
    step_ticks: int

    def column(self, name: str) -> Array:
        """One quantity, (BLOCK, n). Raises KeyError for a name that is not in `QUANTITIES`."""
        values = QUANTITIES[name](self)
        return values[:, None] if values.ndim == 1 else values

    @property
    def ticks(self) -> Array:
        """Ticks since the device started, (BLOCK,)."""
        first = self.outputs.block.first_tick - self.clock.boot_tick
        return np.arange(first, first + BLOCK_TICKS, dtype=np.float64)


def _time_startup(of: OutputReadings) -> Array:
    seconds = of.ticks / TICK_HZ * (1 + of.clock.ppm * 1e-6) + of.clock.step_s
    stamps = np.round(seconds + of.outputs.block.jitter_s, 6)
    return np.asarray(np.maximum(stamps, 0.0))  # jitter must not put the first one before zero


def _delta_theta(of: OutputReadings) -> Array:
    outputs = of.outputs
    wanted = of.switches.delta_without_bias
    rates = (outputs.compensated_rates if wanted else outputs.rates)(of.step_ticks)
    return _delta(of, rates)


def _delta_velocity(of: OutputReadings) -> Array:
    name = "linear_accel_body" if of.switches.delta_without_gravity else "accel"
    return _delta(of, of.outputs.quantity(name))


def _delta(of: OutputReadings, per_second: Array) -> Array:
    if of.switches.delta_ned:
        per_second = np.einsum("kij,kj->ki", of.outputs.R_nu, per_second)
    return np.asarray(per_second * (of.step_ticks / TICK_HZ))


def _vpe_status(of: OutputReadings) -> Array:
    full = of.outputs.saturation().astype(np.int64)
    bits = np.where(full & 0x1C0, GYRO_FULL, 0) | np.where(full & 0x007, MAG_FULL, 0)
    return np.asarray(bits | of.switches.vpe_status, dtype=np.float64)


def _sync_out_count(of: OutputReadings) -> Array:
    every = of.switches.sync_out_ticks
    return np.floor_divide(of.ticks, every) if every else _zeros(1)(of)


def _zeros(columns: int) -> Callable[[OutputReadings], Array]:
    return lambda _: np.zeros((BLOCK_TICKS, columns))


def _plain(name: str) -> Callable[[OutputReadings], Array]:
    return lambda of: of.outputs.quantity(name)


def _raw(of: OutputReadings) -> Array:
    """What firmware 2 puts into Imu.Raw is not known; here the uncompensated values."""
    names = ("uncomp_mag_x_gauss", "uncomp_accel_x_m_s2", "uncomp_gyro_x_rad_s", "temperature_c")
    return np.hstack([of.column(name) for name in names])


def _dcm(of: OutputReadings) -> Array:
    return of.outputs.R_nu.reshape(BLOCK_TICKS, 9)  # row by row, as recordings show


# By the name of the quantity's first column (`messages`); SI, angles in rad.
QUANTITIES: dict[str, Callable[[OutputReadings], Array]] = {
    "time_startup_s": _time_startup,
    "time_sync_in_s": _time_startup,  # no SyncIn event ever came: since the start
    "sync_in_count": _zeros(1),
    "sync_out_count": _sync_out_count,
    "yaw_rad": _plain("ypr"),
    "quat_x": lambda of: of.outputs.q_nu,
    "dcm_00": _dcm,
    "yaw_sigma_rad": _zeros(3),  # zeros in recordings of the real device
    "uncomp_mag_x_gauss": _plain("uncomp_mag"),
    "uncomp_accel_x_m_s2": _plain("uncomp_accel"),
    "uncomp_gyro_x_rad_s": lambda of: of.outputs.rates(of.step_ticks),
    "mag_x_gauss": _plain("mag"),
    "accel_x_m_s2": _plain("accel"),
    "gyro_x_rad_s": lambda of: of.outputs.compensated_rates(of.step_ticks),
    "mag_n_n_gauss": _plain("mag_ned"),
    "accel_n_n_m_s2": _plain("accel_ned"),
    "linear_accel_b_x_m_s2": _plain("linear_accel_body"),
    "linear_accel_n_n_m_s2": _plain("linear_accel_ned"),
    "temperature_c": lambda of: of.outputs.block.temperature_c,
    "pressure_kpa": lambda of: of.outputs.block.pressure_kpa,
    "delta_time_s": lambda of: np.full(BLOCK_TICKS, of.step_ticks / TICK_HZ),
    "delta_theta_x_rad": _delta_theta,
    "delta_velocity_x_m_s": _delta_velocity,
    "vpe_status": _vpe_status,
    "imu_status": _zeros(1),
    "sens_sat": lambda of: of.outputs.saturation(),
    "heave_m": _zeros(3),  # the emulated vehicle does not heave
    "imu_raw_0": _raw,
}


@cache
def quantities_of(columns: Columns) -> tuple[str, ...]:
    """The quantities that fill a message's columns, in their order."""
    return tuple(column.name for column in columns if column.name in QUANTITIES)


# -- The sensor ------------------------------------------------------------------------------------


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
