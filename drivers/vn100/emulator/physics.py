"""The world that the emulated VN-100 senses: its motion, the field, and its sensors' readings.

**Motion.** Roll, pitch and yaw (3-2-1 Euler angles of R_nb: n = north-east-down, b = sensor axes)
as analytic functions of time. The mean rate over a step from k - n to k is the rotation vector of
q_(k-n)^-1 q_k over the step's length, so that the product of Exp(w dt) is the change of attitude
exactly, at every output rate. WAM, MAM and LAM are the wide, medium and low angular motions of the
simulated experiment of Rodriguez-Martinez: half-ranges in roll/pitch/heading of 180/180/180,
5/45/180 and 5/15/90 degrees. The plain names have the frequencies of the authors' early code (4 to
10 mHz), those with `-rov` the peak rates of their later code.

**Sensors**, up to the factory calibration:

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

# -- How the vehicle moves -------------------------------------------------------------------------


Array = NDArray[np.float64]

ROLL, PITCH, YAW = 0, 1, 2
TRANSITION_S = 6.0  # from the attitude in which a phase ends to the one in which the next begins
TURN_RAD = 2 * math.pi


class Motion(Protocol):
    """Attitude as a function of time."""

    def angles(self, time_s: Array) -> Array:
        """Roll, pitch, yaw in rad, (N, 3), at the instants `time_s` (N,); any time is allowed."""
        ...


@dataclass(frozen=True, slots=True)
class Sway:
    """One sine of one angle: amplitude_rad sin(2 pi frequency_hz t + phase_rad)."""

    axis: int
    amplitude_rad: float
    frequency_hz: float
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Stops:
    """Regular stops: every `period_s` the vehicle stands still for `still_s`.

    The motion's own time runs at speed 1 between stops, at 0 during one, and passes from one to the
    other within `ramp_s` along a raised cosine: rates are continuous.
    """

    period_s: float
    still_s: float
    ramp_s: float = 1.5

    def moving_time(self, time_s: Array) -> Array:
        """The motion's own time (N,): the integral of the speed."""
        ramp, cruise = self.ramp_s, self.period_s - self.still_s - 2 * self.ramp_s
        cycles, phase = np.divmod(time_s, self.period_s)
        up = np.clip(phase, 0.0, ramp)
        flat = np.clip(phase - ramp, 0.0, cruise)
        down = np.clip(phase - ramp - cruise, 0.0, ramp)
        bend = ramp / TURN_RAD
        gone = up / 2 - bend * np.sin(math.pi * up / ramp)
        gone += flat + down / 2 + bend * np.sin(math.pi * down / ramp)
        return np.asarray(cycles * (cruise + ramp) + gone)


@dataclass(frozen=True, slots=True)
class Swaying:
    """A sum of sines in each angle around `mean_rad`, with or without regular stops."""

    sways: tuple[Sway, ...]
    mean_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stops: Stops | None = None

    def angles(self, time_s: Array) -> Array:
        """See `Motion`."""
        moving = time_s if self.stops is None else self.stops.moving_time(time_s)
        angles = np.tile(np.array(self.mean_rad), (len(time_s), 1))
        for sway in self.sways:
            phase = TURN_RAD * sway.frequency_hz * moving + sway.phase_rad
            angles[:, sway.axis] += sway.amplitude_rad * np.sin(phase)
        return angles


@dataclass(frozen=True, slots=True)
class Phases:
    """Motions one after the other; the last one goes on for ever.

    `starts_s[i]` is when motion i begins, at its own time 0, after a transition of `TRANSITION_S`
    that turns smoothly, and the short way in yaw, from where motion i - 1 had come to.
    """

    motions: tuple[Motion, ...]
    starts_s: tuple[float, ...]

    def angles(self, time_s: Array) -> Array:
        """See `Motion`."""
        angles = self.motions[0].angles(time_s - self.starts_s[0])
        for index, motion in enumerate(self.motions[1:], start=1):
            start_s = self.starts_s[index]
            turning = (time_s >= start_s - TRANSITION_S) & (time_s < start_s)
            if np.any(turning):
                part = (time_s[turning] - start_s) / TRANSITION_S + 1.0
                angles[turning] = self._transition(index, part)
            moving = time_s >= start_s
            if np.any(moving):
                angles[moving] = motion.angles(time_s[moving] - start_s)
        return angles

    def _transition(self, index: int, part: Array) -> Array:
        """Angles at the fractions `part` of the transition to motion `index`."""
        length_s = self.starts_s[index] - TRANSITION_S - self.starts_s[index - 1]
        old = self.motions[index - 1].angles(np.array([length_s]))
        turn = self.motions[index].angles(np.array([0.0])) - old
        turn[:, YAW] = np.remainder(turn[:, YAW] + math.pi, TURN_RAD) - math.pi
        smooth = part**3 * (10 + part * (6 * part - 15))  # rate and acceleration 0 at both ends
        return np.asarray(old + smooth[:, None] * turn)


def in_phases(phases: Sequence[tuple[Motion, float]]) -> Motion:
    """Motions in sequence, each for so many seconds (the last one for ever)."""
    if not phases:
        raise ValueError("a motion needs at least one phase")
    starts = [0.0]
    for (_, seconds), _ in pairwise(phases):
        if seconds <= 0:
            raise ValueError(f"a phase must last longer than 0 s, not {seconds:g} s")
        starts.append(starts[-1] + seconds + TRANSITION_S)
    return Phases(tuple(motion for motion, _ in phases), tuple(starts))


# Half-ranges in roll, pitch, heading (degrees) and the frequency of each (hertz) or, for `-rov`,
# its peak rate (rad/s); drawn uniformly between the two numbers.
HALF_RANGES_DEG = {"wam": (180, 180, 180), "mam": (5, 45, 180), "lam": (5, 15, 90)}
SLOW_HZ = ((5e-3, 10e-3), (5e-3, 8e-3), (4e-3, 8e-3))
ROV_RAD_S = ((0.05, 0.08), (0.1, 0.3), (0.2, 0.4))

_Drawing = np.random.Generator


def _angular(name: str, rov: bool, draw: _Drawing) -> Motion:
    sways = []
    for axis, half_range_deg in enumerate(HALF_RANGES_DEG[name]):
        amplitude = math.radians(half_range_deg)
        frequency = draw.uniform(*(ROV_RAD_S if rov else SLOW_HZ)[axis])
        if rov:
            frequency /= TURN_RAD * amplitude
        sways.append(Sway(axis, amplitude, frequency, draw.uniform(0, TURN_RAD)))
    return Swaying(tuple(sways))


def _swaying(
    draw: _Drawing, rows: Sequence[tuple[int, float, float]], stops: Stops | None = None
) -> Swaying:
    """Rows of (axis, amplitude in degrees, period in s); periods vary by a tenth, phases freely."""
    sways = tuple(
        Sway(
            axis,
            math.radians(amplitude_deg),
            1.0 / (period_s * draw.uniform(0.9, 1.1)),
            draw.uniform(0, TURN_RAD),
        )
        for axis, amplitude_deg, period_s in rows
    )
    return Swaying(sways, stops=stops)


def _cruise(draw: _Drawing) -> Motion:
    """Ordinary work of an ROV: course changes, a few degrees of roll and pitch."""
    rows = [(YAW, 100, 80), (YAW, 25, 23), (PITCH, 6, 9), (PITCH, 4, 31), (ROLL, 5, 7)]
    return _swaying(draw, rows, Stops(60.0, 6.0))


def _survey(draw: _Drawing) -> Motion:
    """Four minutes of pirouettes both ways with up to 35 degrees of roll and pitch, then work."""
    rows = [(YAW, 370, 115), (YAW, 40, 29), (ROLL, 27, 17), (ROLL, 8, 6.5)]
    rows += [(PITCH, 27, 13.5), (PITCH, 8, 41)]
    dance = _swaying(draw, rows, Stops(50.0, 7.0))
    return in_phases([(dance, 240.0), (_cruise(draw), 1.0)])


def _tumble(draw: _Drawing) -> Motion:
    """A sensor turned over and over by hand."""
    rows = [(ROLL, 150, 13), (ROLL, 30, 4.3), (PITCH, 80, 9), (YAW, 170, 17), (YAW, 40, 5.1)]
    return _swaying(draw, rows)


def _planar(draw: _Drawing) -> Motion:
    """A car: any heading, at most 2 degrees of roll and pitch, stops at lights."""
    rows = [(YAW, 260, 90), (YAW, 60, 33), (ROLL, 1.2, 5.5), (PITCH, 0.8, 4.1)]
    return _swaying(draw, rows, Stops(75.0, 10.0, 2.5))


def _static(draw: _Drawing) -> Motion:
    roll, pitch, yaw = np.radians(draw.uniform((-3, -3, -180), (3, 3, 180)))
    return Swaying((), mean_rad=(float(roll), float(pitch), float(yaw)))


MOTIONS: dict[str, Callable[[_Drawing], Motion]] = {
    "wam": lambda draw: _angular("wam", False, draw),
    "mam": lambda draw: _angular("mam", False, draw),
    "lam": lambda draw: _angular("lam", False, draw),
    "wam-rov": lambda draw: _angular("wam", True, draw),
    "mam-rov": lambda draw: _angular("mam", True, draw),
    "lam-rov": lambda draw: _angular("lam", True, draw),
    "survey": _survey,
    "cruise": _cruise,
    "tumble": _tumble,
    "planar": _planar,
    "static": _static,
}


def make_motion(plan: str | Sequence[tuple[str, float]], seed: int) -> Motion:
    """The motion of a name in `MOTIONS`, or of a sequence of (name, seconds).

    Raises ValueError for an unknown name, naming those that exist.
    """
    phases = [(plan, 1.0)] if isinstance(plan, str) else list(plan)
    draw = np.random.default_rng([seed, 1])
    for name, _ in phases:
        if name not in MOTIONS:
            raise ValueError(f"no motion {name!r}; there are {', '.join(MOTIONS)}")
    return in_phases([(MOTIONS[name](draw), seconds) for name, seconds in phases])


def quaternions(angles_rad: Array) -> Array:
    """q_nb (N, 4), scalar last, of roll, pitch, yaw (N, 3) in rad: v_n = q v_b q^-1."""
    half = angles_rad / 2
    sin_roll, sin_pitch, sin_yaw = np.sin(half).T
    cos_roll, cos_pitch, cos_yaw = np.cos(half).T
    return np.column_stack(
        (
            sin_roll * cos_pitch * cos_yaw - cos_roll * sin_pitch * sin_yaw,
            cos_roll * sin_pitch * cos_yaw + sin_roll * cos_pitch * sin_yaw,
            cos_roll * cos_pitch * sin_yaw - sin_roll * sin_pitch * cos_yaw,
            cos_roll * cos_pitch * cos_yaw + sin_roll * sin_pitch * sin_yaw,
        )
    )


def product(left: Array, right: Array) -> Array:
    """Hamilton product of quaternions (N, 4), scalar last."""
    lv, lw = left[:, :3], left[:, 3:]
    rv, rw = right[:, :3], right[:, 3:]
    vector = lw * rv + rw * lv + np.cross(lv, rv)
    return np.hstack((vector, lw * rw - np.sum(lv * rv, axis=1, keepdims=True)))


def conjugate(quaternion: Array) -> Array:
    """The inverse of unit quaternions (N, 4)."""
    return np.asarray(quaternion * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotation_vector(quaternion: Array) -> Array:
    """Rotation vectors (N, 3) in rad, of length at most pi, of unit quaternions (N, 4)."""
    nearest = np.where(quaternion[:, 3:] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(nearest[:, :3], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, nearest[:, 3:])
    scale = np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)
    return np.asarray(scale * nearest[:, :3])


def matrices(quaternion: Array) -> Array:
    """R (N, 3, 3) of unit quaternions (N, 4): v_n = R v_b."""
    x, y, z, w = quaternion.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_of(R: Array) -> Array:
    """The unit quaternion (4,) of one rotation matrix (3, 3).

    Eigenvector of the symmetric K with q' K q = trace(R(q)' R): it exists for every R.
    """
    K = np.zeros((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[3, 3] = np.trace(R)
    return np.asarray(np.linalg.eigh(K)[1][:, -1])


def euler_angles(R_nb: Array) -> Array:
    """Roll, pitch, yaw (N, 3) in rad of R (N, 3, 3): roll and yaw -pi..pi, pitch -pi/2..pi/2."""
    roll = np.arctan2(R_nb[:, 2, 1], R_nb[:, 2, 2])
    pitch = -np.arcsin(np.clip(R_nb[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(R_nb[:, 1, 0], R_nb[:, 0, 0])
    return np.column_stack((roll, pitch, yaw))


# -- What its sensors read -------------------------------------------------------------------------


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
