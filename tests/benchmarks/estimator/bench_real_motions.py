"""Simulated sensors along real motions: what `diagnose` says where nothing, or one effect, is in.

    python tests/benchmarks/estimator/bench_real_motions.py [--seeds N] [--effect ID=STRENGTH ...]

A hand, a car and a copter do not move like a generator.  The turns that a real gyro measured are
the truth here: attitude is their product, a constant field is seen through a calibration, white
noise of 0.6 mG and 1 mrad/s is added.  Per recording: the gyro's noise that its differences say and
the one that is worked with, over the truth, and what was said.  With --effect (strength in typical
sizes) that effect is in each.  It reads the recordings beside the project.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from mismatch_trials import covariates

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.offline.diagnose import load_track
from ahrsd.samples import Array

RECORDINGS = Path(__file__).parents[3] / ".." / "shared" / "recordings"
MOTIONS = (
    "arducopter/log171_MAG2_10hz",
    "broad/01_undisturbed_slow_rotation_A",
    "broad/21_undisturbed_fast_combined",
    "repoimu/TStick_Test11_Trial1",
    "vn100/circles_2022_rahul",
    "vn100/circles_2024_liu",
    "vn100/drive_2022_rahul",
    "vn100/hand_2023_thumatti",
    "vn100/punch_2024_satish",
    "vn100/walk_square_2024_sazgar",
    "vn100_distorters/clearIMU",
    "vn100_distorters/vn7Hard",
)
SIGMA_MAG, SIGMA_GYRO = 6e-4, 1e-3
MOST_HZ, MOST_ROWS = 50.0, 12_000
FIELD_N = (0.2, 0.0, 0.45)
SOFT_IRON = np.eye(3) + 0.05 * np.array([[1, 0.5, -0.3], [0.5, -1, 0.2], [-0.3, 0.2, 0.3]])
HARD_IRON, GYRO_BIAS = np.array([0.05, -0.08, 0.03]), np.array([2e-3, -1e-3, 1.5e-3])


def motion(name: str) -> tuple[Array, Array, Array, Array]:
    """time_s (N,), R_nb (N, 3, 3), mean rates (N, 3) of the steps, specific force (N, 3)."""
    track, _ = load_track(RECORDINGS / f"{name}.csv.gz")
    step_s = track.step_s
    every = max(1, round(1.0 / step_s / MOST_HZ))
    turns = Rotation.from_rotvec(np.nan_to_num(track.gyro_b_rad_s) * step_s).as_matrix()
    R_nb = np.empty_like(turns)
    attitude = np.eye(3)
    for k, turn in enumerate(turns):
        attitude = attitude @ turn
        R_nb[k] = attitude
    R_nb = R_nb[::every][:MOST_ROWS]
    between = Rotation.from_matrix(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:])
    rate = np.vstack([np.zeros(3), between.as_rotvec() / (every * step_s)])
    accel = track.accel_b_m_s2
    force = np.swapaxes(R_nb, 1, 2) @ [0.0, 0.0, -9.81]
    if accel is not None:
        force = np.nan_to_num(accel[::every][:MOST_ROWS])
    return np.arange(len(R_nb)) * every * step_s, R_nb, rate, force


def simulated(name: str, seed: int, effects: list[tuple[str, float]]) -> Track:
    """A sensor that moves like the recording."""
    rng = np.random.default_rng([seed, 5])
    time_s, R_nb, rate, force = motion(name)
    field_b = np.swapaxes(R_nb, 1, 2) @ Rotation.random(random_state=seed).apply(FIELD_N)
    dt_s = np.diff(time_s, prepend=np.nan)
    readings = Readings(
        time_s=time_s,
        dt_s=dt_s,
        mag_b_gauss=field_b @ SOFT_IRON.T + HARD_IRON,
        gyro_b_rad_s=rate + GYRO_BIAS,
        accel_b_m_s2=force,
        rate_b_rad_s=rate,
        field_b=field_b,
        R_nb=R_nb,
        soft_iron=SOFT_IRON,
        covariates=covariates(time_s, 1.0 / dt_s[1], rng),
    )
    for identifier, strength in effects:
        value, setting = EFFECTS[identifier].example(readings, strength)
        if "onset_s" in setting:
            setting = {**setting, "onset_s": float(time_s[-1] * rng.uniform(0.2, 0.8))}
        readings = EFFECTS[identifier].simulate(readings, value, setting)
    mag, gyro = rng.standard_normal((2, len(readings.time_s), 3))
    return Track(
        readings.time_s,
        readings.dt_s,
        readings.mag_b_gauss + SIGMA_MAG * mag,
        readings.gyro_b_rad_s + SIGMA_GYRO * gyro,
        readings.accel_b_m_s2,
        dict(readings.covariates),
        (slice(0, len(readings.time_s)),),
    )


def noise_over_truth(track: Track) -> tuple[float, float]:
    """The gyro's noise by its differences, and as it is worked with, both over the truth."""
    problem, start = build_problem(track, Spec())
    worked = start.sigma_gyro_rad_s * float(np.sqrt(problem.thin))
    return noise_of_differences(track)[1] / SIGMA_GYRO, worked / SIGMA_GYRO


def said(found: Diagnosis) -> str:
    names = [f"{one.effect} {one.confidence:.2f}" for one in found.findings]
    left = [f"unknown in {found.unexplained.where.frame}"] if found.unexplained.where else []
    return ", ".join(names + left) or "nothing"


def main() -> None:
    """Print a line per recording and seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--effect", action="append", default=[], metavar="ID=STRENGTH")
    arguments = parser.parse_args()
    effects = [(one.partition("=")[0], float(one.partition("=")[2])) for one in arguments.effect]
    quiet = count = 0
    for name in MOTIONS:
        for seed in range(1, arguments.seeds + 1):
            track = simulated(name, seed, effects)
            differenced, worked = noise_over_truth(track)
            found = diagnose(track)
            count, quiet = count + 1, quiet + (not found.mismatch)
            noise = f"gyro's noise {differenced:.2f} by differences, {worked:.2f} worked with"
            print(f"{name} seed {seed}: {noise}; {said(found)}", flush=True)
    print(f"{quiet} of {count} say nothing")


if __name__ == "__main__":
    main()
