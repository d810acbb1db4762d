"""How the emulated vehicle moves: attitude angles as analytic functions of time.

A motion gives roll, pitch and yaw (3-2-1 Euler angles of R_nb: n = north-east-down, b = sensor
axes) at any instants. Everything else follows from attitudes: the mean rate over a step from k - n
to k is the rotation vector of q_(k-n)^-1 q_k over the step's length, so that the product of
Exp(w dt) is the change of attitude exactly, at every output rate.

WAM, MAM and LAM are the wide, medium and low angular motions of the simulated experiment of
Rodriguez-Martinez: half-ranges in roll/pitch/heading of 180/180/180, 5/45/180 and 5/15/90 degrees.
The plain names have the frequencies of the authors' early code (4 to 10 mHz), those with `-rov` the
peak rates of their later code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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
