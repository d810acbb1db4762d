"""How working vehicles at sea move: work boat in swell, ROV, AUV on a lawn-mower, towed body.

Each vehicle is a small physical model (helm with slew-limited rudder, first-order Nomoto yaw,
second-order roll and pitch driven by wave slope, thrust and turn) that is run at 50 Hz. Its Euler
angles become smooth curves, the body rates follow from them exactly, and the attitude is the
integral of those rates at about 500 Hz. Frames and signs follow contract section 1: body x
forward, y right, z down; navigation frame north-east-down; v_n = R_nb v_b.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MODEL_HZ = 50.0
FINE_HZ = 500.0
WARM_UP_S = 40.0
GRAVITY = 9.81
VEHICLES = ("work_boat", "rov", "auv", "towed_body")


@dataclass
class Track:
    """What one vehicle does, at 50 Hz, after the warm-up of the model is cut away.

    Euler angles in rad (yaw unwrapped), position in m north-east-down, velocity in m/s,
    vibration as the standard deviation of the acceleration in m/s^2.
    """

    vehicle: str
    t: Array
    euler: Array
    position: Array
    velocity: Array
    vibration: Array
    signals: dict[str, Array] = field(default_factory=dict)


def low_pass(x: Array, dt: float, tau: float) -> Array:
    """First-order low-pass of time constant ``tau`` s along the first axis, at rest at x[0]."""
    a = math.exp(-dt / max(tau, 1e-9))
    start = a * x[:1]
    y, _ = lfilter([1.0 - a], [1.0, -a], x, axis=0, zi=start)
    return np.asarray(y, dtype=np.float64)


def resonance(x: Array, dt: float, omega: float, zeta: float) -> Array:
    """Second-order resonance w^2/(s^2 + 2 z w s + w^2) by the bilinear rule, started at rest."""
    k = omega * dt / 2.0
    d0, d1, d2 = 1.0 + 2.0 * zeta * k + k * k, 2.0 * (k * k - 1.0), 1.0 - 2.0 * zeta * k + k * k
    y = lfilter(np.array([1.0, 2.0, 1.0]) * k * k / d0, [1.0, d1 / d0, d2 / d0], x)
    return np.asarray(y, dtype=np.float64)


def wander(g: np.random.Generator, n: int, dt: float, tau: float) -> Array:
    """Red noise of unit variance and correlation time ``tau`` seconds (Ornstein-Uhlenbeck)."""
    a = math.exp(-dt / tau)
    e = g.standard_normal(n) * math.sqrt(1.0 - a * a)
    e[0] = g.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -a], e), dtype=np.float64)


def telegraph(g: np.random.Generator, n: int, dt: float, dwell_s: tuple[float, float]) -> Array:
    """A switch that is 0 or 1 with dwell times drawn uniformly between two limits in seconds."""
    u = np.zeros(n)
    k, state = 0, float(g.integers(2))
    while k < n:
        m = max(1, int(g.uniform(*dwell_s) / dt))
        u[k : k + m] = state
        k, state = k + m, 1.0 - state
    return u


def poses(g: np.random.Generator, n: int, dt: float, span: float, move_s: float) -> Array:
    """A joint angle in rad that rests at random poses and moves between them smoothly."""
    y = np.empty(n)
    k, now = 0, g.uniform(-span, span)
    while k < n:
        rest = int(g.uniform(5.0, 30.0) / dt)
        y[k : k + rest] = now
        k += rest
        move, new = int(move_s * g.uniform(0.7, 1.5) / dt), g.uniform(-span, span)
        s = 0.5 - 0.5 * np.cos(np.pi * np.arange(move) / move)
        y[k : k + move] = (now + (new - now) * s)[: max(0, n - k)]
        k, now = k + move, new
    return y


def heading_programme(
    g: np.random.Generator, n: int, dt: float, rate: float, leg_s: tuple[float, float], mower: bool
) -> Array:
    """Ordered heading in rad: legs, turns, zig-zags and at least two full circles, both ways."""
    out = np.empty(n)
    k, psi, side = 0, g.uniform(0.0, 2.0 * np.pi), float(g.choice([-1.0, 1.0]))
    circles = [0.15 * n, 0.55 * n]
    while k < n:
        m = int(g.uniform(*leg_s) / dt)
        out[k : k + m] = psi
        if not mower and g.random() < 0.35:
            swing, period = g.uniform(0.25, 0.7), g.uniform(14.0, 28.0)
            s = np.sign(np.sin(2.0 * np.pi * np.arange(m) * dt / period))
            out[k : k + m] = (psi + swing * s)[: max(0, n - k)]
        k += m
        if circles and k > circles[0]:
            circles.pop(0)
            turn = side * 2.0 * np.pi * g.uniform(1.0, 1.4)
            side = -side
        elif mower:
            turn = side * np.pi * g.uniform(0.92, 1.08)
            side = -side
        else:
            turn = float(g.choice([-1.0, 1.0])) * g.uniform(0.6, 2.8)
        m = max(2, int(abs(turn) / (rate * g.uniform(0.6, 1.0)) / dt))
        out[k : k + m] = (psi + turn * np.arange(m) / m)[: max(0, n - k)]
        k, psi = k + m, psi + turn
    return out


def speed_programme(g: np.random.Generator, n: int, dt: float, lo: float, hi: float) -> Array:
    """Ordered speed in m/s: steps every 15 to 60 s between two limits."""
    out, k = np.empty(n), 0
    while k < n:
        m = int(g.uniform(15.0, 60.0) / dt)
        out[k : k + m] = g.uniform(lo, hi)
        k += m
    return out


def helm(
    order: Array, speed: Array, dt: float, gain: float, lag: float, limit: float, slew: float
) -> tuple[Array, Array, Array, Array]:
    """Autopilot, slew-limited rudder and first-order Nomoto yaw; surge of first order.

    ``gain`` in 1/s per rad of rudder, ``lag`` in s, ``limit`` in rad, ``slew`` in rad/s.
    Returns yaw (rad), yaw rate (rad/s), speed (m/s), rudder angle (rad).
    """
    n = len(order)
    psi, r, u, d = float(order[0]), 0.0, float(speed[0]), 0.0
    out = np.empty((n, 4))
    for k in range(n):
        error = float(order[k]) - psi
        want = min(limit, max(-limit, 1.6 * error - 0.9 * lag * r))
        d += min(slew * dt, max(-slew * dt, want - d))
        r += dt * (gain * d - r) / lag
        psi += dt * r
        u += dt * ((float(speed[k]) - u) / (3.0 * lag) - 0.6 * r * r * u)
        out[k] = (psi, r, u, d)
    return out[:, 0], out[:, 1], out[:, 2], out[:, 3]


def waves(
    g: np.random.Generator, t: Array, pos: Array, psi: Array, hs: float, tp: float, depth: Array
) -> tuple[Array, Array, Array]:
    """Swell seen from a moving vehicle: slope along, slope across (rad), heave (m, down positive).

    Bretschneider spectrum with 16 components of deep-water waves; under water they fade as
    exp(-k depth).
    """
    wp, main = 2.0 * np.pi / tp, g.uniform(0.0, 2.0 * np.pi)
    edges = np.linspace(0.65 * wp, 2.3 * wp, 17)
    along, across, heave = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    for lo, hi in itertools.pairwise(edges.tolist()):
        w = g.uniform(lo, hi)
        s = 0.3125 * hs**2 * wp**4 / w**5 * math.exp(-1.25 * (wp / w) ** 4)
        a, k, beta = math.sqrt(2.0 * s * (hi - lo)), w * w / GRAVITY, main + 0.3 * g.normal()
        way = pos[:, 0] * math.cos(beta) + pos[:, 1] * math.sin(beta)
        arg = w * t - k * way + g.uniform(0.0, 2.0 * np.pi)
        fade = a * np.exp(-k * np.maximum(depth, 0.0)) / (1.0 + (2.0 * k) ** 2)
        slope = k * fade * np.sin(arg)
        along += slope * np.cos(beta - psi)
        across += slope * np.sin(beta - psi)
        heave += -fade * np.cos(arg)
    return along, across, heave


def _drift(psi: Array, u: Array, vertical: Array, dt: float, current: tuple[float, float]) -> Array:
    v = np.stack([u * np.cos(psi) + current[0], u * np.sin(psi) + current[1], vertical], axis=1)
    return np.asarray(np.cumsum(v * dt, axis=0))


def _temperature(g: np.random.Generator, t: Array, load: Array, dt: float) -> Array:
    rise, tau = float(g.choice([1.0, 1.0, -1.0])) * g.uniform(4.0, 14.0), g.uniform(90.0, 350.0)
    own = low_pass(load, dt, g.uniform(40.0, 120.0)) * g.uniform(0.5, 3.0)
    return np.asarray(g.uniform(4.0, 24.0) + rise * (1.0 - np.exp(-(t - t[0]) / tau)) + own)


def simulate_track(g: np.random.Generator, vehicle: str, duration_s: float) -> Track:
    """Run the model of one vehicle for ``duration_s`` seconds and return its track."""
    dt = 1.0 / MODEL_HZ
    n = int((duration_s + WARM_UP_S + 2.0) / dt)
    t: Array = np.asarray(np.arange(n) * dt - WARM_UP_S, dtype=np.float64)
    flow = (0.25 * g.normal(), 0.25 * g.normal())
    sig: dict[str, Array] = {}
    zero = np.zeros(n)
    if vehicle == "work_boat":
        order = heading_programme(g, n, dt, g.uniform(0.10, 0.2), (15.0, 45.0), False)
        wish = speed_programme(g, n, dt, 0.4, g.uniform(2.0, 4.5))
        lag = g.uniform(1.5, 4.0)
        psi, r, u, rudder = helm(order, wish, dt, g.uniform(0.3, 0.5), lag, 0.6, 0.35)
        pos = _drift(psi, u, zero, dt, flow)
        hs, tp = g.uniform(0.6, 2.0), g.uniform(4.0, 8.0)
        along, across, heave = waves(g, t, pos, psi, hs, tp, zero)
        roll = resonance(across + 0.09 * u * r, dt, g.uniform(1.2, 2.4), g.uniform(0.08, 0.2))
        pitch = resonance(along + 0.01 * (wish - u), dt, g.uniform(1.6, 2.8), g.uniform(0.2, 0.4))
        psi = psi + 0.25 * resonance(across, dt, 1.2, 0.5)
        pos[:, 2] = heave
        thrust = 0.12 * u**2 + 0.5 * np.abs(wish - u) + 0.3 * np.abs(low_pass(along, dt, 0.5)) * u
        sig["rudder_angle_rad"] = rudder
        top_amp, top_rpm = g.uniform(12.0, 45.0), g.uniform(900.0, 1800.0)
    elif vehicle == "rov":
        order = heading_programme(g, n, dt, g.uniform(0.2, 0.4), (10.0, 30.0), g.random() < 0.5)
        wish = speed_programme(g, n, dt, 0.0, g.uniform(0.35, 0.8))
        psi, r, u, yaw = helm(order, wish, dt, g.uniform(0.5, 0.9), g.uniform(0.8, 1.4), 1.0, 3.0)
        tether = low_pass(wander(g, n, dt, 12.0), dt, 1.0)
        depth = g.uniform(8.0, 60.0) + low_pass(poses(g, n, dt, g.uniform(1.0, 3.0), 12.0), dt, 1.5)
        pos = _drift(psi, u, zero, dt, (0.3 * flow[0], 0.3 * flow[1]))
        # survey box: legs are flown back and forth, so the slow drift out of the box is taken out
        pos[:, :2] -= low_pass(pos[:, :2], dt, 60.0)
        pos[:, 2] = depth
        inspect = poses(g, n, dt, g.uniform(0.25, 0.6), 4.0)
        surge = np.gradient(u, dt)
        pitch = resonance(inspect + 0.5 * surge + 0.05 * tether, dt, g.uniform(1.4, 2.2), 0.35)
        sway = 0.25 * r * u + 0.08 * tether + 0.10 * yaw + 0.3 * poses(g, n, dt, 1.0, 3.0)
        roll = resonance(sway, dt, g.uniform(1.6, 2.6), 0.25)
        rise = np.abs(np.gradient(depth, dt))
        thrust = 1.2 * u**2 + 1.4 * np.abs(wish - u) + 0.9 * np.abs(yaw)
        sig["manipulator_angle_rad"] = poses(g, n, dt, 1.4, 3.0)
        sig["vertical_current_a"] = 1.0 + g.uniform(6.0, 14.0) * rise + 0.2 * wander(g, n, dt, 3.0)
        top_amp, top_rpm = g.uniform(6.0, 18.0), g.uniform(1200.0, 2600.0)
    elif vehicle == "auv":
        order = heading_programme(g, n, dt, g.uniform(0.12, 0.2), (25.0, 60.0), True)
        wish = speed_programme(g, n, dt, 1.0, g.uniform(1.6, 2.2))
        psi, r, u, rudder = helm(
            order, wish, dt, g.uniform(0.45, 0.7), g.uniform(1.0, 2.0), 0.4, 0.6
        )
        steep, low, high = g.uniform(0.2, 0.5), g.uniform(3.0, 8.0), g.uniform(14.0, 30.0)
        theta = np.empty(n)
        depth, now, fin, rate, way = np.empty(n), 0.5 * (low + high), zero.copy(), 0.0, -1.0
        tilt = 0.0
        for k in range(n):  # pitch by the elevator, depth by pitch: a yo-yo between two depths
            if now > high:
                way = 1.0
            elif now < low:
                way = -1.0
            fin[k] = min(0.4, max(-0.4, 1.2 * (way * steep - tilt) - 1.6 * rate))
            rate += dt * (0.6 * fin[k] - 0.5 * rate - 0.06 * tilt)
            tilt += dt * rate
            now -= dt * float(u[k]) * math.sin(tilt)
            theta[k], depth[k] = tilt, now
        pos = _drift(psi, u * np.cos(theta), zero, dt, flow)
        pos[:, 2] = depth
        along, across, _ = waves(g, t, pos, psi, g.uniform(0.5, 2.5), g.uniform(5.0, 9.0), depth)
        roll = resonance(across + 0.16 * u * r + 0.03 * u, dt, g.uniform(1.3, 2.2), 0.2)
        roll += low_pass(0.05 * wander(g, n, dt, 6.0), dt, 0.5)
        pitch = theta + resonance(along, dt, 1.5, 0.4)
        thrust = 0.25 * u**2 + 0.5 * np.abs(wish - u)
        sig["rudder_angle_rad"], sig["elevator_angle_rad"] = rudder, fin
        top_amp, top_rpm = g.uniform(4.0, 14.0), g.uniform(500.0, 1400.0)
    else:
        order = heading_programme(g, n, dt, g.uniform(0.06, 0.1), (30.0, 70.0), False)
        wish = speed_programme(g, n, dt, 1.5, 3.0)
        ship, _, u, _ = helm(order, wish, dt, g.uniform(0.18, 0.25), 5.0, 0.6, 0.1)
        behind = low_pass(low_pass(ship, dt, 5.0), dt, 5.0)
        sway = 0.5 * resonance(0.25 * wander(g, n, dt, 2.0), dt, g.uniform(0.5, 1.0), 0.2)
        psi = behind + sway
        r = np.gradient(psi, dt)
        period, steep = g.uniform(25.0, 60.0), g.uniform(0.2, 0.45)
        saw = np.arcsin(0.97 * np.sin(2.0 * np.pi * t / period + g.uniform(0, 6.28))) / 1.33
        wing = low_pass(saw * steep, dt, 1.0) + 0.01 * wander(g, n, dt, 2.0)
        pitch = resonance(wing, dt, g.uniform(1.0, 2.0), 0.35)
        roll = resonance(0.2 * u * r + 0.12 * wander(g, n, dt, 1.5), dt, g.uniform(1.0, 2.0), 0.2)
        pos = _drift(behind, u, zero, dt, flow)
        swing = -np.cumsum(u * np.sin(pitch)) * dt
        swing -= low_pass(swing, dt, 90.0)
        pos[:, 2] = 12.0 - swing.min() + swing
        thrust = 0.3 * np.abs(np.gradient(wing, dt)) * 10.0 + 0.05 * u**2
        sig["wing_angle_rad"] = wing
        top_amp, top_rpm = g.uniform(3.0, 9.0), 0.0
    load = low_pass(np.clip(thrust, 0.0, 1.5), dt, 0.25)
    motor = top_amp * (0.04 + np.clip(load, 0.0, None) ** 1.3)
    motor = motor * (1.0 + 0.03 * wander(g, n, dt, 4.0))
    rpm = top_rpm * np.sqrt(np.clip(load, 0.0, None)) * (1.0 + 0.004 * wander(g, n, dt, 8.0))
    sig["motor_current_a"], sig["speed_m_s"] = motor, u
    if top_rpm:
        sig["motor_rpm"] = rpm
    sig["temperature_c"] = _temperature(g, t, load, dt)
    sig["lamp_on"] = telegraph(g, n, dt, (8.0, 45.0))
    if vehicle == "work_boat":
        sig["pressure_kpa"] = 101.3 + 0.03 * wander(g, n, dt, 60.0)
    else:
        sig["depth_m"] = pos[:, 2].copy()
        sig["pressure_kpa"] = 101.3 + 10.05 * pos[:, 2]
        floor = g.uniform(2.0, 6.0) + pos[:, 2].max() + 0.8 * np.sin(pos[:, 0] / g.uniform(6, 20))
        sig["altitude_m"] = floor + 0.8 * np.sin(pos[:, 1] / g.uniform(6, 20)) - pos[:, 2]
    vibration = g.uniform(0.05, 0.15) + g.uniform(0.4, 1.5) * np.clip(load, 0.0, 1.5)
    cut = int((WARM_UP_S - 2.0) / dt)
    pos[:, :2] -= pos[cut, :2]
    velocity = low_pass(np.gradient(pos, dt, axis=0), dt, 0.15)
    euler = np.stack([roll, pitch, psi], axis=1)
    return Track(
        vehicle,
        t[cut:],
        euler[cut:],
        pos[cut:],
        velocity[cut:],
        vibration[cut:],
        {name: np.asarray(x[cut:]) for name, x in sig.items()},
    )


def quaternion_multiply(p: Array, q: Array) -> Array:
    """Product of quaternions (w, x, y, z) along the last axis."""
    pw, px, py, pz = np.moveaxis(p, -1, 0)
    qw, qx, qy, qz = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def quaternion_of(rotation_vector: Array) -> Array:
    """Unit quaternion of a rotation vector in rad."""
    half = 0.5 * np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * rotation_vector * np.sinc(half / np.pi)], axis=-1)


def matrix_of(q: Array) -> Array:
    """Rotation matrices R_nb of unit quaternions."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_vector_of(q: Array) -> Array:
    """Rotation vector in rad of unit quaternions with angle below pi."""
    q = q * np.where(q[..., :1] < 0.0, -1.0, 1.0)
    s = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(s, q[..., :1])
    return np.asarray(q[..., 1:] * np.where(s > 1e-12, angle / np.maximum(s, 1e-12), 2.0))


def rotate_by(v: Array, phi: Array) -> Array:
    """Exp(phi) v for rotation vectors ``phi`` in rad, row by row."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix_of(quaternion_of(phi)), v))


def integrate_attitude(start: Array, steps: Array) -> Array:
    """Chain rotation vectors (rad per step, body frame) from a start quaternion; n+1 quaternions.

    Done in blocks so that it stays exact and quick: products inside all blocks at once, then the
    block ends one after the other.
    """
    n = len(steps)
    width = max(1, math.isqrt(n))
    rows = -(-n // width)
    padded = np.zeros((rows * width, 3))
    padded[:n] = steps
    q = quaternion_of(padded).reshape(rows, width, 4)
    for k in range(1, width):
        q[:, k] = quaternion_multiply(q[:, k - 1], q[:, k])
    head = np.asarray(start, dtype=np.float64)
    heads = np.empty((rows, 4))
    for j in range(rows):
        heads[j] = head
        head = quaternion_multiply(head, q[j, -1])
        head /= np.linalg.norm(head)
    chained = quaternion_multiply(heads[:, None, :], q).reshape(-1, 4)[:n]
    return np.concatenate([start[None, :], chained])


@dataclass
class Motion:
    """True motion on a fine grid of about 500 Hz, and which fine points are samples.

    ``t`` in s (0 at the first sample), ``q`` and ``r_nb`` the attitude, ``w`` the body rate in
    rad/s, ``force`` the specific force in m/s^2 (level and at rest: z = -9.81), ``position`` in m.
    ``step_rate`` is the rotation vector of the step that ends at each sample divided by its length.
    """

    vehicle: str
    rate_hz: float
    factor: int
    t: Array
    q: Array
    r_nb: Array
    w: Array
    force: Array
    position: Array
    vibration: Array
    signals: dict[str, Array]
    index: npt.NDArray[np.int64]
    step_rate: Array

    @property
    def dt_fine(self) -> float:
        """Length of a fine step in s."""
        return float(1.0 / (self.rate_hz * self.factor))

    def step_mean(self, x: Array) -> Array:
        """Mean of a fine series over the step that ends at each sample (trapezoid rule)."""
        total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(0.5 * (x[1:] + x[:-1]), 0)])
        return np.asarray((total[self.index] - total[self.index - self.factor]) / self.factor)


def build_motion(g: np.random.Generator, vehicle: str, duration_s: float, rate_hz: float) -> Motion:
    """Simulate a vehicle and integrate its true attitude at about 500 Hz."""
    track = simulate_track(g, vehicle, duration_s)
    factor = max(8, round(FINE_HZ / rate_hz))
    lead = math.ceil(0.3 * rate_hz)
    samples = int(duration_s * rate_hz)
    fine = 1.0 / (rate_hz * factor)
    ticks = np.arange((samples - 1 + lead) * factor + 1) - lead * factor
    t: Array = np.asarray(ticks * fine, dtype=np.float64)
    curve = CubicSpline(track.t, track.euler)
    middle = t[:-1] + 0.5 * fine

    def body_rate(at: Array) -> Array:
        phi, theta, _ = curve(at).T
        dphi, dtheta, dpsi = curve(at, 1).T
        return np.stack(
            [
                dphi - dpsi * np.sin(theta),
                dtheta * np.cos(phi) + dpsi * np.sin(phi) * np.cos(theta),
                -dtheta * np.sin(phi) + dpsi * np.cos(phi) * np.cos(theta),
            ],
            axis=1,
        )

    phi, theta, psi = curve(t[0])
    start = quaternion_of(np.array([0.0, 0.0, psi]))
    start = quaternion_multiply(start, quaternion_of(np.array([0.0, theta, 0.0])))
    start = quaternion_multiply(start, quaternion_of(np.array([phi, 0.0, 0.0])))
    q = integrate_attitude(start, body_rate(middle) * fine)
    r_nb = matrix_of(q)
    accel = low_pass(np.gradient(track.velocity, 1.0 / MODEL_HZ, axis=0), 1.0 / MODEL_HZ, 0.15)
    accel[:, 2] -= GRAVITY
    force_n = np.stack([np.interp(t, track.t, accel[:, i]) for i in range(3)], axis=1)
    index = (np.arange(samples) + lead) * factor
    conj = q[index - factor] * np.array([1.0, -1.0, -1.0, -1.0])
    step = rotation_vector_of(quaternion_multiply(conj, q[index])) * rate_hz
    return Motion(
        vehicle,
        rate_hz,
        factor,
        t,
        q,
        r_nb,
        body_rate(t),
        np.asarray(np.einsum("kji,kj->ki", r_nb, force_n)),
        np.stack([np.interp(t, track.t, track.position[:, i]) for i in range(3)], axis=1),
        np.interp(t, track.t, track.vibration),
        {name: np.interp(t, track.t, x) for name, x in track.signals.items()},
        index,
        step,
    )
