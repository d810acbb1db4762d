"""How often `diagnose` is right on small random recordings with known effects.

    python tests/benchmarks/diagnosis/bench_diagnose.py
        [--nulls N] [--singles N] [--pairs N] [--seed N]

Not the sealed proof: the effects are simulated by the library's own rows.  It shows in minutes
whether a change of the engine costs names or invents them.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose

NOISES = ("white", "red", "heavy", "walk", "bursts")
SCENARIOS = ("wam", "mam", "lam")
SINGLES = (
    "hard_iron_step", "hard_iron_drift", "soft_iron_step", "motor_current_field", "speed_field",
    "mag_bias_temperature", "mag_scale_temperature", "mag_cross_axis", "mag_nonlinearity",
    "hysteresis", "eddy_current", "viscous_magnetisation", "mag_time_lag", "flexible_mount",
    "moving_iron", "field_gradient", "field_anomaly", "geomagnetic_drift", "field_step",
    "altitude_field", "gyro_scale", "gyro_nonorthogonality", "mag_gyro_misalignment",
    "gyro_g_sensitivity", "vibration_rectification", "gyro_bias_temperature", "gyro_bias_step",
    "gyro_nonlinearity", "earth_rotation", "gyro_startup", "current_derivative_field",
    "ac_interference",
)  # fmt: skip
HIDDEN = (
    ("motor_current_field", ("motor_current_a",)),
    ("moving_iron", ("arm_angle_rad",)),
    ("field_gradient", ("position_north_m", "position_east_m", "position_down_m")),
    ("speed_field", ("speed_m_s",)),
    ("gyro_g_sensitivity", ("accel",)),
)


def run(trial: Trial):
    """The trial, its diagnosis and the processor's seconds."""
    one = made(trial)
    begin = time.process_time()
    answer = diagnose(one.track)
    return one, answer, time.process_time() - begin


def describe(answer) -> str:
    """One line: names with confidence, and what is left."""
    names = " ".join(
        f"{f.effect}:{f.confidence:.2f}({','.join(a.effect for a in f.alternatives[:2])})"
        for f in answer.findings
    )
    left = answer.unexplained
    return f"{names or '-'} | {left.where.frame if left.detected else 'nothing left'}"


def main() -> None:
    """Run, print every miss, then the rates."""
    parser = argparse.ArgumentParser()
    for name in ("nulls", "singles", "pairs", "hidden"):
        parser.add_argument(f"--{name}", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--only", default="")
    parser.add_argument("--strength", type=float, nargs=2, default=(0.3, 3.0))
    options = parser.parse_args()
    if not any((options.nulls, options.singles, options.pairs, options.hidden)):
        parser.error("ask for some: --nulls 10 --singles 14 --pairs 4 takes two minutes")
    rng = np.random.default_rng(options.seed)
    score: Counter[str] = Counter()
    seconds = []

    def trial(k: int, **more) -> Trial:
        return Trial(
            seed=options.seed + k, samples=16_000, rate_hz=40.0,
            scenario=SCENARIOS[k % 3], **more,
        )  # fmt: skip

    for k in range(options.nulls):
        noise = NOISES[k % len(NOISES)]
        _, answer, spent = run(trial(k, noise=noise))
        seconds.append(spent)
        score["nulls"] += 1
        score["nulls named"] += bool(answer.findings)
        score["nulls unknown"] += answer.unexplained.detected
        if answer.mismatch:
            print(f"null {k} {noise} {SCENARIOS[k % 3]}: {describe(answer)}", flush=True)
    singles = options.only.split(",") if options.only else SINGLES
    for k in range(options.singles):
        name = singles[k % len(singles)]
        strength = float(np.exp(rng.uniform(*np.log(options.strength))))
        _, answer, spent = run(trial(1000 + k, effects=((name, strength),)))
        seconds.append(spent)
        names = [f.effect for f in answer.findings]
        in_set = names and name in {names[0], *(a.effect for a in answer.findings[0].alternatives)}
        score["singles"] += 1
        score["detected"] += answer.mismatch
        score["first right"] += names[:1] == [name]
        score["exactly"] += names == [name]
        score["in the set"] += bool(in_set)
        score["called unknown"] += answer.unexplained.detected
        if names != [name] or answer.unexplained.detected:
            print(f"single {k} {name}={strength:.2f} {SCENARIOS[(1000 + k) % 3]}: "
                  f"{describe(answer)}", flush=True)  # fmt: skip
    for k in range(options.pairs):
        pair = rng.choice(SINGLES, 2, replace=False)
        strength = np.exp(rng.uniform(*np.log((0.7, 3.0)), 2))
        effects = tuple((str(n), float(s)) for n, s in zip(pair, strength, strict=True))
        _, answer, spent = run(trial(3000 + k, effects=effects))
        seconds.append(spent)
        names = sorted(f.effect for f in answer.findings)
        score["pairs"] += 1
        score["pairs exactly"] += names == sorted(map(str, pair))
        if names != sorted(map(str, pair)):
            print(f"pair {k} {effects}: {describe(answer)}", flush=True)
    for k in range(options.hidden):
        name, hidden = HIDDEN[k % len(HIDDEN)]
        strength = float(np.exp(rng.uniform(*np.log((0.5, 3.0)))))
        _, answer, spent = run(trial(5000 + k, effects=((name, strength),), hidden=hidden))
        seconds.append(spent)
        score["hidden"] += 1
        score["hidden unknown"] += answer.unexplained.detected and not answer.findings
        if answer.findings or not answer.unexplained.detected:
            print(f"hidden {k} {name}={strength:.2f}: {describe(answer)}", flush=True)
    print(dict(score), f"seconds: median {np.median(seconds):.2f}, largest {np.max(seconds):.2f}")


if __name__ == "__main__":
    main()
