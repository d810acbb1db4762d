"""One vehicle with its machines in one field: all that happens before a sensor reads anything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from blind_trials.world.curves import Curve, Rise, wave
from blind_trials.world.motion import DEG, STEP_S, Motion, make_motion

#: seconds of world before the first sample, so that no filter and no delay looks before time zero
BEFORE_S = 1.0


@dataclass(frozen=True, eq=False)
class World:
    """Field (3,) gauss in the world, machines (N,) on the motion's grid, the sensor's truth."""

    motion: Motion
    field_n: np.ndarray
    temperature: np.ndarray
    current: np.ndarray
    yaw_current: np.ndarray
    rpm: np.ndarray
    pump_hz: float
    joint: np.ndarray
    switch: np.ndarray
    vibration: np.ndarray  # standard deviation of what shakes the sensor, m/s^2
    soft_iron: np.ndarray
    hard_iron: np.ndarray
    gyro_bias: np.ndarray

    @property
    def time_s(self):
        """Instants of the grid; the recording's time zero is BEFORE_S."""
        return self.motion.time_s


def low_passed(x, tau_s):
    """First-order lag of columns (N, ...), exact for a signal that is constant within 1 ms."""
    a = np.exp(-STEP_S / tau_s)
    start = np.asarray(x[:1]) * a
    return lfilter([1 - a], [1, -a], x, axis=0, zi=start)[0]


def _throttle(rng, t):
    """Steps of random height every 5 to 25 s, followed within 0.3 s."""
    level, at = np.empty_like(t), 0.0
    while at < t[-1] + 1:
        length = rng.uniform(5, 25)
        level[(t >= at) & (t < at + length)] = rng.uniform(0.1, 1.0)
        at += length
    return low_passed(level, 0.3)


def _joint(rng, t):
    """A rudder or arm: moves within 45 degrees, each move a second or two long."""
    parts, angle, at = [], 0.0, rng.uniform(2, 8)
    while at < t[-1]:
        target = rng.uniform(-45, 45) * DEG
        parts.append(Rise(target - angle, at, rng.uniform(0.8, 2.0)))
        angle, at = target, at + rng.uniform(4, 15)
    return Curve(tuple(parts)).at(t)[0]


def _switch(rng, t):
    """A lamp: on and off for 15 to 60 s."""
    state, at, on = np.zeros_like(t), rng.uniform(10, 40), True
    while at < t[-1]:
        length = rng.uniform(15, 60)
        if on:
            state[(t >= at) & (t < at + length)] = 1.0
        at, on = at + length, not on
    return state


def _yaw_current(motion):
    """The yaw thruster works against inertia and a little drag; 4 A at the hardest."""
    torque = motion.yaw_acceleration + 0.2 * np.gradient(motion.yaw, STEP_S)
    most = np.max(np.abs(torque))
    return 4.0 * torque / most if most > 0 else np.zeros_like(torque)


def make_world(motion_name, rng, duration_s, *, warm_up_c=None):
    """A World of that motion.  warm_up_c: how much warmer it gets; 5 to 10 degrees if None."""
    motion = make_motion(motion_name, rng, duration_s + BEFORE_S)
    t = motion.time_s
    throttle = _throttle(rng, t)
    warm = rng.uniform(5, 10) if warm_up_c is None else warm_up_c
    weather = wave(rng, 0.05 * warm, 0.005, 0.01).at(t)[0]
    temperature = rng.uniform(8, 20) + warm * (1 - np.exp(-t / rng.uniform(90, 250))) + weather
    size, dip, bearing = rng.uniform(0.3, 0.58), rng.uniform(20, 72) * DEG, rng.uniform(0, 6.283)
    field = size * np.array(
        [np.cos(dip) * np.cos(bearing), np.cos(dip) * np.sin(bearing), np.sin(dip)]
    )
    stretch = rng.uniform(-0.12, 0.12, (3, 3))
    soft = np.eye(3) + 0.5 * (stretch + stretch.T)
    return World(
        motion=motion,
        field_n=field,
        temperature=temperature,
        current=10.0 * throttle**1.5,
        yaw_current=_yaw_current(motion),
        rpm=4000.0 * np.sqrt(throttle),
        pump_hz=rng.uniform(15, 60),
        joint=_joint(rng, t),
        switch=_switch(rng, t),
        vibration=0.1 + 2.0 * throttle,
        soft_iron=soft / np.cbrt(np.linalg.det(soft)),
        hard_iron=rng.uniform(-0.15, 0.15, 3),
        gyro_bias=rng.uniform(-6e-3, 6e-3, 3),
    )
