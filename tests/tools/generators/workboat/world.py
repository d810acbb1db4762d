"""Concealed physics on working vehicles at sea: recordings and their truth, for blind trials.

    python -m generators.workboat.world OUT --seed N --null 5 --single 20 --pair 5 ...

writes OUT/ID.csv.gz (columns of contract section 2), OUT/ID.spec.json (in half of the cases)
and OUT/truth.json. Model and signs are those of contract section 1. The vehicles are in
motion.py, the effects (dossier section 2) in effects.py.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from generators.workboat.effects import ALL, RECIPES, Built, Readings, Recipe, World
from generators.workboat.motion import Array, BoolArray, Motion, build_motion, wander

GENERATOR = "workboat_world 1"
VISIBLE = (8.0, 300.0)
NOISE_LAWS = (
    "white",
    "white_gaps",
    "heavy_tailed",
    "heavy_tailed_gaps",
    "red",
    "red_gaps",
    "heavy_tailed_red_gaps",
)
# Places where such vehicles work: latitude deg, field gauss, inclination deg, declination deg.
SITES = {
    "north_sea": (56.0, 0.503, 70.0, 1.0),
    "norwegian_coast": (66.0, 0.524, 75.5, 5.0),
    "gulf_of_mexico": (27.5, 0.452, 56.0, -2.0),
    "canary_islands": (28.0, 0.388, 38.0, -4.0),
    "santos_basin": (-25.0, 0.229, -40.0, -22.0),
    "malacca_strait": (2.0, 0.421, -12.0, 0.0),
    "bass_strait": (-40.0, 0.605, -70.0, 12.0),
    "persian_gulf": (26.5, 0.443, 40.5, 2.0),
}
# Own noise, resolution and logging rate (0 = every row) of the other instruments.
INSTRUMENTS: dict[str, tuple[float, float, float]] = {
    "temperature_c": (0.03, 0.0625, 1.0),
    "motor_current_a": (0.05, 0.05, 0.0),
    "vertical_current_a": (0.05, 0.05, 0.0),
    "motor_rpm": (2.0, 1.0, 10.0),
    "speed_m_s": (0.02, 0.005, 5.0),
    "depth_m": (0.01, 0.01, 0.0),
    "pressure_kpa": (0.02, 0.01, 0.0),
    "altitude_m": (0.03, 0.01, 5.0),
    "rudder_angle_rad": (0.002, 0.001, 0.0),
    "elevator_angle_rad": (0.002, 0.001, 0.0),
    "wing_angle_rad": (0.002, 0.001, 0.0),
    "manipulator_angle_rad": (0.002, 0.001, 0.0),
    "lamp_on": (0.0, 1.0, 0.0),
}
POSITION = ("position_north_m", "position_east_m", "position_down_m")
ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")


@dataclass
class Active:
    """An effect in force: recipe, what was drawn, its size, its visibility."""

    recipe: Recipe
    built: Built
    size: float
    visibility: float = 0.0
    without_attitude: float = 0.0

    def truth(self, stamps: Array, true_time: Array) -> dict[str, object]:
        """The entry of truth.json; the onset is given on the clock of the time column."""
        b, p = self.built, {self.recipe.size: self.size}
        p |= b.fixed | {k: v * self.size for k, v in b.scaled.items()}
        p |= b.derived(self.size) if b.derived else {}
        at = None if b.onset is None else round(float(np.interp(b.onset, true_time, stamps)), 3)
        return {
            "effect": self.recipe.name,
            "onset_s": at,
            "frame": self.recipe.frame,
            "parameters": {k: float(f"{v:.6g}") for k, v in p.items()},
            "visibility": round(self.visibility, 2),
            "visibility_without_attitude": round(self.without_attitude, 2),
            "words": b.words,
        }


@dataclass
class Case:
    """One recording with its truth; ``table`` holds the columns of the rows that were logged."""

    kind: str
    noise: str
    site: str
    world: World
    effects: list[Active]
    readings: Readings
    table: dict[str, Array]
    withheld: list[str] = field(default_factory=list)


def draw_noise(
    g: np.random.Generator, law: str, n: int, rate_hz: float
) -> tuple[Array, Array, BoolArray]:
    """Unit-variance noise for magnetometer and gyro, and the rows that the logger missed.

    Heavy tails are Student t with 5 to 8 degrees of freedom; red noise has 5 to 30 % of the
    magnetometer power with 0.5 to 2 s (dossier 4.2) and 2 to 6 % of the gyro power.
    """
    nu = g.uniform(5.0, 8.0)

    def white() -> Array:
        if "heavy" in law:
            return np.asarray(g.standard_t(nu, (n, 3)) * math.sqrt((nu - 2.0) / nu))
        return g.standard_normal((n, 3))

    mag, gyro = white(), white()
    if "red" in law:
        for x, lo, hi, slow in ((mag, 0.05, 0.3, 2.0), (gyro, 0.02, 0.06, 5.0)):
            share, tau = g.uniform(lo, hi), g.uniform(0.5, slow)
            own = np.stack([wander(g, n, 1.0 / rate_hz, tau) for _ in range(3)], axis=1)
            x[:] = math.sqrt(1.0 - share) * x + math.sqrt(share) * own
    gaps = np.zeros(n, dtype=np.bool_)
    if "gaps" in law:
        for _ in range(int(g.integers(1, 6))):
            a = int(g.integers(n // 20, n - n // 20))
            gaps[a : a + max(1, int(g.uniform(0.1, 3.0) * rate_hz))] = True
    return mag, gyro, gaps


def draw_world(g: np.random.Generator, vehicle: str, law: str, site: str) -> World:
    """Draw motion, place, iron, bias and noise of one recording.

    Hard iron up to 0.3 G, soft iron up to 15 % with det A = 1, gyro bias of a few mrad/s.
    """
    rate = float(g.choice([10.0, 12.5, 20.0, 25.0, 25.0, 40.0, 50.0]))
    motion = build_motion(g, vehicle, float(np.round(g.uniform(200.0, 600.0), 1)), rate)
    lat, strength, dip, dec = SITES[site]
    dip, dec = math.radians(dip + g.normal()), math.radians(dec + g.normal())
    unit = [math.cos(dip) * math.cos(dec), math.cos(dip) * math.sin(dec), math.sin(dip)]
    field_n = strength * (1.0 + 0.01 * g.normal()) * np.array(unit)
    s = g.standard_normal((3, 3))
    s = s + s.T
    s -= np.eye(3) * np.trace(s) / 3.0
    value, vector = np.linalg.eigh(s / np.linalg.norm(s, 2) * g.uniform(0.02, 0.14))
    hard = g.standard_normal(3)
    hard *= g.uniform(0.02, 0.3) / np.linalg.norm(hard)
    mag, gyro, gaps = draw_noise(g, law, len(motion.index), rate)
    return World(
        motion=motion,
        field_n=field_n,
        latitude_rad=math.radians(lat),
        soft_iron=(vector * np.exp(value)) @ vector.T,
        hard_iron=hard,
        gyro_bias=g.normal(0.0, 3e-3, 3),
        sigma_mag=math.exp(g.uniform(math.log(0.4e-3), math.log(2.5e-3))),
        sigma_gyro=math.exp(g.uniform(math.log(1.5e-4), math.log(3e-3))),
        noise_mag=mag,
        noise_gyro=gyro,
        gaps=gaps,
        h=np.asarray(np.einsum("kji,j->ki", motion.r_nb, field_n)),
    )


def render(w: World, effects: list[Active]) -> Readings:
    """Make the readings: field, mount, iron, electronics, noise, coarse reading, logger."""

    def through(stage: str, x: Array) -> Array:
        for e in effects:
            if e.recipe.stage == stage and e.built.act is not None:
                x = e.built.act(x, e.size)
        return x

    m, h = w.motion, w.h
    if any(e.recipe.stage == "world" for e in effects):
        n = through("world", np.broadcast_to(w.field_n, w.h.shape))
        h = np.asarray(np.einsum("kji,kj->ki", m.r_nb, n))
    h = through("body", h)
    sensed = through("electronics", through("field", h @ w.soft_iron.T + w.hard_iron))
    mag = through("mag", sensed[m.index] + w.sigma_mag * w.noise_mag)
    gyro = m.step_rate + w.gyro_bias + w.sigma_gyro * w.noise_gyro
    if any(e.recipe.stage == "rate" for e in effects):
        gyro = gyro + m.step_mean(through("rate", m.w) - m.w)
    gyro = through("gyro", gyro)
    r = Readings(w.ts.copy(), mag, gyro, ~w.gaps, np.zeros_like(gyro), np.zeros_like(mag))
    for e in effects:
        if e.built.rows is not None:
            r = e.built.rows(r, e.size)
    return r


def calibration_basis(w: World) -> Array:
    """Orthonormal basis of what hard and symmetric soft iron can do to the readings (3N x 9).

    The first three columns are the hard iron.
    """
    h = w.h[w.motion.index]
    columns = []
    for i in range(3):
        d = np.zeros_like(h)
        d[:, i] = 1.0
        columns.append(d.ravel())
    for i in range(3):
        for j in range(i, 3):
            d = np.zeros_like(h)
            d[:, i] += h[:, j]
            if i != j:
                d[:, j] += h[:, i]
            columns.append(d.ravel())
    q, r = np.linalg.qr(np.stack(columns, axis=1))
    return np.asarray(q[:, np.abs(np.diag(r)) > 1e-9 * np.abs(r).max()])


def visibility(w: World, basis: Array, base: Readings, changed: Readings) -> float:
    """Plain visibility: what is left of the change after the best constant calibration.

    rms(rest) / noise per sample x sqrt(samples), magnetometer and gyro together, with the true
    attitude; hard iron, symmetric soft iron and gyro bias are fitted by least squares.
    """
    d = (changed.mag - base.mag + changed.hidden_mag).ravel()
    d = d - basis @ (basis.T @ d)
    e = changed.gyro - base.gyro + changed.hidden_gyro
    e = e - e.mean(axis=0)
    return math.sqrt(float(d @ d) / w.sigma_mag**2 + float(np.sum(e * e)) / w.sigma_gyro**2)


def visibility_without_attitude(w: World, effects: list[Active]) -> None:
    """A second, harder number: the same when the attitude is known from gyro and magnetometer only.

    The attitude error (world frame, rad) walks with the gyro noise and is tracked by a Kalman
    filter whose whitened innovations of the change, of the nine calibration columns and of the
    gyro bias are formed together; what is left of the change after projecting the other twelve is
    the square root of the noncentrality that the best possible test has in white noise.
    """
    m, n = w.motion, len(w.motion.index)
    r = m.r_nb[m.index]
    x, y, z = w.field_n
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    h = w.soft_iron @ np.swapaxes(r, 1, 2) @ cross
    base, k = render(w, []), len(effects)
    mag, turn = np.zeros((n, 3, k + 12)), np.zeros((n, 3, k + 12))
    for j, e in enumerate(effects):
        got = render(w, [e])
        mag[:, :, j] = got.mag - base.mag + got.hidden_mag
        rate = got.gyro - base.gyro + got.hidden_gyro
        turn[:, :, j] = np.einsum("kij,kj->ki", r, rate) * w.dt
    basis = calibration_basis(w)
    mag[:, :, k : k + basis.shape[1]] = basis.reshape(n, 3, -1)
    turn[:, :, k + 9 :] = r * w.dt
    p, state, white = np.eye(3), np.zeros((3, k + 12)), np.empty((n, 3, k + 12))
    q, v, eye = (w.sigma_gyro * w.dt) ** 2 * np.eye(3), w.sigma_mag**2 * np.eye(3), np.eye(3)
    for i in range(n):
        p = p + q
        state = state + turn[i]
        ph = p @ h[i].T
        s = np.linalg.inv(h[i] @ ph + v)
        e_i = mag[i] - h[i] @ state
        white[i] = np.linalg.cholesky(s).T @ e_i
        gain = ph @ s
        state = state + gain @ e_i
        p = (eye - gain @ h[i]) @ p
        p = 0.5 * (p + p.T)
    flat = white.reshape(3 * n, -1)
    scale = np.maximum(np.linalg.norm(flat[:, k:], axis=0), 1e-30)
    u, sv, _ = np.linalg.svd(flat[:, k:] / scale, full_matrices=False)
    u = u[:, sv > 1e-8 * sv[0]]
    rest = flat[:, :k] - u @ (u.T @ flat[:, :k])
    for j, e in enumerate(effects):
        e.without_attitude = float(np.linalg.norm(rest[:, j]))


def sized(w: World, basis: Array, base: Readings, r: Recipe, b: Built, want: float) -> Active:
    """Scale an effect inside its typical limits until its visibility is near ``want``."""
    size, got = math.sqrt(r.low * r.high), 0.0
    if r.family == "gross":  # a free soft iron would undo a swap of axes, and no size is drawn
        got = visibility(w, basis[:, :3], base, render(w, [Active(r, b, 1.0)]))
        return Active(r, b, 1.0, got, got)
    for _ in range(6):
        got = visibility(w, basis, base, render(w, [Active(r, b, size)]))
        new = min(r.high, max(r.low, size * want / max(got, 1e-6)))
        if abs(math.log(new / size)) < 0.05:
            break
        size = new
    else:
        got = visibility(w, basis, base, render(w, [Active(r, b, size)]))
    return Active(r, b, size, got)


def observed(g: np.random.Generator, name: str, x: Array, ts: Array) -> Array:
    """A covariate as its own instrument logs it: noise, resolution, held between its updates."""
    sigma, step, hz = INSTRUMENTS[name]
    y = x + sigma * g.standard_normal(len(x))
    if name.endswith("current_a"):
        y *= 1.0 + 0.005 * g.standard_normal(len(x))
    if hz > 0.0:
        fresh = np.diff(np.floor(ts * hz + 1e-9), prepend=-1.0) > 0
        y = y[np.maximum.accumulate(np.where(fresh, np.arange(len(y)), 0))]
    return np.asarray(np.round(y / step) * step)


def covariates(g: np.random.Generator, m: Motion) -> dict[str, Array]:
    """Everything else that the vehicle logs, at the sample times."""
    ts, at = m.t[m.index], m.index
    out: dict[str, Array] = {}
    force = m.step_mean(m.force)
    shake = m.vibration[at][:, None] * g.standard_normal(force.shape)
    accel = np.round((force + shake + 0.02 * g.standard_normal(force.shape)) / 0.002) * 0.002
    out |= {n: accel[:, i] for i, n in enumerate(ACCEL)}
    for name in sorted(m.signals):
        out[name] = observed(g, name, m.signals[name][at], ts)
    slow = 0.4 if m.vehicle == "work_boat" else 0.15
    for i, name in enumerate(POSITION):
        error = slow * wander(g, len(ts), 1.0 / m.rate_hz, 60.0) + 0.02 * g.standard_normal(len(ts))
        out[name] = np.round((m.position[at, i] + error) / 0.01) * 0.01
    return out


def tabulate(g: np.random.Generator, case: Case) -> None:
    """Fill the table: fixed columns, then the covariates, some of which this logger lacks."""
    r, keep = case.readings, case.readings.keep
    table = {"time_s": r.time}
    table |= {f"mag_{a}_gauss": r.mag[:, i] for i, a in enumerate("xyz")}
    table |= {f"gyro_{a}_rad_s": r.gyro[:, i] for i, a in enumerate("xyz")}
    extra = covariates(g, case.world.motion)
    needed = {n for e in case.effects for n in e.built.needs} if case.kind != "withheld" else set()
    for group in (ACCEL, POSITION, *((n,) for n in sorted(case.world.motion.signals))):
        lacking = g.random() < 0.12
        if set(group) & set(case.withheld):
            group = tuple(n for n in group if n not in case.withheld)
        elif lacking and not needed & set(group):
            continue
        table |= {n: extra[n] for n in group}
    case.table = {name: np.asarray(x[keep]) for name, x in table.items()}


def draw_case(
    g: np.random.Generator, kind: str, names: tuple[str, ...], attempts: int = 40
) -> Case:
    """Draw one recording that conceals the named effects at a visibility inside the limits.

    The visibility without attitude must reach 5 (10 in pairs), else nobody could see the effect.
    """
    recipes = [RECIPES[n] for n in names]
    shared = [v for v in ALL if all(v in r.vehicles for r in recipes)]
    w, basis = None, np.zeros((0, 0))
    law, site = str(g.choice(NOISE_LAWS)), str(g.choice(list(SITES)))
    lo, hi = (20.0, 200.0) if kind == "pair" else VISIBLE
    floor = 10.0 if kind == "pair" else 5.0
    for attempt in range(attempts):
        if w is None or attempt % 5 == 0:
            w = draw_world(g, str(g.choice(shared)), law, site)
            basis = calibration_basis(w)
        else:  # same voyage, another grade of sensor
            grade = math.exp(g.uniform(math.log(0.4e-3), math.log(2.5e-3)))
            fine = math.exp(g.uniform(math.log(1.5e-4), math.log(3e-3)))
            w = replace(w, sigma_mag=grade, sigma_gyro=fine)
        base = render(w, [])
        effects: list[Active] = []
        for r in recipes:
            want = math.exp(g.uniform(math.log(lo * 1.2), math.log(hi / 1.2)))
            e = sized(w, basis, base, r, r.draw(w, g), want)
            if r.family != "gross":
                if not lo <= e.visibility <= hi:
                    break
                visibility_without_attitude(w, [e])
                if (
                    e.without_attitude < floor
                ):  # hidden by the gyro noise: make it larger if typical
                    e.size = min(r.high, e.size * floor * g.uniform(1.1, 2.0) / e.without_attitude)
                    e.visibility = visibility(w, basis, base, render(w, [e]))
                    visibility_without_attitude(w, [e])
                if not lo <= e.visibility <= hi or e.without_attitude < floor:
                    break
            if kind == "withheld" and not e.built.needs:
                break
            effects.append(e)
        if len(effects) == len(recipes):
            break
    else:
        raise RuntimeError(f"{names} could not be made visible within {VISIBLE}")
    case = Case(kind, law, site, w, effects, render(w, effects), {})
    if kind == "withheld":
        logged = (*ACCEL, *POSITION, *w.motion.signals)
        case.withheld = [n for n in effects[0].built.needs if n in logged]
    tabulate(g, case)
    return case


def plan(g: np.random.Generator, counts: dict[str, int]) -> list[tuple[str, tuple[str, ...]]]:
    """Which kinds and effects the trial holds, in an order that tells nothing.

    Singles go through the whole library before one comes twice; gross faults of units and axes
    are singles only. Pairs take two families that cannot cancel each other.
    """

    def cycle(pool: list[str], n: int) -> list[str]:
        out: list[str] = []
        while len(out) < n:
            out += [str(x) for x in g.permutation(pool)]
        return out[:n]

    inside = [n for n, r in RECIPES.items() if not r.outside]
    hidden = [n for n in inside if n in NEEDY]
    todo: list[tuple[str, tuple[str, ...]]] = [("null", ())] * counts["null"]
    todo += [("single", (n,)) for n in cycle(inside, counts["single"])]
    todo += [("withheld", (n,)) for n in cycle(hidden, counts["withheld"])]
    outside = [n for n, r in RECIPES.items() if r.outside]
    todo += [("outside", (n,)) for n in cycle(outside, counts["outside"])]
    mild = [n for n in inside if RECIPES[n].family not in ("gross", "noise")]
    while sum(k == "pair" for k, _ in todo) < counts["pair"]:
        a, b = (str(x) for x in g.choice(mild, 2, replace=False))
        ra, rb = RECIPES[a], RECIPES[b]
        if ra.family != rb.family and set(ra.vehicles) & set(rb.vehicles):
            todo.append(("pair", (a, b)))
    return [todo[int(i)] for i in g.permutation(len(todo))]


NEEDY = frozenset(
    {
        "motor_current_field",
        "current_derivative_field",
        "speed_field",
        "mag_bias_temperature",
        "mag_scale_temperature",
        "flexible_mount",
        "moving_iron",
        "switched_device",
        "rotor_field",
        "field_gradient",
        "field_anomaly",
        "altitude_field",
        "gyro_g_sensitivity",
        "vibration_rectification",
        "gyro_bias_temperature",
    }
)


def sentence(case: Case) -> str:
    """One plain sentence on what is concealed."""
    name = case.world.motion.vehicle.replace("_", " ")
    if not case.effects:
        return f"Nothing is concealed: {name} with the ordinary calibration and noise."
    text = f"{name}: " + ", and ".join(e.built.words for e in case.effects)
    return text + (
        f"; left out of the table: {', '.join(case.withheld)}." if case.withheld else "."
    )


def write_case(out: Path, ident: str, case: Case, with_spec: bool) -> dict[str, object]:
    """Write the table and perhaps the spec of one case; return its entry for truth.json."""
    style = {"lamp_on": "%.0f", "motor_rpm": "%.0f", "time_s": "%.6f", "temperature_c": "%.4f"}
    names = list(case.table)
    fmt = [style.get(n, "%.7f" if n.startswith(("mag_", "gyro_")) else "%.3f") for n in names]
    text = io.StringIO()
    text.write(",".join(names) + "\n")
    np.savetxt(text, np.stack(list(case.table.values()), axis=1), fmt=fmt, delimiter=",")
    packed = gzip.compress(text.getvalue().encode(), compresslevel=6, mtime=0)
    (out / f"{ident}.csv.gz").write_bytes(packed)
    w = case.world
    if with_spec:
        spec = {
            "sigma_mag_gauss": float(f"{w.sigma_mag:.3g}"),
            "sigma_gyro_rad_s": float(f"{w.sigma_gyro:.3g}"),
            "rate_hz": w.motion.rate_hz,
        }
        (out / f"{ident}.spec.json").write_text(json.dumps(spec, indent=1) + "\n")
    return {
        "id": ident,
        "kind": case.kind,
        "vehicle": w.motion.vehicle,
        "noise": case.noise,
        "effects": [e.truth(case.readings.time, w.ts) for e in case.effects],
        "withheld": case.withheld,
        "what": sentence(case),
        "site": case.site,
        "rows": len(case.table["time_s"]),
        "rate_hz": w.motion.rate_hz,
        "spec_given": with_spec,
        "calibration": {
            "soft_iron": w.soft_iron.round(8).tolist(),
            "hard_iron_gauss": w.hard_iron.round(8).tolist(),
            "gyro_bias_rad_s": w.gyro_bias.round(9).tolist(),
            "field_north_east_down_gauss": w.field_n.round(8).tolist(),
            "sigma_mag_gauss": w.sigma_mag,
            "sigma_gyro_rad_s": w.sigma_gyro,
        },
    }


def generate(out: Path, seed: int, counts: dict[str, int]) -> list[dict[str, object]]:
    """Write a whole trial and return the entries of its truth file."""
    out.mkdir(parents=True, exist_ok=True)
    g = np.random.default_rng([seed, 20260])
    todo = plan(g, counts)
    idents: set[str] = set()
    while len(idents) < len(todo):
        idents.add(f"wb{int(g.integers(16**6)):06x}")
    spec = g.permutation(len(todo)) < len(todo) // 2
    cases = []
    for k, (ident, (kind, names)) in enumerate(zip(sorted(idents), todo, strict=True)):
        case = draw_case(np.random.default_rng([seed, 1, k]), kind, names)
        cases.append(write_case(out, ident, case, bool(spec[k])))
        if sys.stderr.isatty():
            print(f"\r{k + 1} of {len(todo)}", end="", file=sys.stderr, flush=True)
    truth = {"generator": GENERATOR, "seed": seed, "cases": cases}
    (out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return cases


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    p = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    p.add_argument("out", type=Path, metavar="OUT", help="directory for the recordings")
    p.add_argument("--seed", type=int, default=1, help="same seed, same files")
    for kind, n in (("null", 5), ("single", 20), ("pair", 5), ("withheld", 5), ("outside", 5)):
        p.add_argument(f"--{kind}", type=int, default=n, help=f"recordings of this kind ({n})")
    a = p.parse_args(arguments)
    kinds = ("null", "single", "pair", "withheld", "outside")
    cases = generate(a.out, a.seed, {k: int(getattr(a, k)) for k in kinds})
    print(f"{len(cases)} recordings and truth.json in {a.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
