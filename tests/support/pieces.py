"""Motions put together from pieces, as vehicles drive them, and what a sensor on board reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Estimate
from ahrsd.estimator.online import Estimator
from ahrsd.estimator.parameters import EstimatorParameters, Imperfections
from ahrsd.montecarlo import nuisances
from ahrsd.montecarlo.accuracy import nees
from ahrsd.montecarlo.cramer_rao import Trajectory, cramer_rao
from ahrsd.samples import Array, SampleBlock
from ahrsd.simulation.scenarios import mean_rate

SOFT_IRON = np.array([[0.95, -0.03, 0.02], [-0.03, 1.04, -0.015], [0.02, -0.015, 1.02]])
SOFT_IRON /= np.cbrt(np.linalg.det(SOFT_IRON))
HARD_IRON_GAUSS = np.array([0.12, -0.08, 0.06])
GYRO_BIAS_RAD_S = np.array([3.5e-3, -4.2e-3, 2.1e-3])
FIELD_N_GAUSS = 0.49 * np.array([np.cos(np.radians(60)), 0.0, np.sin(np.radians(60))])
MAG_GAUSS, GYRO_RAD_S = 1e-3, 7e-4
KINDS = ("circles", "roll", "pitch", "rest", "eight", "straight")
UPPER = np.triu_indices(3)
_SUBSTEPS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A recording and its truth: field (n, 3) in gauss and rate (n, 3) without noise.

    lag_s: by which the field is late against the gyro
    """

    block: SampleBlock
    field_b_gauss: Array
    rate_b_rad_s: Array
    lag_s: float

    def errors(self, estimate: Estimate) -> Array:
        """Estimate less truth (12,), in the order of its covariance."""
        soft_iron = (estimate.soft_iron - SOFT_IRON)[UPPER]
        hard_iron = estimate.hard_iron_gauss - HARD_IRON_GAUSS
        return np.r_[soft_iron, hard_iron, estimate.gyro_bias_rad_s - GYRO_BIAS_RAD_S]


def angles(pieces: Sequence[tuple[str, float]], rate_hz: float, rng: np.random.Generator) -> Array:
    """Roll, pitch, yaw (n, 3) in rad of pieces (kind, seconds), one after the other."""
    parts = []
    yaw = float(rng.uniform(0, 2 * np.pi))
    for kind, seconds in pieces:
        time_s = np.arange(1, round(seconds * rate_hz) + 1) / rate_hz
        part = _piece(kind, time_s, seconds, rng)
        part[:, 2] += yaw
        yaw = float(part[-1, 2])
        parts.append(part)
    return np.vstack([parts[0][:1], *parts])


def _piece(kind: str, t: Array, seconds: float, rng: np.random.Generator) -> Array:
    ramp = np.clip(np.minimum(t, seconds - t) / 1.5, 0.0, 1.0)
    ramp = ramp * ramp * (3 - 2 * ramp)  # level at both ends
    out = np.zeros((len(t), 3))
    if kind == "rest":
        return out
    first, second = rng.uniform(0, 2 * np.pi, 2)
    out[:, 0] = np.radians(1.2) * np.sin(2 * np.pi * t / 2.3 + first)
    out[:, 1] = np.radians(1.0) * np.sin(2 * np.pi * t / 3.1 + second)
    if kind == "circles":
        out[:, 2] = rng.choice([-1, 1]) * rng.uniform(0.2, 0.45) * t
        out[:, 2] += 0.2 * ramp * np.sin(2 * np.pi * t / 29)
    elif kind == "roll":
        out[:, 0] = np.radians(25) * np.sin(2 * np.pi * t / rng.uniform(6, 9))
        out[:, 2] = rng.uniform(-0.1, 0.1) * t
    elif kind == "pitch":
        out[:, 1] = np.radians(20) * np.sin(2 * np.pi * t / rng.uniform(6, 9))
        out[:, 2] = rng.uniform(-0.1, 0.1) * t
    elif kind == "eight":
        turning = np.clip(8 * t / seconds % 1.0 * 2.5 - 1.5, 0.0, 1.0)  # the last 40 % of each
        turning = turning * turning * (3 - 2 * turning)
        out[:, 2] = np.radians(45) * (np.floor(8 * t / seconds) + turning)
        out[:, :2] = 0.0
    elif kind == "straight":
        out[:, 2] = np.radians(3) * ramp * np.sin(2 * np.pi * t / 11)
    else:
        raise ValueError(f"no such piece of a motion: {kind}")
    out[:, :2] *= ramp[:, None]
    return out


def drive(
    pieces: Sequence[tuple[str, float]],
    seed: int,
    *,
    rate_hz: float = 40.0,
    lag_s: float = 0.0,
    hold: int = 1,
) -> Drive:
    """A recording of these pieces; the magnetometer has a new reading every `hold` samples."""
    rng = np.random.default_rng(seed)
    shift = round(lag_s * rate_hz * _SUBSTEPS)
    roll, pitch, heading = angles(pieces, rate_hz * _SUBSTEPS, rng).T
    fine = so3.from_yaw_pitch_roll(heading, pitch, roll)
    count = (len(fine) - 1) // _SUBSTEPS
    fine = fine[: count * _SUBSTEPS + 1]
    now = np.arange(count + 1) * _SUBSTEPS
    late = fine[np.clip(now - shift, 0, len(fine) - 1)]
    rate = mean_rate(fine, _SUBSTEPS, 1 / rate_hz)
    rate[0] = rate[1]
    field = np.einsum("nji,j->ni", late, FIELD_N_GAUSS)
    read = field @ SOFT_IRON + HARD_IRON_GAUSS + MAG_GAUSS * rng.normal(size=field.shape)
    time_s = np.arange(count + 1) / rate_hz
    block = SampleBlock(
        time_s=time_s,
        dt_s=np.r_[np.nan, np.full(count, 1 / rate_hz)],
        host_s=time_s,
        raw_b_gauss=read[np.arange(count + 1) // hold * hold],
        gyro_b_rad_s=rate + GYRO_BIAS_RAD_S + GYRO_RAD_S * rng.normal(size=rate.shape),
        accel_b_m_s2=np.einsum("nji,j->ni", fine[now], np.array([0.0, 0.0, -9.81])),
        gap_before=True,
    )
    return Drive(block, field, rate, shift / (rate_hz * _SUBSTEPS))


#: the pieces' instrument has no imperfections, and the bound knows of none
IDEAL = EstimatorParameters(imperfections=())


def answer(
    made: Drive, *, at_once: int = 1, parameters: EstimatorParameters = IDEAL
) -> Estimate | None:
    """Of the estimator over the whole recording."""
    estimator = Estimator(parameters, at_once=at_once)
    estimator.add(made.block)
    return estimator.finish()


def bound_sigmas(made: Drive, hold: int = 1, kind: Imperfections | None = None) -> Array:
    """Smallest possible sigmas (12,) of what the estimator believes and the whole data say.

    hold: rows for which a reading is held; it counts once, and the gyro's steps between add up.
    kind: of an instrument that is not perfect; None: perfect, but late where the field is.
    """
    p = EstimatorParameters()
    M = SOFT_IRON * float(np.linalg.norm(FIELD_N_GAUSS))
    size = float(np.cbrt(np.linalg.det(M)))
    belief = np.diag(
        np.r_[np.full(6, p.prior_soft_iron * size), [p.prior_hard_iron_gauss] * 3] ** 2
    )
    round_iron = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]) * size
    belief[:6, :6] += 0.5**2 * np.outer(round_iron, round_iron)  # the scale is free
    trajectory = Trajectory(
        made.field_b_gauss[::hold],
        _means(made.rate_b_rad_s, hold),
        made.block.dt_s[::hold] * hold,
    )
    information = np.zeros((12, 12))
    information[:9, :9] = np.linalg.inv(belief)
    information[9:, 9:] = np.eye(3) / p.prior_gyro_bias_rad_s**2
    extra = None
    if kind is not None:
        extra = nuisances.instrument(trajectory, SOFT_IRON, kind)
    elif made.lag_s:
        extra = nuisances.lag(trajectory, SOFT_IRON, 0.05)
    found = cramer_rao(
        trajectory, SOFT_IRON, MAG_GAUSS, GYRO_RAD_S / np.sqrt(hold),
        believed=information, nuisances=extra,
    )  # fmt: skip
    return np.sqrt(np.diag(found.covariance))


def _means(rate: Array, hold: int) -> Array:
    """Mean rate over the `hold` rows that end at each that is kept."""
    whole = rate[1 : (len(rate) - 1) // hold * hold + 1]
    return np.vstack([rate[:1], whole.reshape(-1, hold, 3).mean(axis=1)])


def ratios(made: Drive, estimate: Estimate, hold: int = 1) -> Array:
    """Announced sigma over the bound (12,): soft iron, hard iron, gyro bias."""
    return np.sqrt(np.diag(estimate.covariance)) / bound_sigmas(made, hold)


def nees_of(made: Drive, estimate: Estimate) -> float:
    """Squared error over the announced covariance per degree of freedom."""
    return nees(made.errors(estimate), estimate.covariance, SOFT_IRON)
