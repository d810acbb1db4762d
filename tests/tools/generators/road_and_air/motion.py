"""Motions of cars, wheeled robots, multicopters and hand-turned sensors, with what they log.

Frames follow contract section 1: b = sensor axes (x forward, y right, z down), n = north, east,
down, v_n = R_nb v_b.  Every motion is a body rate on a fine grid (600 Hz or more) that is
integrated to the true attitude with unit quaternions; the samples are every ``sub``-th fine point.
Units: metres, seconds, radians, rad/s, m/s^2, amperes, volts, degrees Celsius.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

Array = NDArray[np.floating[Any]]
Rng = np.random.Generator

GRAVITY = 9.80665
COARSE_HZ = 50.0
VEHICLES = ("car", "robot", "copter", "hand")
RATES_HZ = (20.0, 25.0, 40.0, 50.0, 80.0, 100.0, 200.0)
MAX_SAMPLES = 40000


@dataclass
class Motion:
    """One true motion: fine grid (``n * sub + 1`` points) and the ``n`` samples taken from it."""

    vehicle: str
    rate_hz: float
    sub: int
    time_s: Array
    omega: Array
    quaternion: Array
    rotation: Array
    position: Array
    velocity: Array
    force: Array
    vibration_g: Array
    channels: dict[str, Array] = field(default_factory=dict)
    joint: str | None = None
    switch: str = "device_on"
    wheel: str | None = None

    @property
    def index(self) -> NDArray[np.int64]:
        """Fine-grid index of every sample; sample k ends the step that began one ``sub`` before."""
        count = (len(self.time_s) - 1) // self.sub
        return np.arange(1, count + 1, dtype=np.int64) * self.sub

    @property
    def step_s(self) -> float:
        """Seconds from one sample to the next."""
        return 1.0 / self.rate_hz

    def step_rate(self) -> Array:
        """Mean rate (rad/s) over the step that ends at each sample: rotation vector over time.

        contract section 1, timing.  The rotation vector is that of the whole step, so the
        values turn one sample's attitude into the next exactly (no coning error in a null).
        """
        ends = self.quaternion[self.index]
        starts = self.quaternion[self.index - self.sub]
        step = rotation_vector(quat_multiply(quat_conjugate(starts), ends))
        return np.asarray(step * self.rate_hz)

    def step_mean(self, fine: Array) -> Array:
        """Mean of a fine-grid quantity over the step that ends at each sample."""
        body = fine[1:]
        shape = (len(body) // self.sub, self.sub, *body.shape[1:])
        return np.asarray(body.reshape(shape).mean(axis=1))


def quat_multiply(p: Array, q: Array) -> Array:
    """Hamilton product of quaternions (w, x, y, z) along the last axis."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    scalar = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([scalar, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def quat_conjugate(q: Array) -> Array:
    """Inverse of unit quaternions."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def quat_from_vector(v: Array) -> Array:
    """Unit quaternion of a rotation vector (radians)."""
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * v], axis=-1)


def rotation_vector(q: Array) -> Array:
    """Rotation vector (radians, below pi) of unit quaternions."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    ratio = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return np.asarray(ratio * q[..., 1:])


def quat_to_matrix(q: Array) -> Array:
    """Rotation matrices R_nb of unit quaternions."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def quat_from_euler(roll: float, pitch: float, yaw: float) -> Array:
    """Quaternion of yaw, then pitch, then roll (aerospace order, radians)."""
    zero = 0.0
    qz = quat_from_vector(np.array([zero, zero, yaw]))
    qy = quat_from_vector(np.array([zero, pitch, zero]))
    qx = quat_from_vector(np.array([roll, zero, zero]))
    return quat_multiply(quat_multiply(qz, qy), qx)


def integrate_rate(omega: Array, dt: float, start: Array) -> Array:
    """Attitude quaternions (count + 1) from mid-step body rates: q[k+1] = q[k] exp(omega dt).

    Products are formed in blocks so that numpy does the work; the result is the same product.
    """
    count = len(omega)
    width = int(math.sqrt(count)) + 1
    padded = np.zeros((width * width, 3))
    padded[:count] = omega
    steps = quat_from_vector(padded * dt).reshape(width, width, 4)
    partial = np.empty_like(steps)
    run = steps[:, 0]
    partial[:, 0] = run
    for j in range(1, width):
        run = quat_multiply(run, steps[:, j])
        partial[:, j] = run
    heads = np.empty((width, 4))
    head = start / np.linalg.norm(start)
    for i in range(width):
        heads[i] = head
        head = quat_multiply(head, partial[i, -1])
        head = head / np.linalg.norm(head)
    whole = quat_multiply(heads[:, None, :], partial).reshape(-1, 4)[:count]
    whole = whole / np.linalg.norm(whole, axis=1, keepdims=True)
    return np.concatenate([heads[:1], whole], axis=0)


def low_pass(x: Array, tau_s: float, dt: float) -> Array:
    """First-order lag with time constant ``tau_s``, started at rest on the first value."""
    keep = math.exp(-dt / max(tau_s, 1e-9))
    start = keep * np.atleast_1d(x[0])
    shaped = x if x.ndim > 1 else x[:, None]
    out, _ = lfilter([1.0 - keep], [1.0, -keep], shaped, axis=0, zi=start[None, :])
    return np.asarray(out if x.ndim > 1 else out[:, 0])


def wander(rng: Rng, count: int, dt: float, tau_s: float, size: float) -> Array:
    """Smooth random wandering of unit ``size`` (rms) with correlation time ``tau_s``."""
    x = low_pass(low_pass(rng.standard_normal(count), tau_s, dt), tau_s, dt)
    scale = float(np.std(x))
    return x * (size / scale if scale > 0 else 0.0)


def ring(drive: Array, hertz: float, damping: float, dt: float) -> Array:
    """Answer of a damped oscillator (suspension, pendulum) with unit gain at rest to ``drive``."""
    pole = np.exp((-damping + 1j * math.sqrt(1 - damping**2)) * 2 * math.pi * hertz * dt)
    a = np.array([1.0, -2.0 * pole.real, abs(pole) ** 2])
    return np.asarray(lfilter([a.sum()], a, drive, axis=0))


def finish(
    vehicle: str,
    rng: Rng,
    rate_hz: float,
    time: Array,
    coarse: dict[str, Array],
    rates: Array | None = None,
    start: Array | None = None,
) -> Motion:
    """Turn a coarse path (and Euler angles or fine body rates) into a fine, integrated motion."""
    sub = max(3, math.ceil(600.0 / rate_hz))
    dt = 1.0 / (rate_hz * sub)
    count = int((time[-1] - 1.0) * rate_hz) * sub
    fine = np.arange(count + 1) * dt
    path = CubicSpline(time, coarse["position"])
    if rates is None or start is None:
        euler = CubicSpline(time, coarse["euler"])
        middle = fine[:-1] + 0.5 * dt
        roll, pitch, _ = euler(middle).T
        d_roll, d_pitch, d_yaw = euler(middle, 1).T
        omega = np.stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.sin(roll) * np.cos(pitch),
                -d_pitch * np.sin(roll) + d_yaw * np.cos(roll) * np.cos(pitch),
            ],
            axis=1,
        )
        start = quat_from_euler(*(float(v) for v in euler(0.0)))
    else:
        omega = rates[:count]
    quaternion = integrate_rate(omega, dt, start)
    rotation = quat_to_matrix(quaternion)
    acceleration = low_pass(np.asarray(path(fine, 2)), 0.03, dt)
    force = np.einsum("nij,ni->nj", rotation, acceleration - np.array([0.0, 0.0, GRAVITY]))
    # what np.interp gives is enough for causes that change slower than the coarse grid
    channels = {
        name: np.interp(fine, time, value)
        for name, value in coarse.items()
        if name not in ("position", "euler", "vibration")
    }
    vibration = np.interp(fine, time, coarse["vibration"])
    channels["temperature_c"] = warm_up(rng, fine, dt)
    velocity = np.asarray(path(fine, 1))
    if "battery_v" not in channels:
        drop = 0.02 * channels.get("motor_current_a", np.zeros(count + 1))
        full = {"car": 13.4, "robot": 25.2, "copter": 16.6, "hand": 4.1}[vehicle]
        channels["battery_v"] = full * (1.0 - 1.2e-4 * fine) - drop
    if vehicle != "hand":
        channels["speed_m_s"] = channels.get("speed_m_s", np.linalg.norm(velocity, axis=1))
    channels["altitude_m"] = -np.asarray(path(fine))[:, 2]
    full_omega = np.concatenate([omega[:1], omega], axis=0)
    switch = {"car": "fan_on", "robot": "gripper_on", "copter": "lamp_on", "hand": "display_on"}
    motion = Motion(
        vehicle,
        rate_hz,
        sub,
        fine,
        full_omega,
        quaternion,
        rotation,
        np.asarray(path(fine)),
        velocity,
        force,
        vibration,
        channels,
        joint={
            "car": "steering_angle_rad",
            "robot": "arm_angle_rad",
            "copter": "gimbal_angle_rad",
            "hand": None,
        }[vehicle],
        switch=switch[vehicle],
        wheel={
            "car": "wheel_rate_rad_s",
            "robot": "wheel_rate_rad_s",
            "copter": "rotor_rate_rad_s",
            "hand": None,
        }[vehicle],
    )
    channels[motion.switch] = telegraph(rng, fine, rng.uniform(8.0, 40.0))
    channels["radio_tx"] = pulses(rng, motion)
    return motion


def warm_up(rng: Rng, time: Array, dt: float) -> Array:
    """Temperature: electronics warm up by 4 to 14 C, and sun and air flow wander by about 1 C."""
    rise = rng.uniform(4.0, 14.0) * -np.expm1(-time / rng.uniform(60.0, 250.0))
    drift = wander(rng, len(time), dt, 25.0, rng.uniform(0.2, 1.2))
    return np.asarray(rng.uniform(5.0, 30.0) + rise + drift)


def telegraph(rng: Rng, time: Array, mean_s: float) -> Array:
    """A logged switch: 0 or 1, changed after random times of mean ``mean_s`` seconds."""
    gaps = 3.0 + rng.exponential(mean_s, size=int(time[-1] / 3.0) + 2)
    flips = np.searchsorted(np.cumsum(gaps), time)
    return ((flips + int(rng.integers(2))) % 2).astype(np.float64)


def pulses(rng: Rng, motion: Motion) -> Array:
    """Transmit flag of a telemetry radio: on for one or two sample steps every 0.4 to 3 s."""
    period = rng.uniform(max(0.4, 5.0 * motion.step_s), 3.0)
    width = rng.uniform(1.1, 2.2) * motion.step_s
    return ((motion.time_s + rng.uniform(0, period)) % period < width).astype(np.float64)


def drive_car(rng: Rng, rate_hz: float, duration_s: float) -> Motion:
    """A car on a road with bends, roundabouts, hills, banked curves, and stops at lights."""
    dt = 1.0 / COARSE_HZ
    count = int((duration_s + 2.0) * COARSE_HZ)
    limit = rng.uniform(9.0, 22.0)
    curvature: list[Array] = [np.zeros(40)]
    stops: list[int] = []
    while sum(map(len, curvature)) < limit * duration_s + 200:
        kind = rng.choice(["straight", "bend", "bend", "roundabout"])
        if kind == "straight":
            curvature.append(np.zeros(int(rng.uniform(40, 220))))
            if rng.random() < 0.35:
                stops.append(sum(map(len, curvature)))
        elif kind == "bend":
            radius, angle = rng.uniform(14, 140), rng.uniform(0.4, 2.0)
            sign = rng.choice([-1.0, 1.0])
            curvature.append(np.full(int(radius * angle) + 1, sign / radius))
        else:
            radius, sweep = rng.uniform(11, 20), rng.uniform(1.6, 7.0)
            curvature.append(np.full(8, 1.0 / 18.0))
            curvature.append(np.full(int(radius * sweep) + 1, -1.0 / radius))
            curvature.append(np.full(8, 1.0 / 18.0))
    kappa = np.convolve(np.concatenate(curvature), np.hanning(13) / np.hanning(13).sum(), "same")
    metres = np.arange(len(kappa), dtype=np.float64)
    top = np.minimum(limit, np.sqrt(2.6 / np.maximum(np.abs(kappa), 1e-4)))
    for light in stops:
        top[min(light, len(top) - 1)] = 0.4
    for j in range(len(top) - 2, -1, -1):
        top[j] = min(top[j], math.sqrt(top[j + 1] ** 2 + 2 * 2.4))
    speed, s, dwell = 0.0, 0.0, 2.0
    waiting = sorted(stops)
    track = np.empty((count, 2))
    for i in range(count):
        if dwell > 0:
            dwell -= dt
            target = 0.0
        else:
            target = float(top[min(int(s) + 1, len(top) - 1)])
        speed = min(target, speed + 1.9 * dt) if target > speed else max(target, speed - 3.5 * dt)
        s += speed * dt
        if waiting and s >= waiting[0]:
            waiting.pop(0)
            dwell = rng.uniform(3.0, 12.0)
        track[i] = s, speed
    distance, fast = track[:, 0], low_pass(track[:, 1], 0.25, dt)
    bend = np.interp(distance, metres, kappa)
    grade = sum(
        (
            rng.uniform(0.008, 0.035) * np.sin(2 * np.pi * distance / w + rng.uniform(0, 6.3))
            for w in rng.uniform([90, 200, 500], [200, 450, 1200])
        ),
        np.zeros(count),
    )
    ahead, side = np.gradient(fast, dt), fast**2 * bend
    rough = 0.004 * fast / limit
    roll = np.clip(2.2 * bend, -0.09, 0.09) + ring(-0.009 * side, 1.6, 0.3, dt) + 0.02
    roll += rough * wander(rng, count, dt, 0.08, 1.0)
    pitch = np.arctan(grade) + ring(0.008 * ahead, 1.3, 0.3, dt)
    pitch += rough * wander(rng, count, dt, 0.08, 1.0)
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(fast * bend) * dt
    step = fast * dt
    position = np.cumsum(
        np.stack([step * np.cos(yaw), step * np.sin(yaw), -step * grade], axis=1), axis=0
    )
    pull = ahead + GRAVITY * grade + 0.15 + 4e-4 * fast**2
    time = np.arange(count) * dt
    current = low_pass(np.clip(3.0 + 7.0 * pull * (fast > 0.1), -12.0, 45.0), 0.2, dt)
    coarse = {
        "position": position,
        "euler": np.stack([roll, pitch, yaw], axis=1),
        "speed_m_s": fast,
        "throttle": np.clip(0.05 + 0.22 * pull * (fast > 0.1), 0.0, 1.0),
        "motor_current_a": current + 0.3 * wander(rng, count, dt, 0.3, 1.0),
        "steering_angle_rad": 15.0 * np.arctan(2.7 * bend) * (0.4 + 0.6 * (fast > 0.2)),
        "wheel_rate_rad_s": fast / 0.31,
        "vibration": 0.01 + 0.09 * fast / limit,
    }
    coarse["steering_angle_rad"] = low_pass(coarse["steering_angle_rad"], 0.3, dt)
    return finish("car", rng, rate_hz, time, coarse)


def drive_robot(rng: Rng, rate_hz: float, duration_s: float) -> Motion:
    """A skid-steered robot: straights, arcs, turns on the spot, bumps, and uneven ground."""
    dt = 1.0 / COARSE_HZ
    count = int((duration_s + 2.0) * COARSE_HZ)
    ahead, turn = np.zeros(count), np.zeros(count)
    i = int(2.0 * COARSE_HZ)
    while i < count:
        kind = rng.choice(["ahead", "spot", "arc", "stop"], p=[0.35, 0.35, 0.2, 0.1])
        length = rng.uniform(1.5, 8.0)
        if kind == "spot":
            pace = rng.uniform(0.4, 2.0)
            length = rng.uniform(0.5, 6.5) / pace
            turn[i : i + int(length * COARSE_HZ)] = pace * rng.choice([-1.0, 1.0])
        elif kind != "stop":
            ahead[i : i + int(length * COARSE_HZ)] = rng.uniform(0.3, 1.5) * rng.choice([1, 1, -1])
            if kind == "arc":
                turn[i : i + int(length * COARSE_HZ)] = rng.uniform(-0.8, 0.8)
        i += int(length * COARSE_HZ)
    slip = 1.0 + 0.06 * wander(rng, count, dt, 0.15, 1.0)
    speed = low_pass(low_pass(ahead, 0.12, dt), 0.08, dt)
    rate = low_pass(low_pass(turn, 0.12, dt), 0.06, dt) * slip
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(rate) * dt
    north, east = np.cumsum(speed * np.cos(yaw)) * dt, np.cumsum(speed * np.sin(yaw)) * dt
    height, slope_n, slope_e = np.zeros(count), np.zeros(count), np.zeros(count)
    for _ in range(5):
        wave = rng.uniform(1.5, 9.0)
        steep = rng.uniform(0.02, 0.10)
        course = rng.uniform(0, 2 * np.pi)
        kn, ke = math.cos(course) / wave, math.sin(course) / wave
        phase = kn * north + ke * east + rng.uniform(0, 6.3)
        height += steep * wave * np.sin(phase)
        slope_n += steep * kn * wave * np.cos(phase)
        slope_e += steep * ke * wave * np.cos(phase)
    knocks = np.zeros((count, 2))
    hits = rng.random(count) < (0.5 * np.abs(speed) + 0.2 * np.abs(rate)) * dt
    knocks[hits] = rng.normal(0.0, 0.12, (int(hits.sum()), 2))
    shake = ring(knocks, 2.8, 0.22, dt)
    uphill = np.arctan(slope_n * np.cos(yaw) + slope_e * np.sin(yaw))
    across = np.arctan(-slope_n * np.sin(yaw) + slope_e * np.cos(yaw))
    load = 0.7 + 1.1 * np.abs(speed) + 1.8 * np.abs(rate) + 6.0 * uphill * speed
    load += 0.8 * np.abs(np.gradient(speed, dt))
    arm = np.repeat(rng.uniform(-1.6, 1.6, count // 200 + 2), 200)
    arm *= np.repeat(rng.random(count // 200 + 2) < 0.8, 200)
    coarse = {
        "position": np.stack([north, east, -height], axis=1),
        "euler": np.stack([-across + shake[:, 0], uphill + shake[:, 1], yaw], axis=1),
        "speed_m_s": np.abs(speed),
        "throttle": np.clip(0.4 * np.abs(speed) + 0.25 * np.abs(rate), 0.0, 1.0),
        "motor_current_a": low_pass(np.clip(load, 0.2, 9.0), 0.08, dt)
        + 0.1 * wander(rng, count, dt, 0.2, 1.0),
        "arm_angle_rad": low_pass(low_pass(arm[:count], 0.4, dt), 0.4, dt),
        "wheel_rate_rad_s": speed / 0.11,
        "vibration": 0.01 + 0.06 * np.abs(speed) + 0.05 * np.abs(rate),
    }
    return finish("robot", rng, rate_hz, np.arange(count) * dt, coarse)


def fly_copter(rng: Rng, rate_hz: float, duration_s: float) -> Motion:
    """A multicopter between way points in a box, pushed by gusts, with turns about yaw."""
    dt = 1.0 / COARSE_HZ
    count = int((duration_s + 2.0) * COARSE_HZ)
    box = np.array([rng.uniform(8, 45), rng.uniform(8, 45), rng.uniform(3, 12)])
    steady = rng.normal(0.0, 2.0, 2)
    gusts = np.stack([wander(rng, count, dt, 1.2, rng.uniform(0.3, 1.5)) for _ in range(3)], axis=1)
    gusts[:, :2] += steady
    gusts[:, 2] *= 0.4
    place, speed = np.array([0.0, 0.0, -box[2] - 3.0]), np.zeros(3)
    lean = np.zeros(3)
    yaw, yaw_rate = float(rng.uniform(-3, 3)), 0.0
    goal: Array = place.copy()
    heading = yaw
    brisk, strong = rng.uniform(0.4, 1.8), rng.uniform(2.5, 5.5)
    hold = 3.0
    log = np.empty((count, 8))
    for i in range(count):
        hold -= dt
        if hold <= 0 and float(np.linalg.norm(goal - place)) < 1.5:
            goal = rng.uniform(-1, 1, 3) * box - np.array([0.0, 0.0, box[2] + 3.0])
            heading = yaw + rng.uniform(-3.5, 3.5)
            hold = rng.uniform(0.5, 4.0)
        wish = 0.5 * (goal - place) - 1.2 * speed
        wish *= min(1.0, strong / max(float(np.linalg.norm(wish)), 1e-9))
        lean += (wish - lean) * (dt / 0.18)
        speed = speed + (lean + 0.12 * (gusts[i] - speed)) * dt
        place = place + speed * dt
        turn = max(-brisk, min(brisk, 1.6 * (heading - yaw)))
        yaw_rate += (turn - yaw_rate) * (dt / 0.15)
        yaw += yaw_rate * dt
        log[i] = *place, *lean, yaw, yaw_rate
    place_t, lean_t, yaw_t, turn_t = log[:, :3], log[:, 3:6], log[:, 6], log[:, 7]
    trim = lean_t - 0.12 * np.concatenate([np.tile(steady, (count, 1)), np.zeros((count, 1))], 1)
    forward = trim[:, 0] * np.cos(yaw_t) + trim[:, 1] * np.sin(yaw_t)
    right = -trim[:, 0] * np.sin(yaw_t) + trim[:, 1] * np.cos(yaw_t)
    lift = GRAVITY - trim[:, 2]
    pitch = -np.arctan2(forward, lift) + 0.012 * wander(rng, count, dt, 0.12, 1.0)
    roll = np.arctan2(right, lift) + 0.012 * wander(rng, count, dt, 0.12, 1.0)
    thrust = np.sqrt(forward**2 + right**2 + lift**2) / GRAVITY
    thrust = thrust + 0.03 * wander(rng, count, dt, 0.2, 1.0)
    current = 1.2 + rng.uniform(8, 18) * np.abs(thrust) ** 1.5 + 0.4 * np.abs(turn_t)
    gimbal = np.repeat(rng.uniform(-1.4, 1.4, count // 300 + 2), 300)[:count]
    coarse = {
        "position": place_t,
        "euler": np.stack([roll, pitch, yaw_t], axis=1),
        "throttle": np.clip(0.45 * thrust, 0.0, 1.0),
        "motor_current_a": low_pass(current, 0.08, dt),
        "gimbal_angle_rad": low_pass(low_pass(gimbal, 0.5, dt), 0.5, dt),
        "rotor_rate_rad_s": 560.0 * np.sqrt(np.abs(thrust)),
        "vibration": 0.05 + 0.25 * np.abs(thrust - 0.7),
    }
    return finish("copter", rng, rate_hz, np.arange(count) * dt, coarse)


def turn_by_hand(rng: Rng, rate_hz: float, duration_s: float) -> Motion:
    """A person turns the sensor through all attitudes, move by move, with pauses and tremor."""
    dt = 1.0 / COARSE_HZ
    count = int((duration_s + 2.0) * COARSE_HZ)
    sub = max(3, math.ceil(600.0 / rate_hz))
    fine_dt = 1.0 / (rate_hz * sub)
    fine_count = int((duration_s + 2.0) / fine_dt)
    fine = (np.arange(fine_count) + 0.5) * fine_dt
    rates = np.zeros((fine_count, 3))
    brisk = rng.uniform(0.6, 1.6)
    t = 1.5
    while t < duration_s + 2.0:
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        angle, length = rng.uniform(0.4, 3.6), rng.uniform(1.0, 3.2) / brisk
        part = slice(*np.searchsorted(fine, [t, t + length]))
        u = (fine[part] - t) / length
        rates[part] += axis * (30.0 * u**2 * (1 - u) ** 2 * angle / length)[:, None]
        t += length * rng.uniform(0.75, 1.0)
        if rng.random() < 0.3:
            t += rng.uniform(0.5, 6.0)
    for axis_index in range(3):
        rates[:, axis_index] += 0.02 * wander(rng, fine_count, fine_dt, 0.03, 1.0)
    sway = [wander(rng, count, dt, 0.8, rng.uniform(0.1, 0.35)) for _ in range(3)]
    coarse = {
        "position": np.stack(sway, axis=1) + np.array([0.0, 0.0, -1.2]),
        "vibration": np.full(count, 0.01),
    }
    start = rng.standard_normal(4)
    return finish("hand", rng, rate_hz, np.arange(count) * dt, coarse, rates, start)


MAKERS: dict[str, Callable[[Rng, float, float], Motion]] = {
    "car": drive_car,
    "robot": drive_robot,
    "copter": fly_copter,
    "hand": turn_by_hand,
}


def make_motion(vehicle: str, rng: Rng, rate_hz: float | None = None) -> Motion:
    """A motion of the vehicle: 20 to 200 Hz, 100 to 500 s, at most ``MAX_SAMPLES`` samples."""
    rate = float(rng.choice(RATES_HZ)) if rate_hz is None else rate_hz
    duration = float(rng.uniform(100.0, min(500.0, MAX_SAMPLES / rate)))
    return MAKERS[vehicle](rng, rate, duration)
