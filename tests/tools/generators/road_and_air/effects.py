"""The concealed effects: every identifier of contract section 5, and physics none of them names.

An effect is made for one scene with its own random direction, time and shape; only its ``size``
stays free so that the caller can set how visible it is.  Sizes ``low`` to ``high`` follow the
"typical size" columns of dossier section 2 and are in SI units or gauss (1 mG = 0.001 gauss).
A magnetic effect changes the magnetometer only, a gyro effect the gyro only (contract section 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from generators.road_and_air.motion import (
    GRAVITY,
    Array,
    Motion,
    Rng,
    low_pass,
    quat_conjugate,
    quat_from_vector,
    quat_multiply,
    quat_to_matrix,
    ring,
    rotation_vector,
    wander,
)

MG = 1e-3
DEG = math.pi / 180.0
AXES = "xyz"


@dataclass
class Scene:
    """A motion, the Earth field (gauss, north-east-down), the sensor's iron, bias and noise."""

    motion: Motion
    field_ned: Array
    soft_iron: Array
    hard_iron: Array
    gyro_bias: Array
    sigma_mag: float
    sigma_gyro: float
    body: Array = field(init=False)
    rate: Array = field(init=False)

    def __post_init__(self) -> None:
        """Work out the clean body field (fine grid, gauss) and the step rates (rad/s) once."""
        self.body = np.einsum("nij,i->nj", self.motion.rotation, self.field_ned)
        self.rate = self.motion.step_rate()

    @property
    def duration(self) -> float:
        """Length of the recording in seconds."""
        return float(self.motion.time_s[-1])


@dataclass
class Readings:
    """What the hooks change on the way from the world to the logged row."""

    time: Array
    world: Array
    body: Array
    mag: Array
    mag_k: Array
    gyro_k: Array
    keep: Any


Hook = Callable[[Readings, float], None]
Numbers = dict[str, float]


@dataclass
class Effect:
    """One concealed effect with free size; ``stage`` says where in the chain its hook acts.

    ``fast`` marks effects of single steps, which the plain visibility overrates (a gyro error that
    cancels a step later): their visibility WITHOUT attitude is put into the wanted range instead.
    Stages: world (field in the world), body (field in sensor axes), iron and response (analogue
    reading on the fine grid), sampled (reading at samples), gyro, digit (after noise), table.
    """

    name: str
    frame: str
    stage: str
    low: float
    high: float
    hook: Hook
    parameters: Callable[[float], Numbers]
    what: str
    onset: float | None = None
    equivalent: Callable[[float], tuple[Array, Array]] | None = None
    free_size: bool = False
    fast: bool = False


Maker = Callable[[Scene, Rng], Effect | None]
LIBRARY: dict[str, Maker] = {}
OUTSIDE: dict[str, Maker] = {}


def library(maker: Maker) -> Maker:
    """Register an effect under its identifier of contract section 5."""
    LIBRARY[maker.__name__] = maker
    return maker


def outside(maker: Maker) -> Maker:
    """Register physics that no identifier names."""
    OUTSIDE[f"outside:{maker.__name__}"] = maker
    return maker


def unit(rng: Rng) -> Array:
    """A random direction."""
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def symmetric(rng: Rng, diagonal: float = 1.0) -> Array:
    """A random symmetric matrix, largest singular value 1; ``diagonal`` weighs the diagonal."""
    m = rng.standard_normal((3, 3))
    m = 0.5 * (m + m.T)
    m = m * (1.0 - np.eye(3)) + diagonal * m * np.eye(3)
    return np.asarray(m / np.linalg.norm(m, 2))


def vector(name: str, v: Array, measure: str) -> Numbers:
    """Three named numbers, one an axis."""
    return {f"{name}_{a}_{measure}": float(x) for a, x in zip(AXES, v, strict=True)}


def matrix(name: str, m: Array, measure: str) -> Numbers:
    """Nine named numbers, row by row."""
    return {
        f"{name}_{a}{b}_{measure}": float(m[i, j])
        for i, a in enumerate(AXES)
        for j, b in enumerate(AXES)
    }


def body_source(
    name: str,
    shape: Array,
    v: Array,
    low: float,
    high: float,
    label: str,
    measure: str,
    what: str,
    onset: float | None = None,
    extra: Numbers | None = None,
) -> Effect:
    """A source fixed to the vehicle: size * v * shape(t) is added to the reading (fine grid)."""

    def hook(r: Readings, size: float) -> None:
        r.mag += size * shape[:, None] * v

    def numbers(size: float) -> Numbers:
        return vector(label, size * v, measure) | (extra or {})

    return Effect(name, "sensor", "iron", low, high, hook, numbers, what, onset)


def world_source(
    name: str,
    shape: Array,
    v: Array,
    low: float,
    high: float,
    label: str,
    measure: str,
    what: str,
    onset: float | None = None,
    extra: Numbers | None = None,
) -> Effect:
    """A source outside the vehicle: size * v * shape(t) is added to the north-east-down field."""

    def hook(r: Readings, size: float) -> None:
        r.world += size * shape[:, None] * v

    def numbers(size: float) -> Numbers:
        return vector(label, size * v, measure) | (extra or {})

    return Effect(name, "world", "world", low, high, hook, numbers, what, onset)


def gyro_source(
    name: str,
    term: Array,
    low: float,
    high: float,
    numbers: Callable[[float], Numbers],
    what: str,
    onset: float | None = None,
    frame: str = "gyro",
) -> Effect:
    """An error of the gyro: size * term (samples x 3, rad/s per unit of size) is added."""

    def hook(r: Readings, size: float) -> None:
        r.gyro_k += size * term

    return Effect(name, frame, "gyro", low, high, hook, numbers, what, onset)


def moment(s: Scene, rng: Rng) -> float:
    """A time between 20 and 80 % of the recording."""
    return float(s.duration * rng.uniform(0.2, 0.8))


# ---- dossier section 2a: on the sensor -------------------------------------------------------


@library
def hard_iron_step(s: Scene, rng: Rng) -> Effect | None:
    """M1: a magnetised part is put on or moved, 1 to 300 mG."""
    at = moment(s, rng)
    shape = (s.motion.time_s >= at).astype(float)
    return body_source(
        "hard_iron_step",
        shape,
        unit(rng),
        1 * MG,
        300 * MG,
        "step",
        "gauss",
        "A part with permanent magnetism moved on the vehicle.",
        at,
    )


@library
def hard_iron_drift(s: Scene, rng: Rng) -> Effect | None:
    """M2: slow change of 0.1 to 5 mG an hour, straight or relaxing like ln(1 + t/t1)."""
    t, scale = s.motion.time_s, s.duration / 3600.0
    shape: Array = t / 3600.0
    extra: Numbers = {}
    if rng.random() < 0.4:
        t1 = float(rng.uniform(10.0, 60.0))
        shape = scale * np.log1p(t / t1) / math.log1p(s.duration / t1)
        extra = {"relaxation_s": t1}
    return body_source(
        "hard_iron_drift",
        shape,
        unit(rng),
        0.1 * MG,
        5 * MG,
        "mean_slope",
        "gauss_per_h",
        "The hard iron drifts slowly.",
        extra=extra,
    )


@library
def soft_iron_step(s: Scene, rng: Rng) -> Effect | None:
    """M3: the soft iron changes by 0.5 to 5 % at one time."""
    at, change = moment(s, rng), symmetric(rng)
    after = (s.motion.time_s >= at).astype(float)[:, None]

    def hook(r: Readings, size: float) -> None:
        r.mag += size * after * (r.body @ change)

    return Effect(
        "soft_iron_step",
        "sensor",
        "iron",
        0.005,
        0.05,
        hook,
        lambda size: matrix("soft_iron_change", size * change, "ratio"),
        "Steel that is magnetised by the Earth field moved on the vehicle.",
        at,
    )


@library
def motor_current_field(s: Scene, rng: Rng) -> Effect | None:
    """M4: field of the current in the power lead, 0.1 to 5 mG an ampere."""
    if "motor_current_a" not in s.motion.channels:
        return None
    return body_source(
        "motor_current_field",
        s.motion.channels["motor_current_a"],
        unit(rng),
        0.1 * MG,
        5 * MG,
        "field_per_ampere",
        "gauss_per_a",
        "The current in the motor lead makes a field.",
    )


@library
def current_derivative_field(s: Scene, rng: Rng) -> Effect | None:
    """M5: field that follows dI/dt (loops and eddy currents): 1 to 10 % of M4 per second."""
    if "motor_current_a" not in s.motion.channels:
        return None
    smooth = low_pass(s.motion.channels["motor_current_a"], 0.02, s.motion.time_s[1])
    slope = np.gradient(smooth, s.motion.time_s[1])
    return body_source(
        "current_derivative_field",
        slope,
        unit(rng),
        0.001 * MG,
        0.5 * MG,
        "field_per_ampere_per_second",
        "gauss_s_per_a",
        "Changes of the motor current induce a field.",
    )


@library
def speed_field(s: Scene, rng: Rng) -> Effect | None:
    """M6: field that follows the speed, 20 to 250 nT at full speed."""
    if "speed_m_s" not in s.motion.channels:
        return None
    speed = s.motion.channels["speed_m_s"]
    top = float(speed.max())
    return body_source(
        "speed_field",
        speed / top,
        unit(rng),
        0.2 * MG,
        2.5 * MG,
        "field_at_top_speed",
        "gauss",
        "A field grows with the speed.",
        extra={"top_speed_m_s": top},
    )


@library
def ac_interference(s: Scene, rng: Rng) -> Effect | None:
    """M7, M8: mains (50 or 60 Hz) or an inverter line of steady frequency, 0.1 to 20 mG."""
    mains = s.motion.vehicle in ("robot", "hand")
    hertz = float(
        rng.choice([50.0, 60.0]) + rng.uniform(-0.09, 0.09) if mains else rng.uniform(90.0, 420.0)
    )
    v, phase = unit(rng), rng.uniform(0, 2 * np.pi)
    rate = s.motion.rate_hz
    alias = abs(hertz - rate * round(hertz / rate))
    wave = np.cos(2 * np.pi * hertz * s.motion.time_s[s.motion.index] + phase)[:, None]

    def hook(r: Readings, size: float) -> None:
        r.mag_k += size * wave * v

    return Effect(
        "ac_interference",
        "sensor",
        "sampled",
        0.1 * MG,
        20 * MG,
        hook,
        lambda size: (
            vector("amplitude", size * v, "gauss") | {"frequency_hz": hertz, "alias_hz": alias}
        ),
        "An alternating current nearby is sampled with the field.",
    )


@library
def sync_pulses(s: Scene, rng: Rng) -> Effect | None:
    """M9: transmit pulses of the radio, 0.2 to 5 mG while it sends."""
    return body_source(
        "sync_pulses",
        s.motion.channels["radio_tx"],
        unit(rng),
        0.2 * MG,
        5 * MG,
        "pulse",
        "gauss",
        "The radio's transmit pulses disturb the field.",
    )


@library
def mag_bias_temperature(s: Scene, rng: Rng) -> Effect | None:
    """M10: magnetometer offset of 0.01 to 0.5 mG a degree."""
    heat = s.motion.channels["temperature_c"]
    return body_source(
        "mag_bias_temperature",
        heat - heat[0],
        unit(rng),
        0.01 * MG,
        0.5 * MG,
        "offset_per_degree",
        "gauss_per_c",
        "The magnetometer's offset follows its temperature.",
        extra={"reference_c": float(heat[0])},
    )


@library
def mag_scale_temperature(s: Scene, rng: Rng) -> Effect | None:
    """M11: sensitivity of each axis changes by 0.03 to 0.3 % a degree."""
    heat = s.motion.channels["temperature_c"]
    rise = (heat - heat[0])[:, None]
    gains = rng.choice([-1.0, 1.0]) * (1.0 + 0.4 * rng.uniform(-1, 1, 3)) / 1.4

    def hook(r: Readings, size: float) -> None:
        r.mag += size * rise * gains * r.body

    return Effect(
        "mag_scale_temperature",
        "sensor",
        "iron",
        3e-4,
        3e-3,
        hook,
        lambda size: vector("gain_per_degree", size * gains, "ratio_per_c"),
        "The magnetometer's sensitivity follows its temperature.",
    )


@library
def mag_cross_axis(s: Scene, rng: Rng) -> Effect | None:
    """M12: anisotropic-resistance cross term 0.5 G * c_i (m_i / 0.5)(m_j / 0.5), 0.1 to 1 %."""
    v = unit(rng)

    def hook(r: Readings, size: float) -> None:
        r.mag += 0.5 * size * v * (r.mag / 0.5) * (np.roll(r.mag, -1, axis=1) / 0.5)

    return Effect(
        "mag_cross_axis",
        "sensor",
        "response",
        1e-3,
        1e-2,
        hook,
        lambda size: vector("cross_term_at_half_gauss", size * v, "ratio"),
        "The magnetometer's axes mix in proportion to the field across.",
    )


@library
def mag_nonlinearity(s: Scene, rng: Rng) -> Effect | None:
    """M13: cubic error 0.5 G * c_i (m_i / 0.5)^3; up to 0.1 % of 2.5 G, that is 0.5 % of 0.5 G."""
    v = unit(rng)

    def hook(r: Readings, size: float) -> None:
        r.mag += 0.5 * size * v * (r.mag / 0.5) ** 3

    return Effect(
        "mag_nonlinearity",
        "sensor",
        "response",
        2e-4,
        5e-3,
        hook,
        lambda size: vector("cubic_at_half_gauss", size * v, "ratio"),
        "The magnetometer is not linear at large fields.",
    )


@library
def mag_saturation(s: Scene, rng: Rng) -> Effect | None:
    """M14: readings are clipped at a range below the largest field by up to 150 mG."""
    top = float(np.abs(s.body @ s.soft_iron + s.hard_iron).max())

    def hook(r: Readings, size: float) -> None:
        np.clip(r.mag_k, -(top - size), top - size, out=r.mag_k)

    return Effect(
        "mag_saturation",
        "sensor",
        "digit",
        2 * MG,
        150 * MG,
        hook,
        lambda size: {"limit_gauss": top - size},
        "The magnetometer clips at the end of its range.",
    )


@library
def mag_quantisation(s: Scene, rng: Rng) -> Effect | None:
    """M15: coarse steps of the digital output, 0.1 to 1.5 mG and wider than the noise."""
    low = max(0.1 * MG, 1.5 * s.sigma_mag)
    if low > 1.5 * MG:
        return None

    def hook(r: Readings, size: float) -> None:
        r.mag_k[:] = np.round(r.mag_k / size) * size

    return Effect(
        "mag_quantisation",
        "sensor",
        "digit",
        low,
        1.5 * MG,
        hook,
        lambda size: {"step_gauss": size},
        "The magnetometer's output has coarse steps.",
    )


def play(x: Array, radius: Array) -> Array:
    """Play operator (backlash) with one radius a column; it starts centred."""
    out = np.empty_like(x)
    for axis in range(x.shape[1]):
        r, p = float(radius[axis]), float(x[0, axis])
        column = []
        for value in x[:, axis].tolist():
            p = max(value - r, min(p, value + r))
            column.append(p)
        out[:, axis] = column
    return out


@library
def hysteresis(s: Scene, rng: Rng) -> Effect | None:
    """M16: nearby iron with play of 0.1 to 3 mG: the error depends on the turning direction."""
    v = rng.uniform(0.3, 1.0, 3)

    def hook(r: Readings, size: float) -> None:
        h = r.body[s.motion.index]
        r.mag_k += play(h, size * v) - h

    return Effect(
        "hysteresis",
        "sensor",
        "sampled",
        0.1 * MG,
        3 * MG,
        hook,
        lambda size: vector("play_radius", size * v, "gauss"),
        "Iron near the sensor keeps part of its magnetism when the field turns.",
    )


@library
def eddy_current(s: Scene, rng: Rng) -> Effect | None:
    """M17: D = E dh/dt with E unlike a multiple of one; 0.1 to 20 mG at 0.5 rad/s (0.4-80 ms)."""
    e = rng.standard_normal((3, 3))
    e -= np.eye(3) * np.trace(e) / 3.0
    e /= np.linalg.norm(e, 2)

    def hook(r: Readings, size: float) -> None:
        r.mag += size * np.gradient(r.body, s.motion.time_s[1], axis=0) @ e.T

    return Effect(
        "eddy_current",
        "sensor",
        "iron",
        4e-4,
        0.08,
        hook,
        lambda size: matrix("eddy", size * e, "s"),
        "Currents in metal plates answer the turning field.",
    )


@library
def viscous_magnetisation(s: Scene, rng: Rng) -> Effect | None:
    """M18: D = dA (lagged h - h), 0.1 to 5 mG, relaxing over 10 to 120 s."""
    tau, change = float(rng.uniform(10.0, 60.0)), symmetric(rng)
    strength = float(np.linalg.norm(s.field_ned))

    def hook(r: Readings, size: float) -> None:
        late = low_pass(r.body, tau, s.motion.time_s[1]) - r.body
        r.mag += size / strength * late @ change

    return Effect(
        "viscous_magnetisation",
        "sensor",
        "iron",
        0.1 * MG,
        5 * MG,
        hook,
        lambda size: (
            matrix("susceptibility", size / strength * change, "ratio") | {"relaxation_s": tau}
        ),
        "Steel takes up the field slowly after a turn.",
    )


def delayed(x: Array, seconds: float, dt: float) -> Array:
    """The fine-grid columns as they were ``seconds`` earlier (linear between fine points)."""
    t = np.arange(len(x)) * dt
    return np.stack([np.interp(t - seconds, t, c) for c in x.T], axis=1)


@library
def mag_time_lag(s: Scene, rng: Rng) -> Effect | None:
    """M19: the magnetometer reading is 1 to 60 ms old."""

    def hook(r: Readings, size: float) -> None:
        r.mag = delayed(r.mag, size, float(s.motion.time_s[1]))

    return Effect(
        "mag_time_lag",
        "sensor",
        "response",
        1e-3,
        0.06,
        hook,
        lambda size: {"lag_s": size},
        "The magnetometer reading is late.",
    )


@library
def mag_low_pass(s: Scene, rng: Rng) -> Effect | None:
    """M20: first-order filter of 5 to 50 ms in the magnetometer."""

    def hook(r: Readings, size: float) -> None:
        r.mag = low_pass(r.mag, size, float(s.motion.time_s[1]))

    return Effect(
        "mag_low_pass",
        "sensor",
        "response",
        5e-3,
        0.05,
        hook,
        lambda size: {"time_constant_s": size},
        "The magnetometer filters its readings.",
    )


@library
def mag_sample_hold(s: Scene, rng: Rng) -> Effect | None:
    """M21: the magnetometer is renewed every 20 to 100 ms only; rows between repeat it."""
    options = [n for n in range(2, 21) if 0.02 <= n * s.motion.step_s <= 0.1]
    if not options:
        return None
    every = int(rng.choice(options))
    rows = np.arange(len(s.rate)) // every * every

    def hook(r: Readings, size: float) -> None:
        r.mag_k[:] = r.mag_k[rows]

    return Effect(
        "mag_sample_hold",
        "sensor",
        "digit",
        1.0,
        1.0,
        hook,
        lambda size: {"hold_s": every * s.motion.step_s},
        "The magnetometer is read less often than rows are written.",
    )


@library
def flexible_mount(s: Scene, rng: Rng) -> Effect | None:
    """M22: the magnetometer's mount bends by 0.1 to 2 degrees a g; straight when level at rest."""
    c = rng.standard_normal((3, 3))
    c /= np.linalg.norm(c, 2)
    load = low_pass(s.motion.force, 0.03, float(s.motion.time_s[1])) / GRAVITY
    bend = (load + np.array([0.0, 0.0, 1.0])) @ c.T

    def hook(r: Readings, size: float) -> None:
        turn = quat_to_matrix(quat_from_vector(size * bend))
        r.body = np.einsum("nij,nj->ni", turn, r.body)

    return Effect(
        "flexible_mount",
        "sensor",
        "body",
        0.1 * DEG,
        2 * DEG,
        hook,
        lambda size: matrix("bend_per_g", size * c, "rad"),
        "The magnetometer's mount bends under load.",
    )


@library
def moving_iron(s: Scene, rng: Rng) -> Effect | None:
    """M23: iron on the steering wheel, arm or gimbal, e_c cos psi + e_s sin psi, 0.5 to 50 mG."""
    if s.motion.joint is None:
        return None
    psi = s.motion.channels[s.motion.joint]
    e_c, e_s = unit(rng), unit(rng)

    def hook(r: Readings, size: float) -> None:
        r.mag += size * (np.cos(psi)[:, None] * e_c + np.sin(psi)[:, None] * e_s)

    return Effect(
        "moving_iron",
        "sensor",
        "iron",
        0.5 * MG,
        50 * MG,
        hook,
        lambda size: vector("cosine", size * e_c, "gauss") | vector("sine", size * e_s, "gauss"),
        "Iron turns with a joint of the vehicle.",
    )


@library
def switched_device(s: Scene, rng: Rng) -> Effect | None:
    """M24: a fan, gripper, lamp or display makes 0.2 to 20 mG while it is on."""
    return body_source(
        "switched_device",
        s.motion.channels[s.motion.switch],
        unit(rng),
        0.2 * MG,
        20 * MG,
        "field_when_on",
        "gauss",
        "A device makes a field while it is switched on.",
    )


@library
def rotor_field(s: Scene, rng: Rng) -> Effect | None:
    """M25: a magnetised rotor or a tyre's steel belt turns its field with the shaft, 0.1-10 mG."""
    if s.motion.wheel is None:
        return None
    angle = np.cumsum(s.motion.channels[s.motion.wheel]) * s.motion.time_s[1]
    angle = angle[s.motion.index] + rng.uniform(0, 2 * np.pi)
    e_c = unit(rng)
    e_s = np.cross(e_c, unit(rng))
    e_s /= np.linalg.norm(e_s)

    def hook(r: Readings, size: float) -> None:
        r.mag_k += size * (np.cos(angle)[:, None] * e_c + np.sin(angle)[:, None] * e_s)

    return Effect(
        "rotor_field",
        "sensor",
        "sampled",
        0.1 * MG,
        10 * MG,
        hook,
        lambda size: vector("cosine", size * e_c, "gauss") | vector("sine", size * e_s, "gauss"),
        "A magnetised wheel or rotor turns near the sensor.",
    )


# ---- dossier section 2b: in the world --------------------------------------------------------


@library
def field_gradient(s: Scene, rng: Rng) -> Effect | None:
    """W1: field G p with G symmetric and traceless, 0.02 to 2 mG/m out of doors, to 50 indoors."""
    if s.motion.vehicle == "car":
        return None
    g = symmetric(rng)
    g -= np.eye(3) * np.trace(g) / 3.0
    g /= np.linalg.norm(g, 2)
    p = s.motion.position - s.motion.position[0]

    def hook(r: Readings, size: float) -> None:
        r.world += size * p @ g

    return Effect(
        "field_gradient",
        "world",
        "world",
        0.02 * MG,
        (2 if s.motion.vehicle == "copter" else 50) * MG,
        hook,
        lambda size: matrix("gradient", size * g, "gauss_per_m"),
        "The field of the place changes from point to point.",
    )


def dipole(r: Array, mu: Array) -> Array:
    """Dipole field (3 r (mu.r) / r^2 - mu) / r^3 at offsets ``r`` (m), not scaled."""
    distance = np.linalg.norm(r, axis=1, keepdims=True)
    along = (r @ mu)[:, None]
    return np.asarray((3.0 * r * along / distance**2 - mu) / distance**3)


@library
def field_anomaly(s: Scene, rng: Rng) -> Effect | None:
    """W2: a dipole beside the path (manhole, parked car, rebar), 1 to 500 mG at the nearest."""
    away = {"car": (2.0, 8.0), "robot": (0.7, 3.0), "copter": (3.0, 10.0), "hand": (0.6, 1.5)}
    near = s.motion.position[int(rng.uniform(0.2, 0.8) * len(s.motion.position))]
    side = unit(rng)
    side[2] = abs(side[2])
    place = near + rng.uniform(*away[s.motion.vehicle]) * side
    offset = s.motion.position - place
    distance = np.linalg.norm(offset, axis=1)
    if distance.min() < 0.4:
        return None
    mu = unit(rng)
    shape = dipole(offset, mu)
    strength = np.linalg.norm(shape, axis=1)
    peak = float(strength.max())
    at = float(s.motion.time_s[int(np.argmax(strength))])

    def hook(r: Readings, size: float) -> None:
        r.world += size / peak * shape

    return Effect(
        "field_anomaly",
        "world",
        "world",
        1 * MG,
        500 * MG,
        hook,
        lambda size: (
            vector("moment", size / peak * mu, "gauss_m3")
            | vector("place_ned", place, "m")
            | {"peak_gauss": size, "peak_time_s": at}
        ),
        "A magnetic object stands beside the path.",
        None,
    )


@library
def geomagnetic_drift(s: Scene, rng: Rng) -> Effect | None:
    """W3: the Earth field changes during a storm, some mG within minutes."""
    t, dt = s.motion.time_s, float(s.motion.time_s[1])
    if rng.random() < 0.5:
        shape: Array = t / s.duration
    else:
        coarse = np.arange(0.0, s.duration + 2.0, 1.0)
        shape = np.interp(t, coarse, wander(rng, len(coarse), 1.0, s.duration / 8.0, 0.5))
        shape = low_pass(shape, 2.0, dt)
    return world_source(
        "geomagnetic_drift",
        shape,
        unit(rng),
        0.1 * MG,
        8 * MG,
        "change",
        "gauss",
        "The Earth field changes with time.",
    )


@library
def altitude_field(s: Scene, rng: Rng) -> Effect | None:
    """W4: field of rock or rebar that fades with altitude, 0.1 to 50 mG at the lowest point."""
    if s.motion.vehicle == "hand":
        return None
    high = s.motion.channels["altitude_m"] - s.motion.channels["altitude_m"].min()
    scale = float(rng.uniform(0.3, 1.0) * high.max())
    return world_source(
        "altitude_field",
        np.exp(-high / scale),
        unit(rng),
        0.1 * MG,
        50 * MG,
        "field_at_lowest",
        "gauss",
        "The ground's field fades with altitude.",
        extra={"scale_height_m": scale},
    )


@library
def field_step(s: Scene, rng: Rng) -> Effect | None:
    """W7: the recording starts beside iron that is then left; 1 to 100 mG, fixed to the world."""
    at = moment(s, rng)
    shape = (s.motion.time_s >= at).astype(float)
    return world_source(
        "field_step",
        shape,
        unit(rng),
        1 * MG,
        100 * MG,
        "step",
        "gauss",
        "The outside field changes at one moment.",
        at,
    )


# ---- dossier section 2c: gyro ----------------------------------------------------------------


@library
def gyro_scale(s: Scene, rng: Rng) -> Effect | None:
    """G1: scale error of 0.05 to 1 % a axis."""
    v = rng.uniform(0.4, 1.0, 3) * rng.choice([-1.0, 1.0], 3)
    return gyro_source(
        "gyro_scale",
        s.rate * v,
        5e-4,
        1e-2,
        lambda size: vector("scale_error", size * v, "ratio"),
        "The gyro's scale is wrong.",
    )


@library
def gyro_nonorthogonality(s: Scene, rng: Rng) -> Effect | None:
    """G2: symmetric cross-axis terms of 0.05 to 0.5 %."""
    m = symmetric(rng, 0.0)
    return gyro_source(
        "gyro_nonorthogonality",
        s.rate @ m,
        5e-4,
        5e-3,
        lambda size: matrix("cross_axis", size * m, "ratio"),
        "The gyro's axes are not square.",
    )


@library
def mag_gyro_misalignment(s: Scene, rng: Rng) -> Effect | None:
    """G3: the gyro's axes are turned by 0.05 to 3 degrees against the magnetometer's."""
    v = unit(rng)

    def hook(r: Readings, size: float) -> None:
        turn = quat_to_matrix(quat_from_vector(size * v))
        r.gyro_k += s.rate @ turn.T - s.rate

    return Effect(
        "mag_gyro_misalignment",
        "gyro",
        "gyro",
        0.05 * DEG,
        3 * DEG,
        hook,
        lambda size: vector("misalignment", size * v, "rad"),
        "Gyro and magnetometer are mounted at a small angle.",
    )


@library
def gyro_g_sensitivity(s: Scene, rng: Rng) -> Effect | None:
    """G4: rate error of 0.003 to 0.1 deg/s a g of specific force."""
    m = rng.standard_normal((3, 3))
    m /= np.linalg.norm(m, 2)
    force = s.motion.step_mean(s.motion.force) / GRAVITY
    return gyro_source(
        "gyro_g_sensitivity",
        force @ m.T,
        0.003 * DEG,
        0.1 * DEG,
        lambda size: matrix("rate_per_g", size * m, "rad_s"),
        "The gyro answers to acceleration.",
    )


@library
def vibration_rectification(s: Scene, rng: Rng) -> Effect | None:
    """G5: rate error that follows the variance of the acceleration, 0.001 to 0.1 deg/s at most."""
    if s.motion.vehicle == "hand":
        return None
    power = s.motion.step_mean(s.motion.vibration_g**2)
    top = float(power.max())
    v = unit(rng)
    return gyro_source(
        "vibration_rectification",
        power[:, None] / top * v,
        0.001 * DEG,
        0.1 * DEG,
        lambda size: vector("rate_per_g_squared", size / top * v, "rad_s"),
        "Vibration shifts the gyro's bias.",
    )


@library
def gyro_bias_temperature(s: Scene, rng: Rng) -> Effect | None:
    """G6: gyro bias of 0.001 to 0.05 deg/s a degree."""
    heat = s.motion.step_mean(s.motion.channels["temperature_c"])
    v = unit(rng)
    return gyro_source(
        "gyro_bias_temperature",
        (heat - heat[0])[:, None] * v,
        0.001 * DEG,
        0.05 * DEG,
        lambda size: vector("bias_per_degree", size * v, "rad_s_c"),
        "The gyro's bias follows its temperature.",
    )


@library
def gyro_bias_drift(s: Scene, rng: Rng) -> Effect | None:
    """G7: random walk of the gyro bias; ends up 0.001 to 0.05 deg/s rms away."""
    walk = np.cumsum(rng.standard_normal((len(s.rate), 3)), axis=0)
    walk /= math.sqrt(float(np.mean(walk[-1] ** 2)) + float(np.mean(walk**2)))
    return gyro_source(
        "gyro_bias_drift",
        walk,
        0.001 * DEG,
        0.05 * DEG,
        lambda size: {"drift_rms_rad_s": size * float(np.std(walk))},
        "The gyro's bias wanders.",
    )


@library
def gyro_bias_step(s: Scene, rng: Rng) -> Effect | None:
    """G8: the gyro bias jumps by 0.005 to 0.2 deg/s (shock, re-zero on board)."""
    at, v = moment(s, rng), unit(rng)
    after = (s.motion.time_s[s.motion.index] >= at).astype(float)[:, None]
    return gyro_source(
        "gyro_bias_step",
        after * v,
        0.005 * DEG,
        0.2 * DEG,
        lambda size: vector("step", size * v, "rad_s"),
        "The gyro's bias jumps.",
        at,
    )


@library
def gyro_nonlinearity(s: Scene, rng: Rng) -> Effect | None:
    """G9: error c |w| w; 0.02 to 1 % of the rate at 1 rad/s."""
    v = unit(rng)
    return gyro_source(
        "gyro_nonlinearity",
        np.abs(s.rate) * s.rate * v,
        2e-4,
        1e-2,
        lambda size: vector("quadratic", size * v, "s"),
        "The gyro's error grows with the square of the rate.",
    )


@library
def gyro_saturation(s: Scene, rng: Rng) -> Effect | None:
    """G10: rates are clipped below the fastest turn (a small range set on the device)."""
    top = float(np.abs(s.rate + s.gyro_bias).max())
    if top < 0.4:
        return None

    def hook(r: Readings, size: float) -> None:
        np.clip(r.gyro_k, -(top - size), top - size, out=r.gyro_k)

    return Effect(
        "gyro_saturation",
        "gyro",
        "digit",
        0.003,
        0.5 * top,
        hook,
        lambda size: {"limit_rad_s": top - size},
        "The gyro clips at the end of its range.",
    )


@library
def earth_rotation(s: Scene, rng: Rng) -> Effect | None:
    """G12: the Earth's 72.92 microrad/s, which the model of contract section 1 leaves out."""
    latitude = float(rng.uniform(-65.0, 65.0) * DEG)
    spin = 7.292115e-5
    ned = np.array([math.cos(latitude), 0.0, -math.sin(latitude)])
    term = np.einsum("nij,i->nj", s.motion.rotation[s.motion.index], ned)
    return gyro_source(
        "earth_rotation",
        term,
        spin,
        spin,
        lambda size: {"rate_rad_s": size, "latitude_rad": latitude},
        "The gyro feels the Earth turn.",
    )


@library
def gyro_integration(s: Scene, rng: Rng) -> Effect | None:
    """G13: the rate at the end of the step is logged, not the mean over the step."""
    end = 0.5 * (
        s.motion.omega[s.motion.index]
        + s.motion.omega[np.minimum(s.motion.index + 1, len(s.motion.omega) - 1)]
    )
    effect = gyro_source(
        "gyro_integration",
        end - s.rate,
        1.0,
        1.0,
        lambda size: {"equivalent_lead_s": 0.5 * s.motion.step_s},
        "The gyro logs the rate at an instant instead of the mean.",
    )
    effect.fast = True
    return effect


@library
def gyro_startup(s: Scene, rng: Rng) -> Effect | None:
    """G14: after power-on the bias decays like exp(-t/tau) from 0.01 to 0.1 deg/s."""
    tau, v = float(rng.uniform(15.0, 80.0)), unit(rng)
    fall = np.exp(-s.motion.time_s[s.motion.index] / tau)[:, None]
    return gyro_source(
        "gyro_startup",
        fall * v,
        0.01 * DEG,
        0.1 * DEG,
        lambda size: vector("start", size * v, "rad_s") | {"time_constant_s": tau},
        "The gyro's bias settles after power-on.",
    )


@library
def gyro_time_lag(s: Scene, rng: Rng) -> Effect | None:
    """G15: the gyro value is 1 to 20 ms old."""
    now = s.motion.step_mean(s.motion.omega)

    def hook(r: Readings, size: float) -> None:
        late = delayed(s.motion.omega, size, float(s.motion.time_s[1]))
        r.gyro_k += s.motion.step_mean(late) - now

    return Effect(
        "gyro_time_lag",
        "gyro",
        "gyro",
        1e-3,
        0.02,
        hook,
        lambda size: {"lag_s": size},
        "The gyro reading is late.",
        fast=True,
    )


# ---- dossier section 2d: clock, link, firmware, people ---------------------------------------


@library
def clock_rate(s: Scene, rng: Rng) -> Effect | None:
    """C1: the row clock is off by 0.05 to 1 %: against it the body seems to turn (1 + e) w."""
    sign = float(rng.choice([-1.0, 1.0]))
    return gyro_source(
        "clock_rate",
        sign * s.rate,
        5e-4,
        1e-2,
        lambda size: {"clock_error_ratio": sign * size},
        "The time column runs at the wrong rate.",
        frame="link",
    )


@library
def timestamp_jitter(s: Scene, rng: Rng) -> Effect | None:
    """C2: time stamps scatter by 8 to 40 % of a step."""
    dice = np.clip(rng.standard_normal(len(s.rate)), -1.2, 1.2)

    def hook(r: Readings, size: float) -> None:
        r.time = r.time + size * s.motion.step_s * dice

    def equivalent(size: float) -> tuple[Array, Array]:
        return np.zeros_like(s.rate), s.rate * size * np.diff(dice, prepend=0.0)[:, None]

    return Effect(
        "timestamp_jitter",
        "link",
        "table",
        0.08,
        0.4,
        hook,
        lambda size: {"jitter_rms_s": size * s.motion.step_s * float(np.std(dice))},
        "The time stamps scatter.",
        equivalent=equivalent,
        fast=True,
    )


@library
def dropped_samples(s: Scene, rng: Rng) -> Effect | None:
    """C3: 0.05 to 4 % of the rows are lost in runs of one to eight."""
    order = rng.permutation(len(s.rate) - 20) + 10
    runs = rng.integers(1, 9, len(order))

    def lost(size: float) -> NDArray[np.bool_]:
        gone = np.zeros(len(s.rate), dtype=bool)
        for start, run in zip(order, runs, strict=True):
            if gone.sum() >= size * len(gone):
                break
            gone[start : start + run] = True
        return gone

    def hook(r: Readings, size: float) -> None:
        r.keep &= ~lost(size)

    def equivalent(size: float) -> tuple[Array, Array]:
        gone = lost(size)
        kept = np.flatnonzero(~gone)
        total = np.diff(np.cumsum(s.rate, axis=0)[kept], axis=0)
        change = np.zeros_like(s.rate)
        span = np.diff(kept)[:, None]
        change[kept[1:]] = s.rate[kept[1:]] * span - total
        return np.zeros_like(s.rate), change

    return Effect(
        "dropped_samples",
        "link",
        "table",
        5e-4,
        0.04,
        hook,
        lambda size: {"lost_ratio": float(lost(size).mean())},
        "Rows of the log are missing.",
        equivalent=equivalent,
        fast=True,
    )


@library
def stuck_magnetometer(s: Scene, rng: Rng) -> Effect | None:
    """C3: a few times the magnetometer repeats its last value for 0.1 to 3 s."""
    starts = np.sort(rng.uniform(0.05, 0.9, int(rng.integers(2, 8)))) * len(s.rate)

    def hook(r: Readings, size: float) -> None:
        for start in starts.astype(int):
            stop = start + max(2, int(size * s.motion.rate_hz))
            r.mag_k[start:stop] = r.mag_k[start]

    return Effect(
        "stuck_magnetometer",
        "link",
        "digit",
        0.1,
        3.0,
        hook,
        lambda size: {"stuck_s": size, "times_ratio": float(len(starts))},
        "The magnetometer's value is stuck now and then.",
        float(starts[0] / s.motion.rate_hz),
    )


def extra_noise(s: Scene, rng: Rng, on_mag: bool, gate: Array) -> Hook:
    """A hook that adds white noise of ``size`` times the sensor's sigma where ``gate`` is 1."""
    dice = rng.standard_normal(s.rate.shape) * gate[:, None]

    def hook(r: Readings, size: float) -> None:
        if on_mag:
            r.mag_k += size * s.sigma_mag * dice
        else:
            r.gyro_k += size * s.sigma_gyro * dice

    return hook


@library
def noise_burst(s: Scene, rng: Rng) -> Effect | None:
    """N1: bursts of 2 to 12 s with 1.5 to 10 times the noise on one sensor."""
    on_mag, gate = bool(rng.random() < 0.6), np.zeros(len(s.rate))
    starts = np.sort(rng.uniform(0.05, 0.9, int(rng.integers(1, 6))))
    for start in starts:
        first = int(start * len(gate))
        gate[first : first + int(rng.uniform(2, 12) * s.motion.rate_hz)] = 1.0
    return Effect(
        "noise_burst",
        "link",
        "sampled",
        1.5,
        10.0,
        extra_noise(s, rng, on_mag, gate),
        lambda size: {
            "extra_noise_ratio": size,
            "on_magnetometer_ratio": float(on_mag),
            "share_of_time_ratio": float(gate.mean()),
        },
        "The noise grows for some seconds.",
        float(starts[0] * s.duration),
    )


@library
def noise_level(s: Scene, rng: Rng) -> Effect | None:
    """N1: one sensor is noisier than its specification by a factor of 1.2 to 3 throughout."""
    on_mag = bool(rng.random() < 0.5)
    return Effect(
        "noise_level",
        "link",
        "sampled",
        0.66,
        2.8,
        extra_noise(s, rng, on_mag, np.ones(len(s.rate))),
        lambda size: {
            "noise_over_specification_ratio": math.hypot(1.0, size),
            "on_magnetometer_ratio": float(on_mag),
        },
        "A sensor is noisier than specified.",
        free_size=True,
    )


@library
def frame_error(s: Scene, rng: Rng) -> Effect | None:
    """H1: axes of the gyro or the magnetometer are swapped, mirrored or left-handed."""
    on_mag = bool(rng.random() < 0.5)
    while True:
        order = rng.permutation(3)
        signs = rng.choice([-1.0, 1.0], 3)
        if not (np.array_equal(order, [0, 1, 2]) and len(set(signs.tolist())) == 1):
            break

    def hook(r: Readings, size: float) -> None:
        if on_mag:
            r.mag_k[:] = r.mag_k[:, order] * signs
        else:
            r.gyro_k[:] = r.gyro_k[:, order] * signs

    numbers = {"on_magnetometer_ratio": float(on_mag)}
    for i, a in enumerate(AXES):
        numbers[f"{a}_takes_axis_index"] = float(order[i])
        numbers[f"{a}_sign_ratio"] = float(signs[i])
    return Effect(
        "frame_error",
        "link",
        "digit",
        1.0,
        1.0,
        hook,
        lambda size: numbers,
        "Axes of one sensor are swapped or mirrored.",
        free_size=True,
    )


@library
def unit_error(s: Scene, rng: Rng) -> Effect | None:
    """H2: the gyro columns hold deg/s (or the magnetometer columns microtesla)."""
    on_mag = bool(rng.random() < 0.3)
    factor = 100.0 if on_mag else 180.0 / math.pi

    def hook(r: Readings, size: float) -> None:
        if on_mag:
            r.mag_k *= factor
        else:
            r.gyro_k *= factor

    return Effect(
        "unit_error",
        "link",
        "digit",
        1.0,
        1.0,
        hook,
        lambda size: {"factor_ratio": factor, "on_magnetometer_ratio": float(on_mag)},
        "One sensor's columns are in another unit.",
        free_size=True,
    )


@library
def onboard_calibration_active(s: Scene, rng: Rng) -> Effect | None:
    """F1: the device corrects its own iron in jumps; up to ``size`` of A - 1 and b is taken out."""
    t = s.motion.time_s
    start = float(s.duration * rng.uniform(0.05, 0.3))
    times = start + np.cumsum(rng.uniform(4.0, 25.0, 200))
    levels = 1.0 - np.exp(-0.35 * np.arange(201)) + 0.05 * rng.standard_normal(201)
    levels[0] = 0.0
    done = levels[np.searchsorted(times, t)][:, None]

    def hook(r: Readings, size: float) -> None:
        r.mag -= size * done * (s.hard_iron + r.body @ (s.soft_iron - np.eye(3)))

    return Effect(
        "onboard_calibration_active",
        "sensor",
        "response",
        2e-3,
        1.0,
        hook,
        lambda size: {"share_corrected_ratio": size},
        "The device's own calibration runs during the recording.",
        float(times[0]),
    )


# ---- physics that no identifier names ------------------------------------------------------------


@outside
def steel_bridge(s: Scene, rng: Rng) -> Effect | None:
    """A steel bridge is passed under: girders one after another, and part of the field shielded."""
    if s.motion.vehicle not in ("car", "copter"):
        return None
    way = np.cumsum(np.linalg.norm(s.motion.velocity, axis=1)) * s.motion.time_s[1]
    middle = float(rng.uniform(0.2, 0.8) * way[-1])
    half, girder = float(rng.uniform(6.0, 16.0)), float(rng.uniform(1.5, 4.0))
    inside = 1.0 / (1.0 + ((way - middle) / half) ** 6)
    v, share = unit(rng), float(rng.uniform(0.3, 0.9))
    ripple = inside * np.sin(2 * np.pi * (way - middle) / girder)
    at = float(s.motion.time_s[int(np.argmax(inside > 0.5))])
    down = s.field_ned / np.linalg.norm(s.field_ned)

    def hook(r: Readings, size: float) -> None:
        r.world += size * (ripple[:, None] * v - share * inside[:, None] * down)

    return Effect(
        "outside:steel_bridge",
        "world",
        "world",
        1 * MG,
        150 * MG,
        hook,
        lambda size: {
            "girder_field_gauss": size,
            "shielding_gauss": share * size,
            "girder_spacing_m": girder,
            "half_length_m": half,
        },
        "The vehicle passes under a steel bridge with girders.",
        at,
    )


@outside
def levelling_gimbal(s: Scene, rng: Rng) -> Effect | None:
    """A gimbal keeps a magnet level while the airframe leans; nobody logs its angles."""
    if s.motion.vehicle not in ("copter", "robot"):
        return None
    down = s.motion.rotation[:, 2, :]
    v = unit(rng)
    pitch = -np.arcsin(np.clip(down[:, 0], -1, 1))
    roll = np.arctan2(down[:, 1], down[:, 2])
    # R_y(-pitch) then R_x(-roll): level heading axes seen from the leaning airframe
    x = np.cos(pitch) * v[0] - np.sin(pitch) * v[2]
    z = np.sin(pitch) * v[0] + np.cos(pitch) * v[2]
    y = np.cos(roll) * v[1] + np.sin(roll) * z
    field_b = np.stack([x, y, np.cos(roll) * z - np.sin(roll) * v[1]], axis=1)

    def hook(r: Readings, size: float) -> None:
        r.mag += size * field_b

    return Effect(
        "outside:levelling_gimbal",
        "sensor",
        "iron",
        1 * MG,
        80 * MG,
        hook,
        lambda size: vector("field_when_level", size * v, "gauss"),
        "A gimbal holds a magnet level while the airframe leans.",
    )


@outside
def swinging_trailer(s: Scene, rng: Rng) -> Effect | None:
    """A steel trailer behind the vehicle swings at its hitch; its dipole field turns and nears."""
    if s.motion.vehicle not in ("car", "robot"):
        return None
    dt = float(s.motion.time_s[1])
    bar = {"car": 3.0, "robot": 0.7}[s.motion.vehicle]
    speed, turn = s.motion.channels["speed_m_s"], s.motion.omega[:, 2]
    angle: Array = np.zeros(len(speed))
    hitch, every = 0.0, 10
    for i in range(0, len(speed), every):
        hitch += every * dt * (turn[i] - speed[i] / bar * math.sin(hitch))
        hitch = max(-1.4, min(1.4, hitch))
        angle[i : i + every] = hitch
    angle = low_pass(angle, 0.1, dt)
    mu = unit(rng)
    offset = np.stack([1.2 + np.cos(angle), np.sin(angle), 0.3 + 0 * angle], axis=1)
    turned = np.stack(
        [
            np.cos(angle) * mu[0] - np.sin(angle) * mu[1],
            np.sin(angle) * mu[0] + np.cos(angle) * mu[1],
            0 * angle + mu[2],
        ],
        axis=1,
    )
    far = np.linalg.norm(offset, axis=1, keepdims=True)
    along = np.sum(offset * turned, axis=1, keepdims=True)
    shape = (3 * offset * along / far**2 - turned) / far**3
    shape /= np.abs(shape).max()

    def hook(r: Readings, size: float) -> None:
        r.mag += size * shape

    return Effect(
        "outside:swinging_trailer",
        "sensor",
        "iron",
        0.5 * MG,
        80 * MG,
        hook,
        lambda size: {"peak_gauss": size, "largest_hitch_rad": float(abs(angle).max())},
        "A steel trailer swings behind the vehicle.",
    )


@outside
def door_with_magnet(s: Scene, rng: Rng) -> Effect | None:
    """A door or flap with a magnet is opened now and then, swings on its hinge, and is shut."""
    t, dt = s.motion.time_s, float(s.motion.time_s[1])
    wide: Array = np.zeros(len(t))
    at, first = float(rng.uniform(8.0, 40.0)), None
    while at < s.duration - 10.0:
        stay = float(rng.uniform(2.0, 15.0))
        first = at if first is None else first
        wide[(t >= at) & (t < at + stay)] = rng.uniform(0.5, 1.4)
        at += stay + float(rng.uniform(15.0, 60.0))
    if first is None:
        return None
    wide = low_pass(low_pass(wide, 0.35, dt), 0.35, dt)
    a, b = unit(rng), unit(rng)
    near = 1.0 / (1.0 + 1.5 * np.sin(0.5 * wide) ** 2) ** 3

    def hook(r: Readings, size: float) -> None:
        swing = np.cos(wide)[:, None] * a + np.sin(wide)[:, None] * b
        r.mag += size * near[:, None] * swing

    return Effect(
        "outside:door_with_magnet",
        "sensor",
        "iron",
        0.5 * MG,
        60 * MG,
        hook,
        lambda size: {"shut_field_gauss": size, "widest_rad": float(wide.max())},
        "A door with a magnet is opened now and then.",
        first,
    )


@outside
def one_sided_gyro_scale(s: Scene, rng: Rng) -> Effect | None:
    """The gyro's scale is wrong for one direction of turn only, 0.05 to 3 %."""
    v = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.4, 1.0, 3)
    sides = rng.choice([-1.0, 1.0], 3)
    return gyro_source(
        "outside:one_sided_gyro_scale",
        np.maximum(sides * s.rate, 0.0) * sides * v,
        5e-4,
        0.03,
        lambda size: vector("one_sided_scale", size * v, "ratio"),
        "The gyro's scale differs with the direction of turn.",
    )


@outside
def swinging_payload(s: Scene, rng: Rng) -> Effect | None:
    """A magnetic payload hangs on a rope and swings at its own frequency."""
    if s.motion.vehicle == "hand":
        return None
    length = float(rng.uniform(0.4, 2.0))
    hertz = math.sqrt(GRAVITY / length) / (2 * math.pi)
    swing = ring(-s.motion.force[:, :2] / GRAVITY, hertz, 0.06, float(s.motion.time_s[1]))
    swing = np.clip(swing - swing.mean(axis=0), -0.8, 0.8)
    top = float(np.abs(swing).max())
    a, b, c = unit(rng), unit(rng), unit(rng)

    def hook(r: Readings, size: float) -> None:
        x, y = swing[:, :1] / top, swing[:, 1:] / top
        r.mag += size * (x * a + y * b + (x * x + y * y) * c)

    return Effect(
        "outside:swinging_payload",
        "sensor",
        "iron",
        0.3 * MG,
        60 * MG,
        hook,
        lambda size: {
            "field_at_full_swing_gauss": size,
            "swing_frequency_hz": hertz,
            "largest_swing_rad": top,
        },
        "A magnetic payload swings on its rope.",
    )


@outside
def heading_ripple(s: Scene, rng: Rng) -> Effect | None:
    """A levelled turret adds a field with the fourth harmonic of heading (dossier 4.2)."""
    if s.motion.vehicle == "hand":
        return None
    north = s.motion.rotation
    yaw = np.arctan2(north[:, 1, 0], north[:, 0, 0])
    order = int(rng.choice([3, 4]))
    shape = np.sin(order * yaw + rng.uniform(0, 6.3))
    return body_source(
        "outside:heading_ripple",
        shape,
        unit(rng),
        0.3 * MG,
        15 * MG,
        "ripple",
        "gauss",
        "The error repeats several times a turn of heading.",
        extra={"order_ratio": float(order)},
    )


@outside
def snapping_iron(s: Scene, rng: Rng) -> Effect | None:
    """Iron with two states flips when the field along its axis passes a threshold, and back."""
    v, e = unit(rng), unit(rng)
    along = s.body @ v
    upper, lower = np.quantile(along, [0.75, 0.25])
    marks = np.where(along > upper, 1.0, np.where(along < lower, -1.0, 0.0))
    last = np.maximum.accumulate(np.where(marks != 0.0, np.arange(len(marks)), 0))
    state = marks[last]
    if np.count_nonzero(np.diff(state)) < 4:
        return None
    return body_source(
        "outside:snapping_iron",
        state,
        e,
        0.3 * MG,
        20 * MG,
        "half_jump",
        "gauss",
        "A piece of iron flips between two states as the field turns.",
        extra={"upper_gauss": float(upper), "lower_gauss": float(lower)},
    )


@outside
def sliding_battery(s: Scene, rng: Rng) -> Effect | None:
    """A loose battery slides to the stop when the tilt or braking passes friction, and stays."""
    push = s.motion.force[:, 0] / GRAVITY
    upper, lower = np.quantile(push, [0.9, 0.1])
    marks = np.where(push > upper, 1.0, np.where(push < lower, -1.0, 0.0))
    last = np.maximum.accumulate(np.where(marks != 0.0, np.arange(len(marks)), 0))
    place = low_pass(low_pass(marks[last], 0.15, s.motion.time_s[1]), 0.15, s.motion.time_s[1])
    if np.count_nonzero(np.diff(np.sign(place))) < 3:
        return None
    a, b = unit(rng), unit(rng)

    def hook(r: Readings, size: float) -> None:
        r.mag += size * (place[:, None] * a + 0.5 * place[:, None] ** 2 * b)

    return Effect(
        "outside:sliding_battery",
        "sensor",
        "iron",
        0.3 * MG,
        40 * MG,
        hook,
        lambda size: {
            "field_at_stop_gauss": size,
            "friction_g_upper_g": float(upper),
            "friction_g_lower_g": float(lower),
        },
        "A loose battery slides to and fro and sticks.",
    )


@outside
def hasty_auto_zero(s: Scene, rng: Rng) -> Effect | None:
    """Firmware takes slow turns for rest and subtracts part of the rate as if it were bias."""
    dt = s.motion.step_s
    speed = np.linalg.norm(low_pass(s.rate, 0.3, dt), axis=1)
    limit = float(np.quantile(speed, rng.uniform(0.2, 0.5)))
    slow = speed < limit
    gain = dt / float(rng.uniform(3.0, 12.0))
    guess, trail = np.zeros(3), np.empty_like(s.rate)
    for i, quiet in enumerate(slow.tolist()):
        if quiet:
            guess = guess + gain * (s.rate[i] - guess)
        trail[i] = guess
    return gyro_source(
        "outside:hasty_auto_zero",
        -trail,
        0.005,
        1.0,
        lambda size: {"share_removed_ratio": size, "rest_threshold_rad_s": limit},
        "The firmware re-zeroes the gyro during slow turns.",
    )


@outside
def passing_lorry(s: Scene, rng: Rng) -> Effect | None:
    """Lorries pass at their own speed: a moving dipole now and then, fixed to no place."""
    if s.motion.vehicle not in ("car", "robot"):
        return None
    t = s.motion.time_s
    total = np.zeros((len(t), 3))
    at, first = float(rng.uniform(10.0, 0.5 * s.duration)), 0.0
    first = at
    while at < s.duration - 5.0:
        pace, side = float(rng.uniform(4.0, 14.0)), float(rng.uniform(2.5, 5.0))
        course = float(rng.uniform(0, 2 * math.pi))
        along = np.array([math.cos(course), math.sin(course), 0.0])
        across = np.array([-math.sin(course), math.cos(course), 0.0])
        total += dipole((t - at)[:, None] * pace * along + side * across, unit(rng)) * side**3
        at += float(rng.uniform(20.0, 120.0))
    total /= np.abs(total).max()

    def hook(r: Readings, size: float) -> None:
        r.world += size * total

    return Effect(
        "outside:passing_lorry",
        "world",
        "world",
        1 * MG,
        150 * MG,
        hook,
        lambda size: {"peak_gauss": size},
        "Lorries pass beside the vehicle.",
        first,
    )


@outside
def sun_bent_mount(s: Scene, rng: Rng) -> Effect | None:
    """The sun warms one side of the mast, which bends with a delay: the mount turns slowly."""
    if s.motion.vehicle == "hand":
        return None
    dt = float(s.motion.time_s[1])
    side = math.cos(2.0 * float(rng.uniform(0, 1.5)))
    lit = np.maximum(0.0, s.motion.rotation[:, 0, 1] * side + s.motion.rotation[:, 0, 0] * 0.7)
    bend = low_pass(lit, float(rng.uniform(15.0, 40.0)), dt)
    v = unit(rng)

    def hook(r: Readings, size: float) -> None:
        turn = quat_to_matrix(quat_from_vector(size * bend[:, None] * v))
        r.body = np.einsum("nij,nj->ni", turn, r.body)

    return Effect(
        "outside:sun_bent_mount",
        "sensor",
        "body",
        0.2 * DEG,
        8 * DEG,
        hook,
        lambda size: vector("bend_in_full_sun", size * v, "rad"),
        "The sun bends the magnetometer's mast slowly.",
    )


def attitude_gap(s: Scene) -> float:
    """Largest angle (rad) between the true attitude and the step rates added up; a self-check."""
    q = s.motion.quaternion[0]
    for step in quat_from_vector(s.rate * s.motion.step_s):
        q = quat_multiply(q, step)
    gap = quat_multiply(quat_conjugate(s.motion.quaternion[s.motion.index[-1]]), q)
    return float(np.linalg.norm(rotation_vector(gap)))
