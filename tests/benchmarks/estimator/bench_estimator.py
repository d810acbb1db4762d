"""Accuracy of the streaming estimator beside the Cramer-Rao bound, over many runs.

    python tests/benchmarks/estimator/bench_estimator.py --runs 100
    python tests/benchmarks/estimator/bench_estimator.py --runs 20 --sets lam --motions slow

The experiment is the thesis' (10,000 samples at 25 Hz, 1 mG, 5 mrad/s; WAM, MAM, LAM), in its slow
motion and in that of a vehicle. The bound is computed here from the truth alone, by a recursion
that shares no code with the estimator: the information on [d_k (2), M (6), b (3), w_b (3)] is
carried from sample to sample and each direction is marginalised as it passes.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.estimator.online import Estimator
from ahrsd.samples import Array, SampleBlock

SOFT_IRON = np.array([[1.10, 0.10, 0.04], [0.10, 0.88, 0.02], [0.04, 0.02, 1.22]])
PSEUDO_HARD_IRON_GAUSS = np.array([0.020, 0.120, 0.090])
GYRO_BIAS_RAD_S = np.array([4e-3, -5e-3, 2e-3])
FIELD_N_GAUSS = np.array([0.227, 0.052, 0.412])
HALF_RANGE_DEG = {"wam": (180, 180, 180), "mam": (5, 45, 180), "lam": (5, 15, 90)}
UPPER = np.triu_indices(3)
_PARTS = 8  # of a step, between which the rotation is exact


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A simulated stream and its truth; `field_b_gauss` (n, 3) and `rate_b_rad_s` (n, 3) clean."""

    block: SampleBlock
    soft_iron: Array
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array
    field_b_gauss: Array
    rate_b_rad_s: Array

    def errors(self, estimate: Estimate) -> Array:
        """Estimate less truth (12,), in the order of its covariance."""
        return np.concatenate(
            [
                (estimate.soft_iron - self.soft_iron)[UPPER],
                estimate.hard_iron_gauss - self.hard_iron_gauss,
                estimate.gyro_bias_rad_s - self.gyro_bias_rad_s,
            ]
        )


def rotation(angles: Array) -> Array:
    """R_nb (n, 3, 3) of roll, pitch and yaw (n, 3)."""
    (cr, cp, cy), (sr, sp, cs) = np.cos(angles).T, np.sin(angles).T
    sy = cs
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def angles(kind: str, motion: str, time_s: Array, rng: np.random.Generator) -> Array:
    """Roll, pitch, yaw (n, 3) in rad of a set ("wam", "mam", "lam", "planar") in a motion."""
    if kind == "planar":
        zero = np.zeros_like(time_s)  # a minute at rest, which tells the gyro's bias, then circles
        return np.stack([zero + 0.01, zero - 0.02, 0.25 * np.maximum(time_s - 60.0, 0.0)], axis=1)
    half = np.radians(HALF_RANGE_DEG[kind])
    if motion == "slow":
        frequency = np.array([rng.uniform(5, 10), rng.uniform(5, 8), rng.uniform(4, 8)]) * 1e-3
    else:
        peak = np.array([rng.uniform(0.05, 0.08), rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.4)])
        frequency = peak / (2 * np.pi * half)
    phase = rng.uniform(0, 2 * np.pi, 3)
    return np.asarray(half * np.sin(2 * np.pi * frequency * time_s[:, None] + phase))


def simulate(
    kind: str,
    motion: str,
    seed: int,
    *,
    samples: int = 10_000,
    rate_hz: float = 25.0,
    mag_gauss: float = 1e-3,
    gyro_rad_s: float = 5e-3,
) -> Run:
    """One run of the experiment."""
    rng = np.random.default_rng(seed)
    fine = np.arange(samples * _PARTS + 1) / (rate_hz * _PARTS)
    R = rotation(angles(kind, motion, fine, rng))[::_PARTS]
    turn = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    rate = _rotation_vectors(turn) * rate_hz
    field = np.einsum("nji,j->ni", R[1:], FIELD_N_GAUSS)
    A = SOFT_IRON / np.cbrt(np.linalg.det(SOFT_IRON))
    b = SOFT_IRON @ PSEUDO_HARD_IRON_GAUSS
    time_s = fine[::_PARTS][1:]
    dt = np.full(samples, 1 / rate_hz)
    dt[0] = np.nan
    block = SampleBlock(
        time_s=time_s,
        dt_s=dt,
        host_s=time_s,
        raw_b_gauss=field @ A + b + rng.normal(size=(samples, 3)) * mag_gauss,
        gyro_b_rad_s=rate + GYRO_BIAS_RAD_S + rng.normal(size=(samples, 3)) * gyro_rad_s,
        accel_b_m_s2=np.einsum("nji,j->ni", R[1:], np.array([0.0, 0.0, -9.8])),
        gap_before=True,
    )
    return Run(block, A, b, GYRO_BIAS_RAD_S, field, rate)


def _rotation_vectors(R: Array) -> Array:
    """Of small rotations (n, 3, 3)."""
    v = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1) / 2
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    return v * np.where(sine > 1e-12, np.arcsin(sine) / np.maximum(sine, 1e-12), 1.0)


def feed(estimator: Estimator, block: SampleBlock, size: int = 50) -> list[tuple[float, Estimate]]:
    """Hand over a block in pieces; the estimates on the way, each with its time."""
    history = []
    for start in range(0, len(block), size):
        part = piece(block, start, start + size)
        if estimator.add(part):
            estimate = estimator.estimate()
            if estimate is not None:
                history.append((float(part.time_s[-1]), estimate))
    return history


def piece(block: SampleBlock, start: int, stop: int) -> SampleBlock:
    """Rows start..stop as a block that follows the one before."""
    rows = slice(start, stop)
    return replace(
        block,
        time_s=block.time_s[rows],
        dt_s=block.dt_s[rows],
        host_s=block.host_s[rows],
        raw_b_gauss=block.raw_b_gauss[rows],
        gyro_b_rad_s=block.gyro_b_rad_s[rows],
        accel_b_m_s2=block.accel_b_m_s2[rows],
        gap_before=block.gap_before and start == 0,
    )


# -- the bound ---------------------------------------------------------------------------------


def bound(run: Run, mag_gauss: float = 1e-3, gyro_rad_s: float = 5e-3) -> Array:
    """Covariance (12, 12) of [A (6), b (3), w_b (3)] that no unbiased estimator beats."""
    size = float(np.linalg.norm(FIELD_N_GAUSS))
    M = run.soft_iron * size
    u = run.field_b_gauss / size
    T = _tangents(u)
    dt = float(np.nanmedian(run.block.dt_s))
    J = np.zeros((len(u), 3, 14))
    J[:, :, :2] = M @ T
    for j, (r, c) in enumerate(zip(*UPPER, strict=True)):
        E = np.zeros((3, 3))
        E[r, c] = E[c, r] = 1.0
        J[:, :, 2 + j] = u @ E
    J[:, :, 8:11] = np.eye(3)
    measured = np.swapaxes(J, 1, 2) @ J / mag_gauss**2
    # d_k = F d_(k-1) + G w_b + noise of gyro dt: the tangential motion, all to first order
    turn = _exponential(-run.rate_b_rad_s[1:] * dt)
    F = np.swapaxes(T[1:], 1, 2) @ turn @ T[:-1]
    G = -np.swapaxes(T[1:], 1, 2) @ _cross(u[1:]) * dt
    W = 1.0 / (gyro_rad_s * dt) ** 2
    information = measured[0]
    for k in range(1, len(u)):
        information = _carried(information, F[k - 1], G[k - 1], W) + measured[k]
    theta = information[2:, 2:] - information[2:, :2] @ np.linalg.solve(
        information[:2, :2], information[:2, 2:]
    )
    K = np.eye(12)
    K[:6, :6] = _unit_volume(M)
    return np.asarray(K @ np.linalg.inv(theta) @ K.T)


def _carried(information: Array, F: Array, G: Array, W: float) -> Array:
    """Information on [d_(k-1), theta] to that on [d_k, theta]."""
    joint = np.zeros((16, 16))  # d_(k-1), d_k, theta
    old = np.r_[0:2, 4:16]
    joint[np.ix_(old, old)] = information
    J = np.zeros((2, 16))
    J[:, :2], J[:, 2:4], J[:, 13:] = -F, np.eye(2), -G
    joint += W * J.T @ J
    return np.asarray(joint[2:, 2:] - joint[2:, :2] @ np.linalg.solve(joint[:2, :2], joint[:2, 2:]))


def _cross(v: Array) -> Array:
    out = np.zeros((len(v), 3, 3))
    for i in range(3):
        out[:, :, i] = np.cross(v, np.eye(3)[i])
    return out


def _exponential(v: Array) -> Array:
    t = np.linalg.norm(v, axis=1)[:, None, None]
    t = np.maximum(t, 1e-12)
    K = _cross(v) / t
    return np.asarray(np.eye(3) + np.sin(t) * K + (1 - np.cos(t)) * K @ K)


def _tangents(u: Array) -> Array:
    """By the singular value decomposition: any basis will do."""
    _, _, rows = np.linalg.svd(u[:, None, :])
    return np.swapaxes(rows[:, 1:], 1, 2)


def _unit_volume(M: Array) -> Array:
    """d[M / det(M)^(1/3)] / dM, both as 6 numbers, by central differences."""
    out = np.empty((6, 6))
    for j, (r, c) in enumerate(zip(*UPPER, strict=True)):
        E = np.zeros((3, 3))
        E[r, c] = E[c, r] = 1e-6
        sides = [(M + s * E) / np.cbrt(np.linalg.det(M + s * E)) for s in (1, -1)]
        out[:, j] = (sides[0] - sides[1])[UPPER] / 2e-6
    return out


# -- the table ---------------------------------------------------------------------------------


def nees(errors: Array, covariance: Array) -> float:
    """Normalised error squared per degree of freedom; det A = 1 takes one of the twelve."""
    scale = 1 / np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    z = vectors.T @ (errors * scale)
    good = values > 1e-9
    return float(np.mean(z[good] ** 2 / values[good]))


def sizes(variance: Array) -> Array:
    """Expected squares of |db|, |dA| (Frobenius) and |dw_b| from variances or squares (12,)."""
    twice = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
    return np.array([variance[6:9].sum(), twice @ variance[:6], variance[9:].sum()])


def row(kind: str, motion: str, runs: int) -> str:
    """One line of the table."""
    squares, limits, scores, early = [], [], [], []
    converged = 0
    started = time.process_time()
    spent = 0.0
    for seed in range(runs):
        run = simulate(kind, motion, seed)
        started = time.process_time()
        estimator = Estimator()
        history = feed(estimator, run.block)
        estimate = estimator.finish()
        spent += time.process_time() - started
        if estimate is None:
            continue
        converged += estimate.converged
        error = run.errors(estimate)
        squares.append(sizes(error**2))
        limits.append(sizes(np.diag(bound(run))))
        scores.append(nees(error, estimate.covariance))
        early.append([_error_at(run, history, t) for t in (50, 100, 200)])
    found, limit = np.sqrt(np.mean(squares, axis=0)), np.sqrt(np.mean(limits, axis=0))
    late = np.sqrt(np.mean(np.square(early), axis=0))
    return (
        f"{motion:5}{kind:4} {converged:4d}/{runs:<4d} {np.mean(scores):5.2f}  "
        f"{found[0] * 1e3:8.3f} {limit[0] * 1e3:8.3f} {found[0] / limit[0]:5.2f}  "
        f"{found[1]:8.5f} {limit[1]:8.5f} {found[1] / limit[1]:5.2f}  "
        f"{found[2] * 1e3:6.3f} {limit[2] * 1e3:6.3f} {found[2] / limit[2]:5.2f}  "
        f"{late[0]:7.2f} {late[1]:7.2f} {late[2]:6.2f}  {spent / runs:5.2f}"
    )


def _error_at(run: Run, history: list[tuple[float, Estimate]], time_s: float) -> float:
    """Hard-iron error in mG of the last estimate by then, 1000 if there was none."""
    known = [estimate for t, estimate in history if t <= time_s]
    if not known:
        return 1000.0
    return float(np.linalg.norm(known[-1].hard_iron_gauss - run.hard_iron_gauss) * 1e3)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--runs", type=int, default=10, help="runs per set and motion")
    parser.add_argument("--sets", default="wam,mam,lam")
    parser.add_argument("--motions", default="slow,rov")
    chosen = parser.parse_args()
    sys.stdout.write(
        "RMSE, bound and their ratio; hard iron in mG, soft iron Frobenius, gyro bias in mrad/s\n"
        "motion set conv.     NEES  hard iron                soft iron                gyro bias"
        "            hard iron at 50, 100, 200 s   CPU s/run\n"
    )
    for motion in chosen.motions.split(","):
        for kind in chosen.sets.split(","):
            sys.stdout.write(row(kind, motion, chosen.runs) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
