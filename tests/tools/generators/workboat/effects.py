"""The physical effects: each is written from its continuous equation and acts where it would.

Sources: the tables of dossier section 2 (2a magnetic on the vehicle, 2b in the world, 2c gyro,
2d clock and link); the codes (M1, W1, G1 ...) are theirs. The last part holds physics that no
identifier of contract section 5 names. Magnetic effects act on the fine (about 500 Hz) field or
on the magnetometer reading only, gyro effects on the rate only, link effects on the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from generators.workboat.motion import Array, BoolArray, Motion, low_pass, poses, rotate_by, wander

EARTH_RATE = 7.292115e-5


@dataclass
class Readings:
    """What the sensor and its logger give: time (s), mag (gauss), gyro (rad/s), which rows exist.

    ``hidden_gyro`` (rad/s) and ``hidden_mag`` (gauss) are what a fault of the time column
    amounts to; they serve the visibility only and are never written.
    """

    time: Array
    mag: Array
    gyro: Array
    keep: BoolArray
    hidden_gyro: Array
    hidden_mag: Array


@dataclass
class World:
    """One vehicle, one place, one sensor: true motion, true field, iron, biases and noise.

    Fields in gauss, rates in rad/s; ``noise_mag`` and ``noise_gyro`` have unit variance, ``h`` is
    the undisturbed field in sensor axes on the fine grid, ``gaps`` marks rows the logger missed.
    """

    motion: Motion
    field_n: Array
    latitude_rad: float
    soft_iron: Array
    hard_iron: Array
    gyro_bias: Array
    sigma_mag: float
    sigma_gyro: float
    noise_mag: Array
    noise_gyro: Array
    gaps: BoolArray
    h: Array

    @property
    def t(self) -> Array:
        """Fine time in s."""
        return self.motion.t

    @property
    def ts(self) -> Array:
        """Sample times in s."""
        return self.motion.t[self.motion.index]

    @property
    def dt(self) -> float:
        """Sample step in s."""
        return 1.0 / self.motion.rate_hz

    @property
    def span(self) -> float:
        """Length of the recording in s."""
        return float(self.t[-1])

    @property
    def strength(self) -> float:
        """Magnitude of the undisturbed field in gauss."""
        return float(np.linalg.norm(self.field_n))


Fn = Callable[[Array, float], Array]
RowsFn = Callable[[Readings, float], Readings]


@dataclass
class Built:
    """An effect drawn for one world. ``act(x, size)`` works at the stage of its recipe.

    ``fixed``, ``scaled`` (times the size) and ``derived`` (of the size) are its parameters for the
    truth; ``needs`` are the columns that carry its cause; ``onset`` in s.
    """

    act: Fn | None = None
    rows: RowsFn | None = None
    onset: float | None = None
    fixed: dict[str, float] = field(default_factory=dict)
    scaled: dict[str, float] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    words: str = ""
    derived: Callable[[float], dict[str, float]] | None = None


@dataclass(frozen=True)
class Recipe:
    """How to draw an effect: identifier, frame, stage, unit and limits of its size."""

    name: str
    frame: str
    stage: str
    size: str
    low: float
    high: float
    vehicles: tuple[str, ...]
    family: str
    draw: Callable[[World, np.random.Generator], Built]
    outside: bool = False


STAGES = ("world", "body", "field", "electronics", "mag", "rate", "gyro", "rows")
RECIPES: dict[str, Recipe] = {}
UNDER = ("rov", "auv", "towed_body")
ALL = ("work_boat", *UNDER)


def recipe(
    name: str,
    frame: str,
    stage: str,
    size: str,
    low: float,
    high: float,
    vehicles: tuple[str, ...] = ALL,
    family: str = "",
    outside: bool = False,
) -> Callable[[Callable[[World, np.random.Generator], Built]], None]:
    """Register an effect under its identifier; ``size`` names the size parameter with its unit."""
    if stage not in STAGES:
        raise ValueError(f"no stage {stage}")

    def add(draw: Callable[[World, np.random.Generator], Built]) -> None:
        RECIPES[name] = Recipe(
            name, frame, stage, size, low, high, vehicles, family or name, draw, outside
        )

    return add


def direction(g: np.random.Generator) -> Array:
    """A random unit vector."""
    v = g.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def symmetric(g: np.random.Generator) -> Array:
    """A random symmetric traceless matrix whose largest singular value is 1."""
    m = g.standard_normal((3, 3))
    m = m + m.T
    m -= np.eye(3) * np.trace(m) / 3.0
    return np.asarray(m / np.linalg.norm(m, 2))


def xyz(stem: str, unit: str, v: Array, names: str = "xyz") -> dict[str, float]:
    """Three components of a vector as named parameters."""
    ends = ("north", "east", "down") if names == "ned" else tuple(names)
    return {f"{stem}_{e}_{unit}": float(x) for e, x in zip(ends, v, strict=True)}


def square(stem: str, unit: str, m: Array) -> dict[str, float]:
    """Nine entries of a matrix as named parameters."""
    ends = "xyz"
    return {f"{stem}_{ends[i]}{ends[j]}_{unit}": float(m[i, j]) for i in range(3) for j in range(3)}


def onset(w: World, g: np.random.Generator, lo: float = 0.15, hi: float = 0.85) -> float:
    """A moment in s between two shares of the recording."""
    return float(g.uniform(lo, hi) * w.span)


def course(u: Array, shape: Array, stem: str, unit: str, **more: object) -> Built:
    """An additive vector of fixed direction ``u`` with a given time course."""
    built = Built(act=lambda x, s: x + s * shape[:, None] * u, scaled=xyz(stem, unit, u))
    return replace(built, **more)  # type: ignore[arg-type]


def after(w: World, t0: float) -> Array:
    """0 before and 1 from ``t0`` s on, on the fine grid."""
    return np.asarray((w.t >= t0).astype(float))


def delayed(w: World, x: Array, lag: float) -> Array:
    """The fine series ``lag`` seconds earlier."""
    return np.stack([np.interp(w.t - lag, w.t, x[:, i]) for i in range(x.shape[1])], axis=1)


def in_body(w: World, v_n: Array) -> Array:
    """A world vector (fixed or a fine series) in sensor axes."""
    series = np.broadcast_to(v_n, (len(w.t), 3))
    return np.asarray(np.einsum("kji,kj->ki", w.motion.r_nb, series))


def dipole(arm: Array, moment: Array) -> Array:
    """Field in gauss of a dipole (A m^2) at ``arm`` metres from it (SI: mu0/4pi, 1 T = 1e4 G)."""
    r = np.linalg.norm(arm, axis=-1, keepdims=True)
    along = np.sum(arm * moment, axis=-1, keepdims=True)
    return np.asarray(1e-3 * (3.0 * arm * along / r**5 - moment / r**3))


def slowly(w: World, make: Callable[[Array, Array], Array]) -> Array:
    """Evaluate ``make(t, position)`` at about 20 Hz and interpolate to the fine grid."""
    every = max(1, int(0.05 / w.motion.dt_fine))
    pick = np.unique(np.append(np.arange(0, len(w.t), every), len(w.t) - 1))
    coarse = make(w.t[pick], w.motion.position[pick])
    return np.stack([np.interp(w.t, w.t[pick], coarse[:, i]) for i in range(3)], axis=1)


def peaked(v: Array) -> tuple[Array, float]:
    """A series scaled to a largest magnitude of 1, and that magnitude."""
    top = float(np.linalg.norm(v, axis=1).max())
    return v / top, top


def joint_of(w: World) -> str:
    """The moving joint of the vehicle."""
    for name in ("manipulator_angle_rad", "rudder_angle_rad", "wing_angle_rad"):
        if name in w.motion.signals:
            return name
    raise KeyError("no joint")


# --- 2a: on the sensor -------------------------------------------------------------------------


@recipe("hard_iron_step", "sensor", "field", "step_gauss", 3e-4, 0.3)
def _m1(w: World, g: np.random.Generator) -> Built:
    t0 = onset(w, g)
    text = "a piece of iron is put down near the sensor"
    return course(direction(g), after(w, t0), "step", "gauss", onset=t0, words=text)


@recipe("hard_iron_drift", "sensor", "field", "drift_gauss_per_h", 5e-4, 8e-3, family="slow")
def _m2(w: World, g: np.random.Generator) -> Built:
    u, text = direction(g), "the hard iron creeps while the hull relaxes magnetically"
    if g.random() < 0.5:
        return course(u, w.t / 3600.0, "drift", "gauss_per_h", words=text)
    t1 = g.uniform(20.0, 100.0)
    shape = np.log1p(np.maximum(w.t, 0.0) / t1) / math.log1p(w.span / t1) * w.span / 3600.0
    return course(u, shape, "drift", "gauss_per_h", fixed={"relaxation_s": t1}, words=text)


@recipe("soft_iron_step", "sensor", "field", "change_share", 2e-3, 0.05)
def _m3(w: World, g: np.random.Generator) -> Built:
    t0, m = onset(w, g), symmetric(g)
    add = (w.h @ m.T) * after(w, t0)[:, None]
    text = "soft iron near the sensor changes at one moment"
    return Built(lambda x, s: x + s * add, None, t0, {}, square("change", "share", m), (), text)


@recipe("motor_current_field", "sensor", "field", "field_gauss_per_a", 3e-5, 5e-3)
def _m4(w: World, g: np.random.Generator) -> Built:
    names = [n for n in ("motor_current_a", "vertical_current_a") if n in w.motion.signals]
    name = names[int(g.integers(len(names)))]
    text = f"the supply lead makes a field in proportion to {name}"
    needs = (name, "motor_rpm") if name == "motor_current_a" else (name,)
    amp = w.motion.signals[name]
    return course(direction(g), amp, "field", "gauss_per_a", needs=needs, words=text)


@recipe("current_derivative_field", "sensor", "field", "field_gauss_s_per_a", 1e-5, 1e-3)
def _m5(w: World, g: np.random.Generator) -> Built:
    slope = np.gradient(low_pass(w.motion.signals["motor_current_a"], w.motion.dt_fine, 0.03))
    needs = ("motor_current_a", "motor_rpm")
    text = "changes of the motor current induce a field in the frame"
    slope = slope / w.motion.dt_fine
    return course(direction(g), slope, "field", "gauss_s_per_a", needs=needs, words=text)


@recipe("speed_field", "sensor", "field", "field_gauss_s_per_m", 1e-4, 2.5e-3)
def _m6(w: World, g: np.random.Generator) -> Built:
    text, v = "a field grows with speed through the water", w.motion.signals["speed_m_s"]
    needs = ("speed_m_s",)
    return course(direction(g), v, "field", "gauss_s_per_m", needs=needs, words=text)


@recipe("ac_interference", "sensor", "field", "amplitude_gauss", 1e-4, 2e-2)
def _m7(w: World, g: np.random.Generator) -> Built:
    base = float(g.choice([50.0, 60.0, 50.0, g.uniform(70.0, 200.0)]))
    f, phase = base + g.uniform(-0.05, 0.05), g.uniform(0.0, 2.0 * np.pi)
    fs = w.motion.rate_hz
    fixed = {"frequency_hz": f, "alias_hz": abs(f - fs * round(f / fs))}
    text = "an alternating field of a generator or motor drive is sampled below its frequency"
    wave = np.cos(2.0 * np.pi * f * w.t + phase)
    return course(direction(g), wave, "amplitude", "gauss", fixed=fixed, words=text)


@recipe("sync_pulses", "sensor", "field", "pulse_gauss", 2e-4, 5e-3)
def _m9(w: World, g: np.random.Generator) -> Built:
    period = g.uniform(0.5, 2.5)
    width = w.dt * g.uniform(1.0, 1.6)
    on = (np.mod(w.t - g.uniform(0.0, period), period) < width).astype(float)
    fixed = {"period_s": period, "width_s": width}
    text = "each ping of the sonar leaves a short field pulse"
    return course(direction(g), on, "pulse", "gauss", fixed=fixed, words=text)


@recipe(
    "mag_bias_temperature", "sensor", "electronics", "slope_gauss_per_c", 1e-5, 5e-4, ALL, "slow"
)
def _m10(w: World, g: np.random.Generator) -> Built:
    warm, needs = w.motion.signals["temperature_c"] - 20.0, ("temperature_c",)
    text = "the magnetometer offset follows temperature"
    return course(direction(g), warm, "slope", "gauss_per_c", needs=needs, words=text)


@recipe("mag_scale_temperature", "sensor", "electronics", "slope_per_c", 1e-4, 3e-3)
def _m11(w: World, g: np.random.Generator) -> Built:
    warm = w.motion.signals["temperature_c"][:, None] - 20.0
    gain = g.uniform(0.4, 1.0, 3) * g.choice([-1.0, 1.0])
    text = "the magnetometer sensitivity follows temperature"
    return Built(
        lambda x, s: x * (1.0 + s * warm * gain),
        scaled=xyz("slope", "per_c", gain),
        needs=("temperature_c",),
        words=text,
    )


@recipe("mag_cross_axis", "sensor", "electronics", "share_at_half_gauss", 1e-3, 2e-2, ALL, "curve")
def _m12(w: World, g: np.random.Generator) -> Built:
    k = direction(g)
    pairs = ((1, 2), (0, 2), (0, 1))

    def act(x: Array, s: float) -> Array:
        extra = np.stack([x[:, i] * x[:, j] for i, j in pairs], axis=1)
        return x + s * k * extra / 0.5

    text = "each axis also feels the product of the two other axes"
    return Built(act, scaled=xyz("share", "at_half_gauss", k), words=text)


@recipe(
    "mag_nonlinearity", "sensor", "electronics", "error_at_half_gauss", 2e-4, 5e-3, ALL, "curve"
)
def _m13(w: World, g: np.random.Generator) -> Built:
    k, text = direction(g), "each axis has a cubic error"
    scaled = xyz("error_at_half", "gauss", k)
    return Built(lambda x, s: x + s * k * (x / 0.5) ** 3, scaled=scaled, words=text)


@recipe("mag_saturation", "sensor", "mag", "clipped_share", 2e-3, 0.12, ALL, "curve")
def _m14(w: World, g: np.random.Generator) -> Built:
    clean = w.h[w.motion.index] @ w.soft_iron.T + w.hard_iron
    top = np.sort(np.abs(clean).max(axis=1))

    def act(x: Array, s: float) -> Array:
        limit = float(np.quantile(top, 1.0 - s))
        return np.clip(x, -limit, limit)

    return Built(
        act,
        words="readings beyond the range of the chip are clipped",
        derived=lambda s: {"limit_gauss": float(np.quantile(top, 1.0 - s))},
    )


@recipe("mag_quantisation", "sensor", "mag", "step_gauss", 3e-4, 4e-3)
def _m15(w: World, g: np.random.Generator) -> Built:
    text = "the magnetometer is read with a coarse step"
    return Built(lambda x, s: np.round(x / s) * s, words=text)


@recipe("hysteresis", "sensor", "field", "amplitude_gauss", 1e-4, 4e-3, ALL, "turning")
def _m16(w: World, g: np.random.Generator) -> Built:
    radius = g.uniform(0.03, 0.12, 3) * w.strength
    add = np.empty_like(w.h)
    for i in range(3):
        r, state, out = float(radius[i]), float(w.h[0, i]), []
        for v in w.h[:, i].tolist():
            state = min(v + r, max(v - r, state))
            out.append(state - v)
        add[:, i] = np.array(out) / r
    k = direction(g)
    text = "iron nearby keeps part of its magnetisation until the field has turned far enough"
    fixed = xyz("play_radius", "gauss", radius)
    return Built(
        lambda x, s: x + s * k * add, None, None, fixed, xyz("amplitude", "gauss", k), (), text
    )


@recipe("eddy_current", "sensor", "field", "field_gauss_at_half_rad_s", 1e-4, 2e-2, ALL, "turning")
def _m17(w: World, g: np.random.Generator) -> Built:
    e = g.standard_normal((3, 3))
    e /= np.linalg.norm(e, 2) * 0.5 * w.strength
    add = np.cross(w.h, w.motion.w) @ e.T
    text = "eddy currents in a metal housing add a field in proportion to the change of field"
    return Built(lambda x, s: x + s * add, scaled=square("eddy", "s", e), words=text)


@recipe("viscous_magnetisation", "sensor", "field", "share", 5e-4, 1.5e-2, ALL, "turning")
def _m18(w: World, g: np.random.Generator) -> Built:
    tau, m = float(np.exp(g.uniform(math.log(10.0), math.log(120.0)))), symmetric(g)
    add = (low_pass(w.h, w.motion.dt_fine, tau) - w.h) @ m.T
    text = "induced magnetism follows each turn only after tens of seconds"
    fixed = {"relaxation_s": tau}
    return Built(lambda x, s: x + s * add, None, None, fixed, square("share", "ratio", m), (), text)


@recipe("mag_time_lag", "sensor", "electronics", "lag_s", 1e-3, 0.06, ALL, "timing")
def _m19(w: World, g: np.random.Generator) -> Built:
    text = "the magnetometer value is older than its time stamp says"
    return Built(lambda x, s: delayed(w, x, s), words=text)


@recipe("mag_low_pass", "sensor", "electronics", "time_constant_s", 2e-3, 0.05, ALL, "timing")
def _m20(w: World, g: np.random.Generator) -> Built:
    text = "a first-order filter smooths the magnetometer"
    return Built(lambda x, s: low_pass(x, w.motion.dt_fine, s), words=text)


@recipe("mag_sample_hold", "sensor", "mag", "hold_s", 0.02, 0.25, ALL, "timing")
def _m21(w: World, g: np.random.Generator) -> Built:
    def act(x: Array, s: float) -> Array:
        k = np.arange(len(x))
        fresh = np.floor(k * w.dt / s + 1e-9)
        start = np.maximum.accumulate(np.where(np.diff(fresh, prepend=-1.0) > 0, k, 0))
        return x[start]

    return Built(act, words="the magnetometer is refreshed more slowly than it is logged")


@recipe("flexible_mount", "sensor", "body", "bend_rad_per_g", 5e-4, 0.04, ALL, "mount")
def _m22(w: World, g: np.random.Generator) -> Built:
    c = g.standard_normal((3, 3))
    c /= np.linalg.norm(c, 2)
    bend = (w.motion.force - w.motion.force.mean(axis=0)) @ c.T / 9.81
    text = "the bracket of the magnetometer bends under tilt and acceleration"
    needs = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
    scaled = square("bend", "rad_per_g", c)
    return Built(lambda x, s: rotate_by(x, -s * bend), None, None, {}, scaled, needs, text)


@recipe("moving_iron", "sensor", "field", "amplitude_gauss", 3e-4, 5e-2)
def _m23(w: World, g: np.random.Generator) -> Built:
    name = joint_of(w)
    psi, a, b = w.motion.signals[name], direction(g), direction(g)
    add = np.cos(psi)[:, None] * a + np.sin(psi)[:, None] * b
    scaled = xyz("cosine", "gauss", a) | xyz("sine", "gauss", b)
    text = f"iron on a joint moves with {name}"
    return Built(lambda x, s: x + s * add, None, None, {}, scaled, (name,), text)


@recipe("switched_device", "sensor", "field", "field_gauss", 1.5e-4, 2e-2)
def _m24(w: World, g: np.random.Generator) -> Built:
    text, u = "the lamp makes a field while it is on", w.motion.signals["lamp_on"]
    return course(direction(g), u, "field", "gauss", needs=("lamp_on",), words=text)


@recipe("rotor_field", "sensor", "field", "amplitude_gauss", 1e-4, 1e-2, ALL[:3])
def _m25(w: World, g: np.random.Generator) -> Built:
    turn = 2.0 * np.pi * np.cumsum(w.motion.signals["motor_rpm"]) / 60.0 * w.motion.dt_fine
    turn += g.uniform(0.0, 2.0 * np.pi)
    add = np.stack([np.zeros_like(turn), np.cos(turn), np.sin(turn)], axis=1)
    text = "the propeller shaft (along x) is magnetised and turns at motor_rpm"
    return Built(lambda x, s: x + s * add, needs=("motor_rpm",), words=text)


# --- 2b: in the world --------------------------------------------------------------------------


@recipe("field_gradient", "world", "world", "gradient_gauss_per_m", 5e-6, 2e-3)
def _w1(w: World, g: np.random.Generator) -> Built:
    m = symmetric(g)
    add = w.motion.position @ m.T
    text = "the outside field has a constant gradient over the working area"
    needs = ("position_north_m", "position_east_m", "position_down_m")
    scaled = {
        k.replace("_x", "_n").replace("_y", "_e").replace("_z", "_d"): v
        for k, v in square("gradient", "gauss_per_m", m).items()
    }
    return Built(lambda x, s: x + s * add, None, None, {}, scaled, needs, text)


@recipe("field_anomaly", "world", "world", "peak_gauss", 5e-4, 0.2)
def _w2(w: World, g: np.random.Generator) -> Built:
    t1 = onset(w, g, 0.2, 0.8)
    at = int(np.searchsorted(w.t, t1))
    angle, off, under = g.uniform(0, 2 * np.pi), g.uniform(0.0, 6.0), g.uniform(2.0, 6.0)
    where = w.motion.position[at] + np.array([off * math.cos(angle), off * math.sin(angle), under])
    mu = direction(g)
    add, top = peaked(slowly(w, lambda t, p: dipole(p - where, mu)))
    return Built(
        lambda x, s: x + s * add,
        onset=t1,
        fixed=xyz("source", "m", where, "ned"),
        scaled=xyz("moment", "a_m2", mu / top, "ned"),
        needs=("position_north_m", "position_east_m", "position_down_m"),
        words="an iron object lies near the track",
    )


@recipe("geomagnetic_drift", "world", "world", "change_gauss", 4e-4, 8e-3)
def _w3(w: World, g: np.random.Generator) -> Built:
    bay = low_pass(wander(g, len(w.t), w.motion.dt_fine, 200.0), w.motion.dt_fine, 20.0)
    shape = w.t / w.span if g.random() < 0.5 else (bay - bay[0]) / max(np.ptp(bay), 1e-9)
    text = "the outside field changes in time during a magnetic storm"
    u = direction(g)
    built = course(u, shape, "change", "gauss", words=text)
    return replace(built, scaled=xyz("change", "gauss", u, "ned"))


@recipe("altitude_field", "world", "world", "field_at_floor_gauss", 1e-4, 5e-2, UNDER)
def _w4(w: World, g: np.random.Generator) -> Built:
    alt, scale, u = w.motion.signals["altitude_m"], g.uniform(1.5, 6.0), direction(g)
    shape = np.exp(-np.maximum(alt, 0.0) / scale)
    return Built(
        lambda x, s: x + s * shape[:, None] * u,
        fixed={"decay_m": scale},
        scaled=xyz("field", "gauss", u, "ned"),
        needs=("altitude_m", "depth_m", "pressure_kpa", "position_down_m"),
        words="basalt on the floor adds a field that fades with altitude",
    )


@recipe("field_step", "world", "world", "step_gauss", 5e-4, 0.1)
def _w7(w: World, g: np.random.Generator) -> Built:
    t0, u = onset(w, g), direction(g)
    built = course(u, after(w, t0), "step", "gauss", onset=t0)
    text = "the vehicle leaves a large iron structure and the outside field changes once"
    return replace(built, scaled=xyz("step", "gauss", u, "ned"), words=text)


# --- 2c: gyro ----------------------------------------------------------------------------------


def on_rate(
    m: Array, source: Array, stem: str, unit: str, words: str, needs: tuple[str, ...] = ()
) -> Built:
    """A gyro error that is a matrix times a fine series."""
    add = source @ m.T
    return Built(lambda x, s: x + s * add, scaled=square(stem, unit, m), needs=needs, words=words)


@recipe("gyro_scale", "gyro", "rate", "scale_share", 5e-4, 1e-2, ALL, "scale")
def _g1(w: World, g: np.random.Generator) -> Built:
    k = direction(g)
    built = on_rate(np.diag(k), w.motion.w, "scale", "share", "the gyro axes have scale errors")
    return replace(built, scaled=xyz("scale", "share", k))


@recipe("gyro_nonorthogonality", "gyro", "rate", "angle_rad", 5e-4, 5e-3, ALL, "scale")
def _g2(w: World, g: np.random.Generator) -> Built:
    a = direction(g)
    m = np.array([[0, a[0], a[1]], [a[0], 0, a[2]], [a[1], a[2], 0]])
    built = on_rate(m, w.motion.w, "angle", "rad", "the gyro axes are not at right angles")
    names = ("angle_xy_rad", "angle_xz_rad", "angle_yz_rad")
    return replace(built, scaled={n: float(v) for n, v in zip(names, a, strict=True)})


@recipe("mag_gyro_misalignment", "gyro", "body", "angle_rad", 5e-4, 0.053, ALL, "mount")
def _g3(w: World, g: np.random.Generator) -> Built:
    u, text = direction(g), "the magnetometer is turned against the gyro by a small angle"
    return Built(lambda x, s: rotate_by(x, -s * u), scaled=xyz("angle", "rad", u), words=text)


@recipe("gyro_g_sensitivity", "gyro", "rate", "bias_rad_s_per_g", 5e-5, 1.8e-3)
def _g4(w: World, g: np.random.Generator) -> Built:
    m = g.standard_normal((3, 3))
    m /= np.linalg.norm(m, 2)
    needs = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
    text = "the gyro bias follows the specific force"
    return on_rate(m, w.motion.force / 9.81, "bias", "rad_s_per_g", text, needs)


@recipe("vibration_rectification", "gyro", "rate", "bias_rad_s_per_m2_s4", 1e-5, 1.8e-3)
def _g5(w: World, g: np.random.Generator) -> Built:
    text, unit = "vibration shifts the gyro bias in proportion to its variance", "rad_s_per_m2_s4"
    needs = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2", "motor_rpm", "motor_current_a")
    return course(direction(g), w.motion.vibration**2, "bias", unit, needs=needs, words=text)


@recipe(
    "gyro_bias_temperature", "gyro", "rate", "slope_rad_s_per_c", 1.7e-5, 9e-4, ALL, "gyro slow"
)
def _g6(w: World, g: np.random.Generator) -> Built:
    warm, text = w.motion.signals["temperature_c"] - 20.0, "the gyro bias follows temperature"
    needs, unit = ("temperature_c",), "rad_s_per_c"
    return course(direction(g), warm, "slope", unit, needs=needs, words=text)


@recipe("gyro_bias_drift", "gyro", "rate", "spread_rad_s", 2.4e-5, 5e-4, ALL, "gyro slow")
def _g7(w: World, g: np.random.Generator) -> Built:
    walk = np.cumsum(g.standard_normal(w.h.shape), axis=0)
    walk -= walk.mean(axis=0)
    walk /= math.sqrt(float(np.mean(np.sum(walk**2, axis=1))))
    return Built(lambda x, s: x + s * walk, words="the gyro bias wanders as a random walk")


@recipe("gyro_bias_step", "gyro", "rate", "step_rad_s", 3e-5, 3.5e-3, ALL, "gyro step")
def _g8(w: World, g: np.random.Generator) -> Built:
    t0, text = onset(w, g), "the gyro bias jumps once after a knock"
    return course(direction(g), after(w, t0), "step", "rad_s", onset=t0, words=text)


@recipe("earth_rotation", "gyro", "rate", "share_of_earth_rate", 1.0, 1.0)
def _g12(w: World, g: np.random.Generator) -> Built:
    v = EARTH_RATE * np.array([math.cos(w.latitude_rad), 0.0, -math.sin(w.latitude_rad)])
    add = in_body(w, v)
    fixed = xyz("rate", "rad_s", v, "ned")
    text = "the gyro also sees the rotation of the Earth"
    return Built(lambda x, s: x + s * add, fixed=fixed, words=text)


@recipe("gyro_integration", "gyro", "gyro", "unseen_share_of_step", 0.05, 0.97, ALL, "timing")
def _g13(w: World, g: np.random.Generator) -> Built:
    m = w.motion
    whole = m.step_mean(m.w)

    def act(x: Array, s: float) -> Array:
        back = max(1, round((1.0 - s) * m.factor))
        rows = m.index[:, None] - np.arange(back + 1)[None, :]
        weight = np.full(back + 1, 1.0 / back)
        weight[[0, -1]] *= 0.5
        return np.asarray(x + np.einsum("kji,j->ki", m.w[rows], weight) - whole)

    text = "the gyro value covers only the last part of its step"
    return Built(act, fixed={"step_s": w.dt}, words=text)


@recipe("gyro_startup", "gyro", "rate", "transient_rad_s", 5e-5, 1.8e-3, ALL, "gyro slow")
def _g14(w: World, g: np.random.Generator) -> Built:
    tau = g.uniform(20.0, 120.0)
    shape = np.exp(-np.maximum(w.t, 0.0) / tau)
    fixed, text = {"time_constant_s": tau}, "the gyro bias settles after power-on"
    return course(direction(g), shape, "transient", "rad_s", fixed=fixed, words=text)


@recipe("gyro_time_lag", "gyro", "rate", "lag_s", 5e-4, 0.03, ALL, "timing")
def _g15(w: World, g: np.random.Generator) -> Built:
    text = "the gyro value is older than its time stamp says"
    return Built(lambda x, s: delayed(w, x, s), words=text)


# --- 2d: clock, link, firmware, people ---------------------------------------------------------


@recipe("clock_rate", "link", "rows", "rate_share", 3e-4, 1e-2, ALL, "scale")
def _c1(w: World, g: np.random.Generator) -> Built:
    sign, rate = float(g.choice([-1.0, 1.0])), w.motion.step_rate

    def rows(r: Readings, s: float) -> Readings:
        e = sign * s
        return replace(r, time=r.time * (1.0 + e), hidden_gyro=r.hidden_gyro + e * rate)

    text = "the clock that stamps the rows runs at a wrong rate"
    return Built(rows=rows, scaled={"stamp_rate_error_share": sign}, words=text)


@recipe("timestamp_jitter", "link", "rows", "jitter_s", 3e-4, 0.03)
def _c2(w: World, g: np.random.Generator) -> Built:
    late = g.gamma(2.0, 1.0 / math.sqrt(2.0), len(w.ts))
    at = w.motion.index
    change = np.cross(w.h[at], w.motion.w[at]) @ w.soft_iron.T

    def rows(r: Readings, s: float) -> Readings:
        shift = np.minimum(s * late, 0.9 * w.dt)
        hidden = r.hidden_mag - shift[:, None] * change
        return replace(r, time=r.time + shift, hidden_mag=hidden)

    return Built(
        rows=rows,
        words="the host stamps the rows late by a varying time",
        derived=lambda s: {"stamp_spread_s": float(np.std(np.minimum(s * late, 0.9 * w.dt)))},
    )


@recipe("dropped_samples", "link", "rows", "lost_share", 2e-4, 0.05)
def _c3(w: World, g: np.random.Generator) -> Built:
    order = g.random(len(w.ts))

    def rows(r: Readings, s: float) -> Readings:
        lost = order < s
        lost[:2] = False
        turn = np.where(lost[:, None], w.motion.step_rate, 0.0)
        owed, k = np.zeros_like(turn), np.arange(len(lost))
        following = np.minimum.accumulate(np.where(lost, len(k) - 1, k)[::-1])[::-1]
        np.add.at(owed, following, turn)
        time = r.time - np.cumsum(lost) * w.dt
        hidden = r.hidden_gyro + owed
        return replace(r, time=time, keep=r.keep & ~lost, hidden_gyro=hidden)

    text = "rows are lost and the logger numbers on as if none were missing"
    return Built(rows=rows, words=text)


@recipe("stuck_magnetometer", "link", "mag", "stuck_s", 0.1, 6.0)
def _c4(w: World, g: np.random.Generator) -> Built:
    starts = np.sort(g.uniform(0.05, 0.95, int(g.integers(1, 5)))) * w.span

    def act(x: Array, s: float) -> Array:
        y = x.copy()
        for t0 in starts:
            a = int(np.searchsorted(w.ts, t0))
            y[a : a + max(1, round(s / w.dt)) + 1] = x[a]
        return y

    fixed = {f"start_{i + 1}_s": float(v) for i, v in enumerate(starts)}
    text = "the magnetometer repeats one value for a while"
    return Built(act, None, float(starts[0]), fixed, {}, (), text)


@recipe("noise_burst", "link", "mag", "extra_noise_ratio", 1.5, 15.0, ALL, "noise")
def _n1(w: World, g: np.random.Generator) -> Built:
    starts = np.sort(g.uniform(0.05, 0.93, int(g.integers(2, 6)))) * w.span
    long = g.uniform(2.0, 10.0)
    on = np.zeros(len(w.ts))
    for t0 in starts:
        on[(w.ts >= t0) & (w.ts < t0 + long)] = 1.0
    extra = on[:, None] * g.standard_normal(w.noise_mag.shape) * w.sigma_mag
    fixed = {f"start_{i + 1}_s": float(v) for i, v in enumerate(starts)} | {"length_s": long}
    text = "the magnetometer is much noisier in a few short intervals"
    return Built(lambda x, s: x + s * extra, None, float(starts[0]), fixed, {}, (), text)


@recipe("noise_level", "link", "mag", "extra_noise_ratio", 0.3, 3.0, ALL, "noise")
def _n2(w: World, g: np.random.Generator) -> Built:
    t0 = onset(w, g, 0.2, 0.8)
    extra = (w.ts >= t0)[:, None] * g.standard_normal(w.noise_mag.shape) * w.sigma_mag
    text = "the magnetometer noise is higher from one moment on"
    return Built(lambda x, s: x + s * extra, None, t0, {}, {}, (), text)


@recipe("onboard_calibration_active", "link", "mag", "final_share_removed", 3e-3, 0.5)
def _f1(w: World, g: np.random.Generator) -> Built:
    t0, every = onset(w, g, 0.05, 0.5), g.uniform(4.0, 20.0)
    steps = np.maximum(0.0, np.floor((w.ts - t0) / every) + 1.0)
    progress = 1.0 - np.exp(-steps * g.uniform(0.1, 0.35))
    inverse = np.linalg.inv(w.soft_iron)
    fixed = {"update_every_s": every}

    def act(x: Array, s: float) -> Array:
        share = s * progress[:, None]
        moved = x - share * w.hard_iron
        return moved + share * (moved @ inverse.T - moved)

    text = "the device itself corrects hard and soft iron little by little"
    return Built(act, None, t0, fixed, {}, (), text)


@recipe("frame_error", "link", "rows", "wrong_axes", 1.0, 1.0, ALL, "gross")
def _h1(w: World, g: np.random.Generator) -> Built:
    kind, on_gyro = int(g.integers(3)), bool(g.random() < 0.6)
    i, j = (int(v) for v in g.choice(3, 2, replace=False))
    m = np.eye(3)
    if kind == 0:
        m[[i, j]] = m[[j, i]]
    elif kind == 1:
        m[i, i] = -1.0
    else:
        m = np.eye(3)[[1, 2, 0]] if g.random() < 0.5 else np.diag([1.0, -1.0, -1.0])

    def rows(r: Readings, s: float) -> Readings:
        return replace(r, gyro=r.gyro @ m.T) if on_gyro else replace(r, mag=r.mag @ m.T)

    fixed = square("gyro_axes" if on_gyro else "mag_axes", "ratio", m)
    text = f"the {'gyro' if on_gyro else 'magnetometer'} columns have wrong axes or signs"
    return Built(None, rows, None, fixed, {}, (), text)


@recipe("unit_error", "link", "rows", "wrong_unit", 1.0, 1.0, ALL, "gross")
def _h2(w: World, g: np.random.Generator) -> Built:
    factor = float(g.choice([180.0 / math.pi, math.pi / 180.0]))
    return Built(
        rows=lambda r, s: replace(r, gyro=r.gyro * factor),
        fixed={"gyro_factor_ratio": factor},
        words="the gyro columns are in a wrong unit of angle",
    )


# --- outside: physics that no identifier names ---------------------------------------------------


@recipe(
    "crane_slew", "sensor", "field", "peak_gauss", 3e-4, 0.05, ("work_boat", "rov"), outside=True
)
def _o1(w: World, g: np.random.Generator) -> Built:
    slew = low_pass(poses(g, len(w.t), w.motion.dt_fine, 2.0, 9.0), w.motion.dt_fine, 0.5)
    reach = 3.0 + 1.2 * low_pass(
        poses(g, len(w.t), w.motion.dt_fine, 1.0, 9.0), w.motion.dt_fine, 0.5
    )
    base, height = (
        np.array([g.uniform(-3.0, -1.0), g.uniform(-1.0, 1.0), 0.0]),
        g.uniform(-2.5, -1.0),
    )
    tip = np.stack([reach * np.cos(slew), reach * np.sin(slew), np.full_like(slew, height)], axis=1)
    arm = -(base + tip)
    moment = 1.5 * w.h / w.strength + direction(g)
    add, top = peaked(dipole(arm, moment))
    scaled = {"moment_a_m2": 1.0 / top}
    text = "a crane slews an iron load round the sensor, unlogged"
    return Built(lambda x, s: x + s * add, scaled=scaled, words=text)


@recipe("passing_hull", "world", "world", "peak_gauss", 4e-4, 0.05, outside=True)
def _o2(w: World, g: np.random.Generator) -> Built:
    t1, speed, away = onset(w, g, 0.25, 0.75), g.uniform(3.0, 8.0), g.uniform(25.0, 70.0)
    course_rad, mu = g.uniform(0.0, 2 * np.pi), np.array([0.3, 0.2, 1.0]) + 0.5 * direction(g)
    ahead = np.array([math.cos(course_rad), math.sin(course_rad), 0.0])
    side = np.array([-ahead[1], ahead[0], 0.0])
    here = w.motion.position[int(np.searchsorted(w.t, t1))] * np.array([1.0, 1.0, 0.0])
    long = g.uniform(30.0, 90.0)

    def make(t: Array, p: Array) -> Array:
        total = np.zeros_like(p)
        for part in np.linspace(-0.5, 0.5, 5):
            track = here + away * side + (speed * (t - t1)[:, None] + part * long) * ahead
            total += dipole(p - track, mu)
        return total

    add, top = peaked(slowly(w, make))
    fixed = {"closest_m": away, "ship_speed_m_s": speed, "hull_length_m": long}
    scaled = xyz("moment_of_each_fifth", "a_m2", mu / top, "ned")
    text = "a steel ship passes"
    return Built(lambda x, s: x + s * add, None, t1, fixed, scaled, (), text)


@recipe("chain_on_sea_floor", "world", "world", "peak_gauss", 5e-4, 0.08, outside=True)
def _o3(w: World, g: np.random.Generator) -> Built:
    t1 = onset(w, g, 0.2, 0.8)
    here = w.motion.position[int(np.searchsorted(w.t, t1))]
    way, links = g.uniform(0.0, 2 * np.pi), 48
    along = (np.arange(links) - links / 2) * 1.5
    bend = 2.0 * np.sin(along / g.uniform(6.0, 15.0))
    line = np.stack([along, bend, np.full(links, g.uniform(2.0, 5.0))], axis=1)
    turn = np.array(
        [[math.cos(way), -math.sin(way), 0], [math.sin(way), math.cos(way), 0], [0, 0, 1]]
    )
    line = here + line @ turn.T
    moments = g.standard_normal((links, 3)) + direction(g)

    def make(t: Array, p: Array) -> Array:
        total = np.zeros_like(p)
        for spot, mu in zip(line, moments, strict=True):
            total += dipole(p - spot, mu)
        return total

    add, top = peaked(slowly(w, make))
    fixed = {"links": float(links), "direction_rad": way} | xyz(
        "middle", "m", line[links // 2], "ned"
    )
    text = "an anchor chain with unevenly magnetised links lies on the sea floor"
    scaled = {"rms_link_moment_a_m2": math.sqrt(float(np.mean(moments**2))) / top}
    return Built(lambda x, s: x + s * add, None, t1, fixed, scaled, (), text)


@recipe("loose_mount_settles", "sensor", "body", "final_angle_rad", 1e-3, 0.06, outside=True)
def _o4(w: World, g: np.random.Generator) -> Built:
    t0, u = onset(w, g, 0.1, 0.5), direction(g)
    angle = np.zeros_like(w.t)
    for at in t0 + np.cumsum(g.exponential(0.08 * w.span, 6)) - 0.05 * w.span:
        slip = 1.0 - np.exp(-np.maximum(w.t - max(float(at), t0), 0.0) / g.uniform(1.0, 12.0))
        angle += g.uniform(0.2, 1.0) * slip
    angle /= max(float(angle[-1]), 1e-9)
    turn = angle[:, None] * u
    text = "the mount of the magnetometer has come loose and settles in slips"
    scaled = xyz("final_angle", "rad", u)
    return Built(lambda x, s: rotate_by(x, -s * turn), None, t0, {}, scaled, (), text)


@recipe("two_state_anode_bracket", "sensor", "field", "jump_gauss", 3e-4, 0.03, outside=True)
def _o5(w: World, g: np.random.Generator) -> Built:
    u = direction(g)
    pull = low_pass((w.h - w.h.mean(axis=0)) @ u, w.motion.dt_fine, 0.5)
    hi, lo = float(np.quantile(pull, 0.8)), float(np.quantile(pull, 0.2))
    state, out = 0.0, []
    for v in pull.tolist():
        state = 1.0 if v > hi else 0.0 if v < lo else state
        out.append(state)
    fixed = {"up_gauss": hi, "down_gauss": lo} | xyz("easy_axis", "ratio", u)
    text = (
        "an anode bracket flips between two magnetic states when the field along it is large enough"
    )
    return course(direction(g), np.array(out), "jump", "gauss", fixed=fixed, words=text)


@recipe("gyro_asymmetric_scale", "gyro", "rate", "difference_share", 1e-3, 0.04, outside=True)
def _o6(w: World, g: np.random.Generator) -> Built:
    k, add = direction(g), np.abs(w.motion.w)
    text = "the gyro scale differs between positive and negative rates"
    scaled = xyz("half_difference", "share", k)
    return Built(lambda x, s: x + s * k * add, scaled=scaled, words=text)


@recipe("tether_twist", "sensor", "field", "field_gauss_per_turn", 1e-4, 5e-3, UNDER, outside=True)
def _o7(w: World, g: np.random.Generator) -> Built:
    r = w.motion.r_nb
    turns = np.unwrap(np.arctan2(r[:, 1, 0], r[:, 0, 0])) / (2 * np.pi)
    wrapped = low_pass(turns - turns[0], w.motion.dt_fine, 3.0)
    text = "the tether winds round the frame, and its magnetised armour with it"
    return course(direction(g), wrapped, "field", "gauss_per_turn", words=text)


@recipe("sliding_toolbox", "sensor", "field", "field_gauss", 3e-4, 0.03, outside=True)
def _o8(w: World, g: np.random.Generator) -> Built:
    tilt = low_pass(w.motion.force[:, 1] / 9.81, w.motion.dt_fine, 0.3)
    hold = 1.1 * float(np.std(tilt))
    spot, speed, out = 0.0, 0.0, []
    dt = w.motion.dt_fine
    for v in (tilt - float(np.median(tilt))).tolist():
        if abs(v) > hold or abs(speed) > 0.02:
            speed += dt * (3.0 * v - 1.5 * speed)
            spot += dt * speed
            if abs(spot) > 0.5:
                spot, speed = math.copysign(0.5, spot), 0.0
        else:
            speed = 0.0
        out.append(spot)
    fixed = {"breakaway_g": hold, "travel_m": 1.0}
    text = "a loose steel tool box slides from side to side when the roll is large enough"
    return course(direction(g), np.array(out), "field", "gauss", fixed=fixed, words=text)


@recipe("interrupted_pipeline", "world", "world", "peak_gauss", 3e-4, 0.05, outside=True)
def _o9(w: World, g: np.random.Generator) -> Built:
    t1, way = onset(w, g, 0.2, 0.8), g.uniform(0.0, 2 * np.pi)
    here = w.motion.position[int(np.searchsorted(w.t, t1))] + np.array([0, 0, g.uniform(3.0, 8.0)])
    u = np.array([math.cos(way), math.sin(way), 0.0])
    period, duty = g.uniform(9.0, 30.0), g.uniform(0.4, 0.8)

    def make(t: Array, p: Array) -> Array:
        arm = p - here
        arm = arm - (arm @ u)[:, None] * u
        on = np.where(np.mod(t, period) < duty * period, 1.0, 0.0)
        wire = np.cross(u, arm) / np.sum(arm**2, axis=1, keepdims=True)
        return np.asarray(2e-3 * wire * on[:, None])  # B = mu0 I / (2 pi r), gauss per ampere

    add, top = peaked(slowly(w, make))
    fixed = {"period_s": period, "duty_ratio": duty} | xyz("point", "m", here, "ned")
    text = "the protection current of a pipeline is switched on and off while the vehicle is near"
    return Built(lambda x, s: x + s * add, None, None, fixed, {"current_a": 1.0 / top}, (), text)


@recipe("slam_gyro_shift", "gyro", "rate", "shift_rad_s", 1e-4, 5e-3, outside=True)
def _o10(w: World, g: np.random.Generator) -> Built:
    load = np.abs(w.motion.force[:, 2] - np.median(w.motion.force[:, 2]))
    hard = (load > np.quantile(load, 0.985)).astype(float)
    start = np.flatnonzero(np.diff(hard, prepend=0.0) > 0)
    tau, hit = g.uniform(2.0, 8.0), np.zeros_like(w.t)
    hit[start] = g.choice([-1.0, 1.0], len(start)) * g.uniform(0.5, 1.0, len(start))
    shape = low_pass(hit, w.motion.dt_fine, tau) * (tau / w.motion.dt_fine)
    shape /= max(float(np.abs(shape).max()), 1e-9)
    fixed = {"recovery_s": tau, "slams": float(len(start))}
    text = "each slam shifts the gyro bias, which then recovers in seconds"
    return course(direction(g), shape, "shift", "rad_s", fixed=fixed, words=text)
