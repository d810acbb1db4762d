"""[L] chapter 3: the norm-preserving methods on hand-held motion, over noise and over bias.

Field (228.55, -9.27, 430.60) mG, bias (50, 50, 50) mG, noise 5 mG, 226 readings; A is the identity.
[L]'s gyro stream, nearly 2,000 samples of a phone at 0.01 s, is not public: 1,993 samples of smooth
turning about all three axes, drawn by a number, stand for it. The noise of every reading is drawn
anew in each run while the motion stays. All that is returned is in mG.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from seed_figures.chapter5 import Each, Said

from ahrsd import so3
from ahrsd.baselines import MethodData, MethodError, MethodSettings, run
from ahrsd.baselines.attitude_independent import fnp_rows, linear_centre, minimise, tls_rows
from ahrsd.montecarlo.runs import batch_method
from ahrsd.samples import Array
from ahrsd.simulation import Experiment, Iron
from ahrsd.simulation.scenarios import generator, integrate, measured

Rows = Callable[[Array, Array, Array], tuple[Array, Array]]

FIELD_MG, BIAS_MG, NOISE_MG = np.array([228.55, -9.27, 430.60]), np.full(3, 50.0), 5.0
VECTORS, SAMPLES, STEP_S = 226, 1993, 0.01
#: from which a motion draws, for each axis: rad/s, Hz, and any phase
AMPLITUDE_RAD_S, FREQUENCY_HZ = (0.5, 2.5), (0.05, 0.4)
EVEN = -1  # the number of a motion whose attitudes are uniformly random
METHODS = ("tls", "np", "fnp", "np-uncertain-field")
COSTS: dict[str, Rows] = {"tls": tls_rows, "fnp": fnp_rows}
NOISES_MG = tuple(range(5, 55, 5))
BIASES_MG = (*range(5, 55, 5), *range(74, 338, 24))
GYRO_NOISE_RAD_S = 5e-3  # of what ours is given besides; [L]'s methods use no gyro
VARYING, FIELD_NOISE_MG = 0.2, 5.0  # of the field that is not constant: its share, and noise of |H|
FAR_STARTS, FAR_MG, ELSEWHERE_MG = 40, (200.0, 500.0, 1000.0, 2000.0), 25.0


def motion(number: int) -> tuple[Array, Array]:
    """Instants (226,) and attitudes R_nb (226, 3, 3), out of a stream of 1,993 samples."""
    rng = np.random.default_rng([number - EVEN, 7])
    time_s = STEP_S * np.arange(SAMPLES)
    rows = np.round(np.linspace(0, SAMPLES - 1, VECTORS)).astype(int)
    if number == EVEN:
        return time_s[rows], np.asarray(Rotation.random(VECTORS, rng).as_matrix())
    a, f = (rng.uniform(*limits, 3) for limits in (AMPLITUDE_RAD_S, FREQUENCY_HZ))
    rate = a * np.sin(2 * np.pi * (f * time_s[:, None] + rng.uniform(size=3)))
    q = integrate(rate, np.diff(time_s, prepend=np.nan))[rows]
    return time_s[rows], np.asarray(Rotation.from_quat(q, scalar_first=True).as_matrix())


class Stage:
    """A motion, and what a sensor reads on it."""

    def __init__(self, number: int = 0) -> None:
        self.time_s, self.R_nb = motion(number)
        self.field_b = np.einsum("nji,j->ni", self.R_nb, FIELD_MG / 1e3)
        self.norm_gauss = float(np.linalg.norm(FIELD_MG)) / 1e3
        self.norms = np.full(VECTORS, self.norm_gauss)

    def readings(self, seed: int, noise_mg: float, bias_mg: Array = BIAS_MG) -> Array:
        """(226, 3) in gauss; the same draw for every noise and every bias."""
        draw = generator(seed, 1).standard_normal((VECTORS, 3))
        return np.asarray(self.field_b + bias_mg / 1e3 + noise_mg / 1e3 * draw)

    def data(self, raw: Array, norms: float | Array) -> MethodData:
        """What a method is given."""
        dt_s = np.diff(self.time_s, prepend=np.nan)
        return MethodData(self.time_s, dt_s, raw, np.zeros_like(raw), field_norm_gauss=norms)

    def experiment(self, seed: int) -> Experiment:
        """The same readings with a gyroscope, for ours."""
        iron = Iron(np.eye(3), BIAS_MG / 1e3, np.zeros(3), FIELD_MG / 1e3, offset_behind_iron=True)
        turned = so3.log(np.swapaxes(self.R_nb[:-1], 1, 2) @ self.R_nb[1:])
        rate = np.vstack([np.full((1, 3), np.nan), turned / np.diff(self.time_s)[:, None]])
        noise = (NOISE_MG / 1e3, GYRO_NOISE_RAD_S)
        rng = (generator(seed, 1), generator(seed, 2))
        return measured(f"[L], seed {seed}", iron, self.R_nb, rate, self.time_s + 1.0, noise, rng)

    @property
    def unevenness(self) -> float:
        """Length of the mean direction of the field in the sensor: 0 where it comes from all."""
        return float(np.linalg.norm(self.field_b.mean(axis=0))) / self.norm_gauss


def summary(errors: Sequence[Array], runs: int) -> Said:
    """Mean, its standard error and mean square per axis of bias errors, and runs without answer."""
    found = np.array(errors).reshape(-1, 3)
    return {
        "runs": runs,
        "failed": runs - len(found),
        "mean": found.mean(axis=0).tolist(),
        "standard_error": (found.std(axis=0, ddof=1) / np.sqrt(len(found))).tolist(),
        "mean_square": np.mean(found**2, axis=0).tolist(),
    }


def constraint_errors(method: str, raw: Array, b: Array, norms: Array) -> Array:
    """|B_k - b| - |H_k| (226,) in mG, B_k the readings as the method corrects them.

    TLS moves a reading along B~_k - b to where its linearised constraint holds.
    """
    d = raw - b
    rho = np.linalg.norm(d, axis=1)
    if method == "tls":
        moved = d * (1 - (rho**2 - norms**2) / (2 * rho**2))[:, None]
    else:
        moved = d * (norms / rho)[:, None]
    return 1e3 * (np.linalg.norm((b + moved) - b, axis=1) - norms)


def mean_errors(runs: int, few: int) -> Said:
    """Bias errors, constraint errors and CPU of every method, and ours with a gyro."""
    stage, out = Stage(), {}
    settings = MethodSettings(sigma_mag_gauss=NOISE_MG / 1e3)
    for method in METHODS:
        count = few if method == "np-uncertain-field" else runs
        errors, seconds, constraint = [], 0.0, []
        for seed in range(count):
            raw = stage.readings(seed, NOISE_MG)
            found = run(method, stage.data(raw, stage.norms), settings, time.process_time)
            seconds += found.seconds
            if found.hard_iron_gauss is None:
                continue
            errors.append(1e3 * found.hard_iron_gauss - BIAS_MG)
            constraint.append(constraint_errors(method, raw, found.hard_iron_gauss, stage.norms))
        out[method] = summary(errors, count) | {
            "ms": 1e3 * seconds / count,
            "constraint": float(np.mean(np.abs(constraint))),
        }
    return out | {"magyc": ours(stage, few)}


def ours(stage: Stage, runs: int) -> Said:
    """The default method on the same readings and a gyro; it is not given |H| and finds A too."""
    errors, begun_s, failures = [], time.process_time(), []
    for seed in range(runs):
        try:
            answer = batch_method("magyc")(stage.experiment(seed))
        except MethodError as error:
            failures.append(str(error))
            continue
        assert answer.hard_iron_gauss is not None
        errors.append(1e3 * answer.hard_iron_gauss - BIAS_MG)
    ms = 1e3 * (time.process_time() - begun_s) / runs
    return summary(errors, runs) | {"ms": ms, "failures": failures}


def pair(stage: Stage, runs: int, noise_mg: float, bias_mg: Array = BIAS_MG) -> dict[str, Array]:
    """Bias errors (runs, 3) of TLS and Method 2 on the same readings."""
    out: dict[str, list[Array]] = {name: [] for name in COSTS}
    for seed in range(runs):
        raw = stage.readings(seed, noise_mg, bias_mg)
        for name in COSTS:
            out[name].append(1e3 * solved(name, raw, stage.norms)[0] - bias_mg)
    return {name: np.array(errors) for name, errors in out.items()}


def solved(name: str, raw: Array, norms: Array, start: Array | None = None) -> tuple[Array, float]:
    """b (3,) and the cost there, from the linear centre unless a start is given."""
    rows = COSTS[name]
    begin = linear_centre(raw) if start is None else start
    b = minimise(lambda x: rows(x, raw, norms), begin).hard_iron_gauss
    return b, float(np.sum(rows(b, raw, norms)[0] ** 2))


def ahead_percent(errors: dict[str, Array]) -> list[float]:
    """By how much Method 2's mean square is below that of TLS, per axis."""
    fnp, tls = (np.mean(errors[name] ** 2, axis=0) for name in ("fnp", "tls"))
    return (100 * (1 - fnp / tls)).tolist()


def over_noise(runs: int, motions: int) -> Said:
    """SSE over noise on one motion, and what 50 mG do on others and where directions are even."""
    stage, table = Stage(), []
    for noise in NOISES_MG:
        errors = pair(stage, runs, noise)
        sse = {name: np.sum(e**2, axis=0).tolist() for name, e in errors.items()}
        table.append({"noise": noise, "ahead_percent": ahead_percent(errors)} | sse)
    others = []
    for number in (EVEN, *range(motions)):
        there = Stage(number)
        errors = pair(there, runs, NOISES_MG[-1])
        fnp, tls = errors["fnp"], errors["tls"]
        others.append(
            {
                "motion": number,
                "unevenness": there.unevenness,
                "ahead_percent": ahead_percent(errors),
                "mean_tls": tls.mean(axis=0).tolist(),
                "mean_fnp": fnp.mean(axis=0).tolist(),
                "variance_ahead_percent": (100 * (1 - fnp.var(axis=0) / tls.var(axis=0))).tolist(),
            }
        )
    return {"runs": runs, "table": table, "motions": others}


def general_solver(name: str, raw: Array, norms: Array) -> Array:
    """What a general solver that is given the cost alone says, from b = 0."""
    rows = COSTS[name]
    found = minimize(
        lambda x: 0.5 * np.sum((rows(x, raw, norms)[0] / (NOISE_MG / 1e3)) ** 2),
        np.zeros(3),
        method="SLSQP",
    )
    return np.asarray(found.x)


def over_bias(runs: int) -> list[Said]:
    """SSE over bias: ours, a general solver from 0, and what other minima the costs have."""
    stage, out = Stage(), []
    for bias in BIASES_MG:
        bias_mg = np.full(3, float(bias))
        row: Said = {"bias": bias}
        for name in COSTS:
            errors, general = [], []
            for seed in range(runs):
                raw = stage.readings(seed, NOISE_MG, bias_mg)
                errors.append(1e3 * solved(name, raw, stage.norms)[0] - bias_mg)
                general.append(1e3 * general_solver(name, raw, stage.norms) - bias_mg)
            away = np.linalg.norm(np.array(general) - np.array(errors), axis=1) > 1.0
            row[name] = {
                "sse": float(np.sum(np.square(errors))),
                "sse_general": float(np.sum(np.square(general))),
                "general_elsewhere": int(np.count_nonzero(away)),
                **other_minima(stage, name, bias_mg),
            }
        out.append(row)
    return out


def other_minima(stage: Stage, name: str, bias_mg: Array) -> Said:
    """Where far starts end: how many elsewhere, and the lowest cost there over the best one."""
    raw, rng = stage.readings(0, NOISE_MG, bias_mg), np.random.default_rng(0)
    best, least = solved(name, raw, stage.norms)
    costs, lost = [], 0
    for k in range(FAR_STARTS):
        d = rng.standard_normal(3)
        start = best + FAR_MG[k % len(FAR_MG)] / 1e3 * d / np.linalg.norm(d)
        try:
            b, cost = solved(name, raw, stage.norms, start)
        except MethodError:
            lost += 1
            continue
        if 1e3 * np.linalg.norm(b - best) > ELSEWHERE_MG:
            costs.append(cost / least)
    return {"elsewhere": len(costs), "lost": lost, "lowest": min(costs) if costs else None}


def varying_field(runs: int) -> dict[str, Said]:
    """The field's size changes by 20 % on the way; who is given its measured size, who the mean."""
    stage = Stage()
    share = 1 + VARYING * np.sin(2 * np.pi * 3 * np.arange(VECTORS) / VECTORS)
    settings = MethodSettings(
        sigma_mag_gauss=NOISE_MG / 1e3, sigma_field_gauss=FIELD_NOISE_MG / 1e3
    )
    out = {}
    for told in ("constant", "measured"):
        for method in METHODS:
            errors = []
            for seed in range(runs):
                raw = stage.readings(seed, NOISE_MG) + stage.field_b * (share - 1)[:, None]
                noise = FIELD_NOISE_MG / 1e3 * generator(seed, 3).standard_normal(VECTORS)
                norms = stage.norms if told == "constant" else stage.norms * share + noise
                found = run(method, stage.data(raw, norms), settings)
                if found.hard_iron_gauss is not None:
                    errors.append(1e3 * found.hard_iron_gauss - BIAS_MG)
            out[f"{method}, {told}"] = summary(errors, runs)
    return out


def everything(runs: int, each: Each) -> Said:
    """All of [L]; with its own numbers of runs, 500 and 50, but in the short form."""
    full = runs > 1
    many, few, motions = (500, 50, 20) if full else (20, 2, 1)
    tasks = [
        ("noise", (many, motions)),
        ("bias", (50 if full else 1,)),
        ("mean_errors", (many, few)),
        ("varying", (few,)),
    ]
    found = each("[L]", part, tasks)
    return {name: value for (name, _), value in zip(tasks, found, strict=True)}


def part(name: str, arguments: tuple[int, ...]) -> Any:
    """One of the parts by its name: a function that another process can be given."""
    known = {
        "noise": over_noise, "bias": over_bias, "mean_errors": mean_errors, "varying": varying_field
    }  # fmt: skip
    return known[name](*arguments)
