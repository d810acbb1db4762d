"""What the emulated VN-100 can put into a message, quantity by quantity.

A quantity has a row per tick of the block. The gyro's value is the mean over the output's own step
(`step_ticks`), as are the increments of angle and velocity. Sources: vn100-protocol 1.3, 2, 4.2, 6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from drivers.vn100.emulator.chain import SensorOutputs
from drivers.vn100.emulator.motion import Array
from drivers.vn100.emulator.physics import BLOCK_TICKS, TICK_HZ
from drivers.vn100.fields import Columns
from drivers.vn100.sentences import MESSAGES

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


# By the name of the quantity's first column (`fields`); SI, angles in rad.
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
