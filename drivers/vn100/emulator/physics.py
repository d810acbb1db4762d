"""The world that the emulated VN-100 senses, and its sensors up to the factory calibration.

    field           m = clip(A (R_nb' f_n + dipole) + b + noise)   A soft iron, b hard iron, gauss
    rate            w = w_true + w_b + noise                       w_true: mean of the output step
    specific force  a = -R_nb' g_n + noise                         the vehicle does not accelerate

on a grid of 800 Hz (the device's internal rate), in blocks. The magnetometer value of a tick is the
field at that tick; the rate is the mean over the step that ends there, so it depends on the length
of the step and `SensorBlock.rates` is asked for it. All noise comes from one generator in a fixed
order: two worlds with the same seed are equal bit for bit, however they are asked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from drivers.vn100.emulator.motion import (
    Array,
    Motion,
    conjugate,
    matrices,
    product,
    quaternions,
    rotation_vector,
)

TICK_HZ = 800
BLOCK_TICKS = 200
HISTORY_TICKS = 800  # how far a step or a boxcar may reach back from a block's first tick
GRAVITY_M_S2 = 9.79375  # the device's default gravity reference, register 21
MAG_RANGE_GAUSS = 2.5
GYRO_RANGE_RAD_S = math.radians(2000)


def _vector(*values: float) -> Array:
    return np.array(values, dtype=np.float64)


def field_from(magnitude_gauss: float, inclination_deg: float, declination_deg: float = 0) -> Array:
    """The field in north, east, down (3,) of a place, in gauss."""
    dip, turn = math.radians(inclination_deg), math.radians(declination_deg)
    level = magnitude_gauss * math.cos(dip)
    down = magnitude_gauss * math.sin(dip)
    return _vector(level * math.cos(turn), level * math.sin(turn), down)


@dataclass(frozen=True, slots=True, eq=False)
class EmulatedTruth:
    """What is hidden in the emulated device and its vehicle.

    soft_iron:        A (3, 3), any matrix with a positive determinant
    hard_iron_gauss:  b (3,)
    gyro_bias_rad_s:  w_b (3,) at the start; it walks with `gyro_walk_rad_s_rts` (rad/s/sqrt(s))
    field_n_gauss:    the earth's field in north, east, down (3,)
    noise_*:          standard deviation per sample (vn100-protocol 6.4, measured at rest)
    temperature_c:    at the start; it rises by `warming_c` with a time constant of ten minutes
    clock_ppm:        how much faster than true time the device's clock runs
    clock_jitter_s:   standard deviation of a time stamp
    """

    soft_iron: Array = field(default_factory=lambda: np.eye(3))
    hard_iron_gauss: Array = field(default_factory=lambda: np.zeros(3))
    gyro_bias_rad_s: Array = field(default_factory=lambda: np.zeros(3))
    gyro_walk_rad_s_rts: float = 0.0
    field_n_gauss: Array = field(default_factory=lambda: field_from(0.49, 60.0))
    noise_mag_gauss: float = 2e-3
    noise_gyro_rad_s: float = 8e-4
    noise_accel_m_s2: float = 0.015
    temperature_c: float = 25.0
    warming_c: float = 8.0
    pressure_kpa: float = 101.325
    clock_ppm: float = 15.0
    clock_jitter_s: float = 2e-6

    def __post_init__(self) -> None:
        for name in ("soft_iron", "hard_iron_gauss", "gyro_bias_rad_s", "field_n_gauss"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def heading_error_deg(self, matrix: Array, offset: Array, headings: int = 72) -> float:
        """Worst heading error over all headings, level, after the correction C (m - B).

        matrix: C (3, 3); offset: B (3,) in gauss. In degrees; noise and dipoles left out.
        """
        true = np.linspace(-math.pi, math.pi, headings, endpoint=False)
        angles = np.column_stack((np.zeros((headings, 2)), true))
        h_b = np.einsum("kji,j->ki", matrices(quaternions(angles)), self.field_n_gauss)
        seen = (h_b @ self.soft_iron.T + self.hard_iron_gauss - offset) @ matrix.T
        declination = math.atan2(self.field_n_gauss[1], self.field_n_gauss[0])
        error = np.arctan2(-seen[:, 1], seen[:, 0]) + declination - true
        return float(
            np.degrees(np.max(np.abs(np.remainder(error + math.pi, 2 * math.pi) - math.pi)))
        )


def draw_truth(seed: int) -> EmulatedTruth:
    """A hidden calibration as a small vehicle has it: uncalibrated heading 12 to 50 degrees off.

    Symmetric positive definite soft iron with det 1, hard iron of 0.08 to 0.2 gauss, gyro bias of
    up to 6 mrad/s per axis, drawn by `seed`.
    """
    draw = np.random.default_rng([seed, 2])
    while True:
        root = np.eye(3) + draw.uniform(-0.08, 0.08, (3, 3))
        soft = root @ root.T
        direction = draw.standard_normal(3)
        hard = draw.uniform(0.08, 0.2) * direction / np.linalg.norm(direction)
        truth = EmulatedTruth(
            soft_iron=soft / np.linalg.det(soft) ** (1 / 3),
            hard_iron_gauss=hard,
            gyro_bias_rad_s=draw.uniform(-6e-3, 6e-3, 3),
            clock_ppm=float(draw.uniform(-20, 20)),
        )
        if 12.0 < truth.heading_error_deg(np.eye(3), np.zeros(3)) < 50.0:
            return truth


@dataclass(frozen=True, slots=True)
class Dipole:
    """A magnet carried past the sensor: `moment_a_m2` along z, at 0.3 m when it is nearest."""

    start_s: float
    duration_s: float
    moment_a_m2: float

    def field_b_gauss(self, time_s: Array) -> Array:
        """Its field in the sensor frame (N, 3), by 1e-3 (3 r (m.r) / r^5 - m / r^3)."""
        part = (time_s - self.start_s) / self.duration_s
        present = (part >= 0) & (part < 1)
        r = np.tile(_vector(0.0, 0.25, 0.166), (len(time_s), 1))
        r[:, 0] = 4.0 * part - 2.0  # from 2 m behind to 2 m in front
        distance = np.linalg.norm(r, axis=1, keepdims=True)
        moment = _vector(0.0, 0.0, self.moment_a_m2)
        dipole = 3 * r * (r @ moment)[:, None] / distance**5 - moment / distance**3
        return np.asarray(np.where(present[:, None], 1e-3 * dipole, 0.0))


@dataclass(frozen=True, slots=True)
class IronStep:
    """The vehicle picks up iron at an instant, along x and, half as much, against y."""

    start_s: float
    gauss: float

    def offset_b_gauss(self, time_s: Array) -> Array:
        """What it adds to the hard iron (N, 3)."""
        step = _vector(self.gauss, -self.gauss / 2, 0.0)
        return np.where((time_s >= self.start_s)[:, None], step, 0.0)


Disturbance = Dipole | IronStep


class Further(Protocol):
    """Physics that the host's program adds: a function of time alone, the same however asked."""

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """What adds to the field (gauss) and to the rate (rad/s), (N, 3) each, at (N,) instants."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SensorBlock:
    """`BLOCK_TICKS` ticks of sensor values behind the factory calibration, sensor frame.

    first_tick: number of the block's first tick since the emulator began; tick k is at k / 800 s
    q_nb:       attitude, (HISTORY + BLOCK, 4); row HISTORY is the first tick
    mag_gauss:  (HISTORY + BLOCK, 3)
    gyro_extra_rad_s: bias and noise that add to the mean rate, (BLOCK, 3); bias_rad_s: bias alone
    accel_m_s2 (BLOCK, 3), temperature_c, pressure_kpa, jitter_s (BLOCK,)
    """

    first_tick: int
    q_nb: Array
    mag_gauss: Array
    gyro_extra_rad_s: Array
    bias_rad_s: Array
    accel_m_s2: Array
    temperature_c: Array
    pressure_kpa: Array
    jitter_s: Array

    def rates(self, step_ticks: int) -> Array:
        """Gyro readings (BLOCK, 3): mean rate over the last `step_ticks`, plus bias and noise."""
        return clip_rate(self.true_rates(step_ticks) + self.gyro_extra_rad_s)

    def true_rates(self, step_ticks: int) -> Array:
        """Mean true rate (BLOCK, 3) over the step of `step_ticks` (1 to 800) before each tick."""
        step = max(1, min(step_ticks, HISTORY_TICKS))
        before = self.q_nb[HISTORY_TICKS - step : len(self.q_nb) - step]
        turned = product(conjugate(before), self.q_nb[HISTORY_TICKS:])
        return np.asarray(rotation_vector(turned) * (TICK_HZ / step))

    def field(self, window: int = 0) -> Array:
        """Magnetometer readings (BLOCK, 3), mean over the last `window` ticks (register 85)."""
        if window <= 1:
            return self.mag_gauss[HISTORY_TICKS:]
        window = min(window, HISTORY_TICKS)
        total = np.cumsum(self.mag_gauss, axis=0)
        ends = total[HISTORY_TICKS:]
        return np.asarray((ends - total[HISTORY_TICKS - window : len(total) - window]) / window)


def clip_rate(rate_rad_s: Array) -> Array:
    """Rates as the gyro can read them."""
    return np.clip(rate_rad_s, -GYRO_RANGE_RAD_S, GYRO_RANGE_RAD_S)


class EmulatedWorld:
    """Makes the blocks, one after the other."""

    def __init__(
        self,
        truth: EmulatedTruth,
        motion: Motion,
        seed: int,
        disturbances: tuple[Disturbance, ...] = (),
        further: Further | None = None,
    ) -> None:
        self.truth = truth
        self._further = further
        self._motion = motion
        self._disturbances = disturbances
        self._noise = np.random.default_rng([seed, 3])
        self._bias = np.array(truth.gyro_bias_rad_s, dtype=np.float64)
        self._next_tick = 0
        past = np.arange(-HISTORY_TICKS, 0) / TICK_HZ
        self._q_nb = quaternions(motion.angles(past))
        self._mag = self._read_field(past, matrices(self._q_nb), self._normal(HISTORY_TICKS, 3))

    def next_block(self) -> SensorBlock:
        """The next `BLOCK_TICKS` ticks."""
        ticks = np.arange(self._next_tick, self._next_tick + BLOCK_TICKS)
        time_s = ticks / TICK_HZ
        noise = self._normal(BLOCK_TICKS, 12)
        q_nb = quaternions(self._motion.angles(time_s))
        R_nb = matrices(q_nb)
        self._q_nb = np.vstack((self._q_nb[-HISTORY_TICKS:], q_nb))
        mag = self._read_field(time_s, R_nb, noise[:, :3])
        self._mag = np.vstack((self._mag[-HISTORY_TICKS:], mag))
        bias = self._walk(self._normal(BLOCK_TICKS, 3))
        truth = self.truth
        accel = -GRAVITY_M_S2 * R_nb[:, 2, :] + truth.noise_accel_m_s2 * noise[:, 6:9]
        warmth = 1 - np.exp(-time_s / 600.0)
        block = SensorBlock(
            first_tick=self._next_tick,
            q_nb=self._q_nb,
            mag_gauss=self._mag,
            gyro_extra_rad_s=bias
            + truth.noise_gyro_rad_s * noise[:, 3:6]
            + (0.0 if self._further is None else self._further.at(time_s)[1]),
            bias_rad_s=bias,
            accel_m_s2=accel,
            temperature_c=truth.temperature_c + truth.warming_c * warmth + 3e-3 * noise[:, 9],
            pressure_kpa=truth.pressure_kpa + 7e-3 * noise[:, 10],
            jitter_s=truth.clock_jitter_s * noise[:, 11],
        )
        self._next_tick += BLOCK_TICKS
        return block

    def _normal(self, rows: int, columns: int) -> Array:
        return self._noise.standard_normal((rows, columns))

    def _read_field(self, time_s: Array, R_nb: Array, noise: Array) -> Array:
        truth = self.truth
        h_b = np.einsum("kji,j->ki", R_nb, truth.field_n_gauss)
        offset = np.tile(truth.hard_iron_gauss, (len(time_s), 1))
        for disturbance in self._disturbances:
            if isinstance(disturbance, Dipole):
                h_b = h_b + disturbance.field_b_gauss(time_s)
            else:
                offset = offset + disturbance.offset_b_gauss(time_s)
        if self._further is not None:
            offset = offset + self._further.at(time_s)[0]
        read = h_b @ truth.soft_iron.T + offset + truth.noise_mag_gauss * noise
        return np.asarray(np.clip(read, -MAG_RANGE_GAUSS, MAG_RANGE_GAUSS))

    def _walk(self, noise: Array) -> Array:
        """The gyro bias (BLOCK, 3) as it walks on."""
        step = self.truth.gyro_walk_rad_s_rts / math.sqrt(TICK_HZ)
        bias = self._bias + step * np.cumsum(noise, axis=0)
        self._bias = bias[-1]
        return np.asarray(bias)
