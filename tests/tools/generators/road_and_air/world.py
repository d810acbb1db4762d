"""Concealed-physics recordings of cars, wheeled robots, multicopters and hand-turned sensors.

    python -m generators.road_and_air.world OUT --seed N --null 5 --single 20 --pair 5 ...

writes OUT/ID.csv.gz (columns of contract section 2), OUT/ID.spec.json (noise and rate, or
nothing) and OUT/truth.json.  The IDs say nothing about the kind; the same seed gives the same
files.  The plain ``visibility`` of an effect is the rms change of the readings that is left when
the best constant hard iron, symmetric soft iron and gyro bias are fitted with the TRUE attitude,
over the noise of a sample, times the square root of the number of samples.  Beside it stands
``visibility_without_attitude``: the same when the attitude must come from the noisy gyro.

Left out on purpose: the Earth's rotation is absent unless it is the concealed effect
(contract section 1 has no such term).
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from generators.road_and_air.effects import (
    LIBRARY,
    MG,
    OUTSIDE,
    Effect,
    Maker,
    Readings,
    Scene,
    symmetric,
    unit,
)
from generators.road_and_air.motion import (
    GRAVITY,
    VEHICLES,
    Array,
    Motion,
    Rng,
    low_pass,
    make_motion,
)

GENERATOR = "road_and_air_world/1"
LAWS = ("white", "student", "throttle_vibration", "quantised")
VISIBLE = (8.0, 300.0)
LEAST_WITHOUT_ATTITUDE = 6.0

# Columns that carry the cause of an effect, first the cause, then columns that give it away.
POSITION = ("position_north_m", "position_east_m", "position_down_m")
ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
POWER = ("motor_current_a", "throttle", "battery_v")
WHEELS = ("wheel_rate_rad_s", "rotor_rate_rad_s")
JOINTS = ("steering_angle_rad", "arm_angle_rad", "gimbal_angle_rad")
SWITCHES = ("fan_on", "gripper_on", "lamp_on", "display_on")
CAUSES: dict[str, tuple[str, ...]] = {
    "motor_current_field": ("motor_current_a",),
    "current_derivative_field": ("motor_current_a",),
    "speed_field": ("speed_m_s",),
    "sync_pulses": ("radio_tx",),
    "mag_bias_temperature": ("temperature_c",),
    "mag_scale_temperature": ("temperature_c",),
    "moving_iron": JOINTS,
    "switched_device": SWITCHES,
    "rotor_field": WHEELS,
    "field_gradient": POSITION,
    "field_anomaly": POSITION,
    "altitude_field": ("altitude_m",),
    "gyro_g_sensitivity": ACCEL,
    "flexible_mount": ACCEL,
    "vibration_rectification": (*ACCEL, "throttle"),
    "gyro_bias_temperature": ("temperature_c",),
}
GIVEAWAYS: dict[str, tuple[str, ...]] = {
    "motor_current_field": POWER + WHEELS,
    "current_derivative_field": POWER + WHEELS,
    "speed_field": (*POSITION, *WHEELS, "throttle"),
    "field_gradient": ("altitude_m", "speed_m_s"),
    "field_anomaly": ("altitude_m", "speed_m_s"),
    "altitude_field": ("position_down_m",),
    "vibration_rectification": (*POWER, *WHEELS, "speed_m_s"),
    "rotor_field": ("speed_m_s", *POSITION, *POWER),
}
# Effects of one family are not paired: the motion could not tell such a pair from one of them.
FAMILIES = (
    ("mag_time_lag", "mag_low_pass", "gyro_time_lag", "gyro_integration", "mag_sample_hold"),
    ("gyro_scale", "clock_rate", "gyro_nonlinearity"),
    ("hard_iron_step", "soft_iron_step", "onboard_calibration_active", "hard_iron_drift"),
    ("gyro_bias_step", "gyro_bias_drift", "gyro_startup", "gyro_bias_temperature"),
    ("field_gradient", "field_anomaly", "altitude_field", "field_step", "geomagnetic_drift"),
    ("mag_cross_axis", "mag_nonlinearity", "mag_saturation"),
    ("mag_quantisation", "noise_burst"),
)
NOT_PAIRED = ("noise_level", "frame_error", "unit_error", "gyro_saturation")


@dataclass(frozen=True)
class Log:
    """How a covariate is logged: noise (its unit), resolution (its unit), largest delay (s)."""

    noise: float
    resolution: float
    delay_s: float


LOGS: dict[str, Log] = {
    "temperature_c": Log(0.03, 0.0625, 0.5),
    "motor_current_a": Log(0.08, 0.02, 0.06),
    "throttle": Log(0.002, 0.001, 0.03),
    "battery_v": Log(0.01, 0.01, 0.1),
    "speed_m_s": Log(0.05, 0.01, 0.15),
    "altitude_m": Log(0.08, 0.01, 0.15),
    "steering_angle_rad": Log(0.003, 0.00175, 0.03),
    "arm_angle_rad": Log(0.002, 0.001, 0.02),
    "gimbal_angle_rad": Log(0.002, 0.001, 0.02),
    "wheel_rate_rad_s": Log(0.02, 0.01, 0.01),
    "rotor_rate_rad_s": Log(0.5, 0.1, 0.01),
    "position_north_m": Log(0.02, 0.001, 0.1),
    "position_east_m": Log(0.02, 0.001, 0.1),
    "position_down_m": Log(0.03, 0.001, 0.1),
    "accel_x_m_s2": Log(0.03, 0.001, 0.0),
    "accel_y_m_s2": Log(0.03, 0.001, 0.0),
    "accel_z_m_s2": Log(0.03, 0.001, 0.0),
}
FLAG = Log(0.0, 1.0, 0.0)


@dataclass
class Noise:
    """One draw of the sensors' noise; effective sigmas are in the scene."""

    law: str
    mag: Array
    gyro: Array
    step_mag: float
    step_gyro: float
    jitter: Array


def make_scene(motion: Motion, rng: Rng) -> Scene:
    """Earth field 0.25 to 0.62 G, soft iron to 15 %, hard iron to 0.3 G, and sensor noise.

    The noise goes from better than a VN-100 (dossier section 2) to a cheap sensor:
    0.25 to 3 mG and 0.12 to 4 mrad/s a sample.  det A = 1 (contract section 1).
    """
    dip, declination = rng.uniform(0.3, 1.3) * rng.choice([-1.0, 1.0]), rng.uniform(-0.35, 0.35)
    level = math.cos(dip)
    north = np.array([level * math.cos(declination), level * math.sin(declination), math.sin(dip)])
    soft = np.eye(3) + rng.uniform(0.01, 0.15) * symmetric(rng)
    soft /= np.linalg.det(soft) ** (1.0 / 3.0)
    return Scene(
        motion=motion,
        field_ned=rng.uniform(0.25, 0.62) * north,
        soft_iron=soft,
        hard_iron=rng.uniform(0.02, 0.3) * unit(rng),
        gyro_bias=rng.uniform(0.0005, 0.02) * unit(rng),
        sigma_mag=float(np.exp(rng.uniform(math.log(0.25), math.log(3.0)))) * MG,
        sigma_gyro=float(np.exp(rng.uniform(math.log(1.2e-4), math.log(4e-3)))),
    )


def make_noise(s: Scene, rng: Rng, law: str, jitter: bool) -> Noise:
    """Noise with the scene's sigma a sample: white, Student (4 to 7 degrees of freedom), with a
    spread that follows the vibration of the throttle, or white and rounded to coarse steps.

    Jitter of the host's time stamps is 1 to 4 % of a step (normal, clipped at 3 sigma).
    """
    count = len(s.rate)
    gain: Array = np.ones(count)
    steps = (0.0, 0.0)
    sizes = (s.sigma_mag, s.sigma_gyro)
    freedom = 0.0
    if law == "student":
        freedom = float(rng.uniform(4.0, 7.0))
    elif law == "throttle_vibration":
        shake = s.motion.vibration_g[s.motion.index]
        gain = 1.0 + float(rng.uniform(0.5, 2.5)) * shake / shake.max()
        gain = gain / np.sqrt(np.mean(gain**2))
    elif law == "quantised":
        widths = rng.uniform(0.8, 2.2, 2)
        steps = (float(widths[0] * s.sigma_mag), float(widths[1] * s.sigma_gyro))
        sizes = (
            math.sqrt(s.sigma_mag**2 - steps[0] ** 2 / 12.0),
            math.sqrt(s.sigma_gyro**2 - steps[1] ** 2 / 12.0),
        )

    def draw(size: float) -> Array:
        if freedom:
            x = rng.standard_t(freedom, (count, 3)) / math.sqrt(freedom / (freedom - 2.0))
        else:
            x = rng.standard_normal((count, 3))
        return np.asarray(size * gain[:, None] * x)

    mag, gyro = draw(sizes[0]), draw(sizes[1])
    stamps = np.clip(rng.standard_normal(count), -3, 3) * rng.uniform(0.01, 0.04)
    stamps *= s.motion.step_s if jitter else 0.0
    name = f"{law}+host_jitter" if jitter else law
    return Noise(name, mag, gyro, steps[0], steps[1], stamps)


def read(s: Scene, effects: list[tuple[Effect, float]], noise: Noise | None = None) -> Readings:
    """The sensor's readings: world -> body -> iron -> response -> samples -> noise -> row.

    Without ``noise`` the readings are exact; with it, noise and rounding follow the analogue part.
    """
    m = s.motion

    def act(stage: str) -> None:
        for effect, size in effects:
            if effect.stage == stage:
                effect.hook(r, size)

    r = Readings(
        time=np.arange(1, len(s.rate) + 1) * m.step_s,
        world=np.empty(0),
        body=s.body.copy(),
        mag=np.empty(0),
        mag_k=np.empty(0),
        gyro_k=s.rate + s.gyro_bias,
        keep=np.ones(len(s.rate), dtype=bool),
    )
    if any(effect.stage == "world" for effect, _ in effects):
        r.world = np.tile(s.field_ned, (len(m.time_s), 1))
        act("world")
        r.body = np.einsum("nij,ni->nj", m.rotation, r.world)
    act("body")
    r.mag = r.body @ s.soft_iron + s.hard_iron
    act("iron")
    act("response")
    r.mag_k = r.mag[m.index].copy()
    act("sampled")
    act("gyro")
    if noise is not None:
        r.mag_k += noise.mag
        r.gyro_k += noise.gyro
        if noise.step_mag > 0:
            r.mag_k = np.round(r.mag_k / noise.step_mag) * noise.step_mag
            r.gyro_k = np.round(r.gyro_k / noise.step_gyro) * noise.step_gyro
        r.time = r.time + noise.jitter
    act("digit")
    act("table")
    return r


def change_of(s: Scene, effect: Effect, size: float) -> tuple[Array, Array]:
    """What the effect alone changes in the noise-free magnetometer (gauss) and gyro (rad/s)."""
    if effect.equivalent is not None:
        return effect.equivalent(size)
    clean, changed = read(s, []), read(s, [(effect, size)])
    return changed.mag_k - clean.mag_k, changed.gyro_k - clean.gyro_k


def iron_columns(h: Array) -> list[Array]:
    """Change of the reading (samples x 3) for the six soft-iron and three hard-iron unknowns."""
    columns = []
    for i in range(3):
        for j in range(i, 3):
            c = np.zeros_like(h)
            c[:, i] += h[:, j]
            if i != j:
                c[:, j] += h[:, i]
            columns.append(c)
    return columns + [np.tile(e, (len(h), 1)) for e in np.eye(3)]


def left_over(columns: list[Array], y: Array) -> float:
    """Norm of what is left of ``y`` after the best combination of the columns."""
    design = np.stack([c.ravel() for c in columns], axis=1)
    scale = np.linalg.norm(design, axis=0)
    design = design / np.where(scale > 0, scale, 1.0)
    answer, *_ = np.linalg.lstsq(design.T @ design, design.T @ y.ravel(), rcond=1e-11)
    return float(np.linalg.norm(y.ravel() - design @ answer))


def whitened(s: Scene, d_mag: Array | None, d_gyro: Array | None) -> Array:
    """Small changes of the readings as the innovations of the best filter that has no attitude.

    A magnetometer change is taken to the world frame; a gyro change adds up to a rotation of the
    predicted field.  Across the field the sum is random walk (gyro noise) plus white noise
    (magnetometer), whose whitening filter is that of the steady Kalman filter (dossier 3.1);
    along the field only the magnetometer counts.  Sensor noise comes out white with sigma 1.
    """
    strength = float(np.linalg.norm(s.field_ned))
    along = s.field_ned / strength
    frame = np.concatenate([along[None, :], np.linalg.svd(along[None, :])[2][1:]], axis=0)
    q, r = (s.sigma_gyro * s.motion.step_s * strength) ** 2, s.sigma_mag**2
    predicted = 0.5 * (q + math.sqrt(q * q + 4 * q * r))
    gain = predicted / (predicted + r)
    turn = s.motion.rotation[s.motion.index]
    world: Array = np.zeros_like(s.rate)
    if d_mag is not None:
        world = world + np.einsum("nij,nj->ni", turn, d_mag @ np.linalg.inv(s.soft_iron))
    if d_gyro is not None:
        swung = np.cumsum(np.einsum("nij,nj->ni", turn, d_gyro), axis=0) * s.motion.step_s
        world = world - np.cross(s.field_ned, swung)
    return whiten_field(world @ frame.T, s.sigma_mag, gain, math.sqrt(predicted + r))


def whiten_field(y: Array, sigma_mag: float, gain: float, sigma: float) -> Array:
    """White along the field (first column), random walk plus white noise across it."""
    tail = lfilter([1.0, -1.0], [1.0, gain - 1.0], y[:, 1:], axis=0)
    return np.concatenate([y[:, :1] / sigma_mag, tail / sigma], axis=1)


def visibility(s: Scene, d_mag: Array, d_gyro: Array) -> tuple[float, float]:
    """Plain visibility (true attitude known) and the visibility without the attitude.

    Plain: sqrt(N) * rms left after hard iron, soft iron and gyro bias, over sigma.  Without the
    attitude: the same for the innovations of ``whitened``, with the start field as well.
    """
    h = s.body[s.motion.index]
    iron = iron_columns(h)
    mag = left_over(iron, d_mag) / s.sigma_mag if np.any(d_mag) else 0.0
    gyro = float(np.linalg.norm(d_gyro - d_gyro.mean(axis=0))) / s.sigma_gyro
    columns = nuisance(s, iron)
    return math.hypot(mag, gyro), left_over(columns, whitened(s, d_mag, d_gyro))


def nuisance(s: Scene, iron: list[Array]) -> list[Array]:
    """Whitened columns of soft iron, hard iron, gyro bias and the unknown field at the start."""
    axes = [np.tile(e, (len(s.rate), 1)) for e in np.eye(3)]
    turn = s.motion.rotation[s.motion.index]
    columns = [whitened(s, c, None) for c in iron] + [whitened(s, None, c) for c in axes]
    fixed = [np.einsum("nij,ni->nj", turn, c) @ s.soft_iron for c in axes]
    return columns + [whitened(s, c, None) for c in fixed]


def settle_size(s: Scene, effect: Effect, rng: Rng) -> tuple[float, float, float] | None:
    """A size within the typical range whose visibility is near a log-uniform target, or None."""
    target = float(np.exp(rng.uniform(math.log(12.0), math.log(270.0))))
    judge = 1 if effect.fast else 0
    size = math.sqrt(effect.low * effect.high)
    seen = (0.0, 0.0)
    for _ in range(4):
        seen = visibility(s, *change_of(s, effect, size))
        if effect.free_size or effect.low == effect.high:
            break
        if abs(math.log(max(seen[judge], 1e-9) / target)) < 0.15:
            break
        better = float(np.clip(size * target / max(seen[judge], 1e-9), effect.low, effect.high))
        if better == size:
            break
        size = better
    if effect.free_size and effect.low < effect.high:
        size = float(np.exp(rng.uniform(math.log(effect.low), math.log(effect.high))))
        seen = visibility(s, *change_of(s, effect, size))
    fits = VISIBLE[0] <= seen[judge] <= VISIBLE[1] or effect.free_size
    return (size, *seen) if fits and seen[1] >= LEAST_WITHOUT_ATTITUDE else None


@dataclass
class Case:
    """One case of the plan and, once made, everything that is written about it."""

    ident: str
    kind: str
    names: list[str]
    scene: Scene | None = None
    noise: Noise | None = None
    effects: list[tuple[Effect, float]] = field(default_factory=list)
    seen: list[tuple[float, float]] = field(default_factory=list)
    withheld: list[str] = field(default_factory=list)
    table: dict[str, Array] = field(default_factory=dict)
    spec: dict[str, float] = field(default_factory=dict)


def true_channels(s: Scene, noise_rng: Rng) -> dict[str, Array]:
    """Fine-grid truth of every column that the vehicle logs."""
    m = s.motion
    truth = dict(m.channels)
    offset = noise_rng.uniform(-20, 20, 3) * (m.vehicle != "hand")
    for i, name in enumerate(POSITION):
        truth[name] = m.position[:, i] + offset[i]
    for i, name in enumerate(ACCEL):
        truth[name] = m.force[:, i]
    return truth


def log_column(name: str, s: Scene, fine: Array, rng: Rng) -> Array:
    """The logged column: delayed, sampled, with its own noise and resolution."""
    m = s.motion
    how = LOGS.get(name, FLAG)
    late = int(rng.uniform(0.2, 1.0) * how.delay_s / m.time_s[1])
    values = fine[np.maximum(m.index - late, 0)].astype(float)
    spread: Array = np.full(len(values), how.noise)
    if name in ACCEL:
        spread = spread + 0.5 * GRAVITY * m.vibration_g[m.index]
    if name in POSITION and m.vehicle in ("car", "copter"):
        walk = low_pass(rng.standard_normal(len(values)), 20.0, m.step_s)
        values = values + 0.4 * walk / max(float(np.std(walk)), 1e-12)
    values = values + spread * rng.standard_normal(len(values))
    return np.asarray(np.round(values / how.resolution) * how.resolution + 0.0)


def fill_table(case: Case, rng: Rng) -> None:
    """Rows of the recording: time, magnetometer, gyro, and the covariates that are logged."""
    s, noise = case.scene, case.noise
    if s is None or noise is None:
        raise ValueError("the case has no scene yet")
    r = read(s, case.effects, noise)
    table = {"time_s": r.time}
    for i, a in enumerate("xyz"):
        table[f"mag_{a}_gauss"] = r.mag_k[:, i]
    for i, a in enumerate("xyz"):
        table[f"gyro_{a}_rad_s"] = r.gyro_k[:, i]
    truth = true_channels(s, rng)
    needed = {c for name in case.names for c in CAUSES.get(name, ())}
    groups: list[tuple[str, ...]] = [ACCEL, POSITION]
    groups += [(c,) for c in truth if c not in ACCEL + POSITION]
    hidden: set[str] = set()
    if case.kind == "withheld":
        hidden = needed | {c for name in case.names for c in GIVEAWAYS.get(name, ())}
    for group in groups:
        wanted = rng.random() < 0.85 or any(c in needed for c in group)
        for name in group:
            column = log_column(name, s, truth[name], rng)
            if name in hidden:
                case.withheld.append(name)
            elif wanted:
                table[name] = column
    case.table = {name: column[r.keep] for name, column in table.items()}
    must_know = "noise_level" in case.names
    if rng.random() < 0.5 or must_know:
        case.spec = {
            "sigma_mag_gauss": round(s.sigma_mag, 8),
            "sigma_gyro_rad_s": round(s.sigma_gyro, 8),
            "rate_hz": s.motion.rate_hz,
        }


def make_case(case: Case, rng: Rng) -> None:
    """Draw motion, sensor and sizes until every effect is visible and within its typical size."""
    makers: list[Maker] = [{**LIBRARY, **OUTSIDE}[name] for name in case.names]
    motion: Motion | None = None
    for attempt in range(120):
        if motion is None or attempt % 4 == 0:
            motion = make_motion(str(rng.choice(VEHICLES)), rng)
        scene = make_scene(motion, rng)
        drawn: list[tuple[Effect, float]] = []
        seen: list[tuple[float, float]] = []
        for maker in makers:
            effect = maker(scene, rng)
            if effect is None:
                break
            settled = settle_size(scene, effect, rng)
            if settled is None:
                break
            drawn.append((effect, settled[0]))
            seen.append((settled[1], settled[2]))
        if len(drawn) == len(makers):
            law = str(rng.choice(LAWS))
            jitter = bool(rng.random() < 0.3) and "timestamp_jitter" not in case.names
            rounded_twice = law == "quantised" and "mag_quantisation" in case.names
            if rounded_twice or (law == "throttle_vibration" and motion.vehicle == "hand"):
                law = "white"
            case.scene, case.effects, case.seen = scene, drawn, seen
            case.noise = make_noise(scene, rng, law, jitter)
            fill_table(case, rng)
            return
    raise RuntimeError(f"no motion shows {case.names} within the typical sizes")


def plan(seed: int, counts: dict[str, int]) -> list[Case]:
    """Kinds and effect names of all cases, and IDs that say nothing about them."""
    rng = np.random.default_rng([seed, 0xA1])
    known = [str(n) for n in rng.permutation(sorted(LIBRARY))]
    strange = [str(n) for n in rng.permutation(sorted(OUTSIDE))]
    causes = [str(n) for n in rng.permutation(sorted(CAUSES))]
    names: list[tuple[str, list[str]]] = [("null", [])] * counts["null"]
    names += [("single", [known[i % len(known)]]) for i in range(counts["single"])]
    fit = [n for n in known if n not in NOT_PAIRED]
    for _ in range(counts["pair"]):
        while True:
            a, b = (str(n) for n in rng.choice(fit, 2, replace=False))
            if not any(a in family and b in family for family in FAMILIES):
                break
        names.append(("pair", [a, b]))
    names += [("withheld", [causes[i % len(causes)]]) for i in range(counts["withheld"])]
    names += [("outside", [strange[i % len(strange)]]) for i in range(counts["outside"])]
    tags = rng.choice(36**4, len(names), replace=False)
    digits = "0123456789abcdefghijklmnopqrstuvwxyz"
    idents = ["r" + "".join(digits[int(t) // 36**k % 36] for k in range(4)) for t in tags]
    cases = [Case(i, kind, chosen) for i, (kind, chosen) in zip(idents, names, strict=True)]
    return sorted(cases, key=lambda case: case.ident)


def make_cases(seed: int, counts: dict[str, int]) -> list[Case]:
    """All cases of a seed, in memory (the command makes and writes them one by one)."""
    cases = plan(seed, counts)
    for index, case in enumerate(cases):
        make_case(case, np.random.default_rng([seed, index]))
    return cases


FORMATS = {"time": "%.6f", "mag": "%.8f", "gyro": "%.9f"}


def write_table(path: Path, table: dict[str, Array]) -> None:
    """A gzip'd CSV file without clock or name in its header: equal data are equal bytes."""
    kinds = [FORMATS.get(name.split("_")[0], "%.6g") for name in table]
    line = ",".join(kinds) + "\n"
    rows = np.stack(list(table.values()), axis=1)
    text = ",".join(table) + "\n" + "".join(line % tuple(row) for row in rows.tolist())
    with path.open("wb") as raw, gzip.GzipFile("", "wb", 6, raw, 0) as packed:
        packed.write(text.encode())


def jitter_visibility(s: Scene, noise: Noise) -> float:
    """Visibility (without attitude) of the ordinary host jitter to one who trusts the stamps."""
    if not np.any(noise.jitter):
        return 0.0
    error = s.rate * np.diff(noise.jitter, prepend=0.0)[:, None] * s.motion.rate_hz
    return visibility(s, np.zeros_like(error), error)[1]


def truth_of(case: Case) -> dict[str, Any]:
    """The entry of truth.json for a case."""
    s, noise = case.scene, case.noise
    if s is None or noise is None:
        raise ValueError("the case has not been made")
    effects = [
        {
            "effect": effect.name,
            "onset_s": None if effect.onset is None else round(effect.onset, 3),
            "frame": effect.frame,
            "parameters": effect.parameters(size),
            "visibility": round(seen[0], 2),
            "visibility_without_attitude": round(seen[1], 2),
        }
        for (effect, size), seen in zip(case.effects, case.seen, strict=True)
    ]
    sentences = [effect.what for effect, _ in case.effects] or ["Nothing is concealed."]
    return {
        "id": case.ident,
        "kind": case.kind,
        "vehicle": s.motion.vehicle,
        "noise": noise.law,
        "effects": effects,
        "withheld": case.withheld,
        "host_jitter_visibility": round(jitter_visibility(s, noise), 2),
        "what": " ".join(sentences),
        "rate_hz": s.motion.rate_hz,
        "duration_s": round(s.duration, 3),
        "sigma_mag_gauss": s.sigma_mag,
        "sigma_gyro_rad_s": s.sigma_gyro,
        "soft_iron": s.soft_iron.tolist(),
        "hard_iron_gauss": s.hard_iron.tolist(),
        "gyro_bias_rad_s": s.gyro_bias.tolist(),
        "field_ned_gauss": s.field_ned.tolist(),
    }


def main(arguments: list[str] | None = None) -> int:
    """Command line: write the recordings, their specifications and the truth."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--seed", type=int, default=1)
    for kind, usual in (("null", 5), ("single", 20), ("pair", 5), ("withheld", 5), ("outside", 5)):
        parser.add_argument(f"--{kind}", type=int, default=usual)
    options = parser.parse_args(arguments)
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    counts = {
        k: int(getattr(options, k)) for k in ("null", "single", "pair", "withheld", "outside")
    }
    entries = []
    for index, case in enumerate(plan(options.seed, counts)):
        make_case(case, np.random.default_rng([options.seed, index]))
        write_table(out / f"{case.ident}.csv.gz", case.table)
        (out / f"{case.ident}.spec.json").write_text(json.dumps(case.spec, indent=1) + "\n")
        entries.append(truth_of(case))
        case.scene, case.noise, case.effects, case.table = None, None, [], {}
    truth = {"generator": GENERATOR, "seed": options.seed, "cases": entries}
    (out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
