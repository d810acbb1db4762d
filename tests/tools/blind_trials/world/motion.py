"""Vehicles: what the body does, on a 1 kHz grid, from smooth angles with exact rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blind_trials.world.curves import Curve, Line, Rise, wave
from blind_trials.world.rotations import matrix_from_euler, rate_from_euler, to_body

STEP_S = 1e-3
GRAVITY_N = np.array([0.0, 0.0, 9.81])
DEG = np.pi / 180


@dataclass(frozen=True, eq=False)
class Motion:
    """On the grid of N instants: R_nb (N,3,3), body rate and its derivative, position, force."""

    name: str
    time_s: np.ndarray
    R_nb: np.ndarray
    rate_b: np.ndarray
    force_b: np.ndarray  # specific force, what an accelerometer reads
    position_n: np.ndarray
    speed: np.ndarray
    yaw: np.ndarray
    yaw_acceleration: np.ndarray


def hovering(rng, duration_s, roll, pitch, yaw, factor):
    """A body that turns about three axes and moves in a box: (yaw, pitch, roll) and no course."""
    return (
        wave(rng, yaw * DEG, 0.008 * factor, 0.014 * factor),
        wave(rng, pitch * DEG, 0.02 * factor, 0.035 * factor),
        wave(rng, roll * DEG, 0.03 * factor, 0.06 * factor),
    )


def lawn_mower(rng, duration_s):
    """Legs and turns of 180 degrees, left and right in turn, yo-yo in depth, banked in turns."""
    parts, start, side = [Line(rng.uniform(0, 2 * np.pi))], rng.uniform(15, 30), 1
    while start < duration_s:
        parts.append(Rise(side * np.pi, start, rng.uniform(12, 20)))
        start += rng.uniform(35, 55)
        side = -side
    yaw = Curve((*parts, *wave(rng, 1.5 * DEG, 0.02, 0.05).parts))
    pitch = Curve((Line(2 * DEG), *wave(rng, 22 * DEG, 0.012, 0.02).parts))
    return yaw, pitch, wave(rng, 4 * DEG, 0.05, 0.12)


def town(rng, duration_s):
    """A car: corners and roundabouts, a nearly level floor."""
    parts, start = [Line(rng.uniform(0, 2 * np.pi))], rng.uniform(5, 15)
    while start < duration_s:
        angle = rng.choice([90, 90, 60, 180, 300]) * rng.choice([-1, 1])
        length = max(3.0, abs(angle) / 25)
        parts.append(Rise(angle * DEG, start, length * rng.uniform(0.9, 1.3)))
        start += length + rng.uniform(6, 25)
    yaw = Curve((*parts, *wave(rng, 1.0 * DEG, 0.1, 0.2).parts))
    return yaw, wave(rng, 4 * DEG, 0.03, 0.08), wave(rng, 3 * DEG, 0.05, 0.15)


def flight(rng, duration_s):
    """A multicopter: quick tilt, brisk yaw."""
    parts, start = [Line(rng.uniform(0, 2 * np.pi))], rng.uniform(3, 10)
    while start < duration_s:
        angle = rng.uniform(30, 220) * rng.choice([-1, 1])
        length = abs(angle) / rng.uniform(25, 60)
        parts.append(Rise(angle * DEG, start, length))
        start += length + rng.uniform(2, 15)
    yaw = Curve((*parts, *wave(rng, 3 * DEG, 0.1, 0.3).parts))
    return yaw, wave(rng, 18 * DEG, 0.08, 0.25), wave(rng, 18 * DEG, 0.08, 0.25)


def spin(rng, duration_s):
    """A turntable: constant rate about the vertical, level."""
    rate = rng.uniform(0.2, 0.5) * rng.choice([-1, 1])
    level = Curve((Line(rng.uniform(-2, 2) * DEG),))
    return Curve((Line(0.0, rate),)), level, level


def straight(rng, duration_s):
    """A course held to half a degree."""
    yaw = Curve((Line(rng.uniform(0, 2 * np.pi)), *wave(rng, 0.5 * DEG, 0.01, 0.03).parts))
    return yaw, wave(rng, 0.5 * DEG, 0.02, 0.05), wave(rng, 0.5 * DEG, 0.03, 0.06)


#: name -> (angles, how it moves: in a box of so many metres, or along its course at m/s)
MOTIONS = {
    "wam": (lambda rng, d: hovering(rng, d, 5, 45, 180, 1.0), ("box", 10.0)),
    "wam_rov": (lambda rng, d: hovering(rng, d, 5, 45, 180, 3.0), ("box", 10.0)),
    "mam": (lambda rng, d: hovering(rng, d, 5, 20, 180, 1.0), ("box", 10.0)),
    "lam": (lambda rng, d: hovering(rng, d, 5, 15, 90, 1.0), ("box", 10.0)),
    "lam_rov": (lambda rng, d: hovering(rng, d, 5, 15, 90, 3.0), ("box", 10.0)),
    "tiny": (lambda rng, d: hovering(rng, d, 2, 4, 20, 2.0), ("box", 5.0)),
    "lawn_mower": (lawn_mower, ("course", 1.6)),
    "car": (town, ("course", 9.0)),
    "drone": (flight, ("box", 40.0)),
    "spin": (spin, ("box", 0.1)),
    "straight": (straight, ("course", 1.6)),
}


def make_motion(name, rng, duration_s):
    """The Motion of that name, `duration_s` long and a little before zero is not needed."""
    angles, (kind, size) = MOTIONS[name]
    t = np.arange(round(duration_s / STEP_S) + 1) * STEP_S
    yaw_curve, pitch_curve, roll_curve = angles(rng, duration_s)
    (yaw, yaw_1, yaw_2), (pitch, pitch_1, _), (roll, roll_1, _) = (
        curve.at(t) for curve in (yaw_curve, pitch_curve, roll_curve)
    )
    R_nb = matrix_from_euler(yaw, pitch, roll)
    place = _box if kind == "box" else _course
    position, acceleration, speed = place(rng, t, size, yaw)
    return Motion(
        name,
        t,
        R_nb,
        rate_from_euler(pitch, roll, yaw_1, pitch_1, roll_1),
        to_body(R_nb, acceleration - GRAVITY_N),
        position,
        speed,
        yaw,
        yaw_2,
    )


def _box(rng, t, size_m, yaw):
    """A Lissajous figure in a box of `size_m`."""
    axes = [wave(rng, half * size_m, 0.004, 0.012) for half in (0.5, 0.5, 0.25)]
    value, first, second = (np.stack(part, axis=1) for part in zip(*(c.at(t) for c in axes)))
    return value, second, np.linalg.norm(first, axis=1)


def _course(rng, t, cruise_m_s, yaw):
    """Along the heading, at a speed that changes between 0.3 and 1 of the cruising speed."""
    swing = wave(rng, 0.35, 0.01, 0.03).at(t)[0]
    speed = cruise_m_s * (0.65 + swing)
    depth, sink, sink_rate = wave(rng, 4.0, 0.01, 0.02).at(t)
    velocity = np.stack([speed * np.cos(yaw), speed * np.sin(yaw), sink], axis=1)
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    position = np.vstack([np.zeros(3), np.cumsum(mean, axis=0) * STEP_S])
    position[:, 2] = depth
    acceleration = np.gradient(velocity, STEP_S, axis=0)
    acceleration[:, 2] = sink_rate
    return position, acceleration, speed
