"""What one block of ten seconds says against a calibration, at the cost of a few small matrices.

A recording's filter (`innovation`) takes a loop over samples; beside a running estimator that is
too dear. Within a block the same whitened innovations come without one: the gyro carries every
reading into the frame of the block's first one, where the field stands still,

    y_k = R_k C (m_k - b) = h + noise,   R_k = R_k-1 Exp((w_k - w_b) dt)

and the noise is white (magnetometer) plus, across the field, a random walk (gyro). The inverse of
the Cholesky factor of its covariance gives the innovations of the filter that starts knowing
nothing of h; it is the same for every block. The field h of the block is projected out, so a block
says nothing while the vehicle stands, whatever is the matter with the field around it; so is a lag
between the two sensors, which nearly every stream has and no calibration knows of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Estimate
from ahrsd.samples import Array

ROWS = 128  # thinned samples in a block
LAG_S = 0.05  # 1-sigma of a lag between magnetometer and gyro
LEAST_ROWS = 64  # in a piece before a gap that is worth scoring
#: columns of a block: those of `Estimate.covariance`, then a drift of the field in the world
SOFT, IRON, GYRO, DRIFT = slice(0, 6), slice(6, 9), slice(9, 12), slice(12, 15)
_ENTRIES = np.triu_indices(3)
# 1-sigma that no calibration is believed to fall below: what moves by itself from minute to minute
_FLOOR = np.r_[np.full(6, 1e-3), np.full(3, 5e-4), np.full(3, 2e-4)]
_KEEP_ROOT = 1.2  # the whitening is kept while the ratio of the noises is within this factor


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceCalibration:
    """A calibration to test: theta (12,) and a root (12, 12) of its covariance, and the noises."""

    theta: Array
    root: Array
    correction: Array
    offset: Array
    gyro_bias_rad_s: Array
    noise_mag_gauss: float
    noise_gyro_rad_s: float

    @staticmethod
    def of(estimate: Estimate) -> ReferenceCalibration:
        """The estimate, in the order of its covariance."""
        A = estimate.soft_iron
        values, vectors = np.linalg.eigh(estimate.covariance + np.diag(_FLOOR**2))
        return ReferenceCalibration(
            np.r_[A[_ENTRIES], estimate.hard_iron_gauss, estimate.gyro_bias_rad_s],
            vectors * np.sqrt(np.maximum(values, 0.0)),
            np.asarray(np.linalg.inv(A), float),
            estimate.hard_iron_gauss,
            estimate.gyro_bias_rad_s,
            max(estimate.noise_mag_gauss, 1e-5),
            max(estimate.noise_gyro_rad_s, 1e-6),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """Rows of a block: means of `averaged` samples; angle_b_rad is the gyro's integral."""

    time_s: Array
    raw_b_gauss: Array
    angle_b_rad: Array
    averaged: int


@dataclass(frozen=True, slots=True, eq=False)
class ScoredBlock:
    """A scored block.

    information (15, 15), score (15,): of the columns, the block's own field and lag projected out
    residual (n, 3), lever (n, 3, 3): y - h and how it moves with the hard iron, carried frame
    """

    reference: ReferenceCalibration
    time_s: Array
    information: Array
    score: Array
    residual: Array
    lever: Array


class Scorer:
    """Scores blocks; keeps the whitening, which changes with the noise only."""

    def __init__(self) -> None:
        self._ratio = 0.0
        self._root: Array = np.eye(ROWS)

    def score(self, rows: Thinned, reference: ReferenceCalibration) -> ScoredBlock:
        """One block of at most ROWS rows against `reference`."""
        n = len(rows.time_s)
        dt_s = np.diff(rows.time_s, prepend=rows.time_s[:1])
        turn = np.diff(rows.angle_b_rad, axis=0, prepend=rows.angle_b_rad[:1])
        turn -= dt_s[:, None] * reference.gyro_bias_rad_s
        R = carried(so3.exp(turn))
        lever = R @ reference.correction
        y = (lever @ (rows.raw_b_gauss - reference.offset)[:, :, None])[:, :, 0]
        h = y.mean(axis=0)
        Z = np.zeros((n, 3, 20))
        Z[:, :, SOFT] = lever @ _soft(h @ R)
        Z[:, :, IRON] = lever
        Z[:, :, GYRO] = -so3.skew(h) @ np.cumsum(R * dt_s[:, None, None], axis=0)
        Z[:, [0, 1, 2], [12, 13, 14]] = np.linspace(-1.0, 1.0, n)[:, None]
        Z[:, [0, 1, 2], [15, 16, 17]] = 1.0
        Z[:, :, 18] = np.cross(h, (R @ _rate(turn, dt_s)[:, :, None])[:, :, 0])
        Z[:, :, 19] = y - h
        G = self._gram(Z, h, reference, float(dt_s[1:].mean()), rows.averaged)
        own = G[15:19, 15:19] + np.diag([0.0, 0.0, 0.0, LAG_S**-2])
        G = G - G[:, 15:19] @ np.linalg.solve(own, G[15:19])
        return ScoredBlock(reference, rows.time_s, G[:15, :15], G[:15, 19], y - h, lever)

    def _gram(
        self, Z: Array, h: Array, reference: ReferenceCalibration, dt_s: float, averaged: int
    ) -> Array:
        """Along the field nothing but the magnetometer's noise, across it the gyro's walk too."""
        size = float(np.linalg.norm(h))
        sigma = reference.noise_mag_gauss / np.sqrt(averaged)
        walk = size * reference.noise_gyro_rad_s * dt_s / np.sqrt(averaged)
        u = h / max(size, 1e-12)
        frame = np.column_stack([u, so3.tangent_basis(u[None])[0]])
        turned = frame.T @ Z
        across = self._whitening(walk / sigma)[: len(Z), : len(Z)] @ turned[:, 1:].reshape(
            len(Z), -1
        )
        rows = np.concatenate([turned[:, 0], across.reshape(-1, Z.shape[2])]) / sigma
        return np.asarray(rows.T @ rows)

    def _whitening(self, ratio: float) -> Array:
        """L^-1 of I + ratio^2 min(i, j) = L L^T; that of fewer rows is its upper left corner."""
        if not self._ratio / _KEEP_ROOT <= ratio <= self._ratio * _KEEP_ROOT:
            steps = np.arange(ROWS, dtype=np.float64)
            noise = np.eye(ROWS) + ratio**2 * np.minimum(steps[:, None], steps)
            self._root, self._ratio = np.linalg.inv(np.linalg.cholesky(noise)), ratio
        return self._root


def carried(turns: Array) -> Array:
    """R_k = turns_0 ... turns_k, (n, 3, 3), in log2(n) passes."""
    out, step = turns, 1
    while step < len(out):
        out = np.concatenate([out[:step], out[:-step] @ out[step:]])
        step *= 2
    return out


def _rate(turn: Array, dt_s: Array) -> Array:
    """Rate (n, 3) at the rows' instants, of the turns between them."""
    rate = turn[1:] / dt_s[1:, None]
    out = np.concatenate([rate[:1], rate])
    out[1:-1] = (rate[:-1] + rate[1:]) / 2
    return out


def _soft(field_b: Array) -> Array:
    """d(A h)/d entries of the symmetric A, (n, 3, 6)."""
    out = np.zeros((len(field_b), 3, 6))
    for column, (i, j) in enumerate(zip(*_ENTRIES, strict=True)):
        out[:, i, column] = field_b[:, j]
        out[:, j, column] = field_b[:, i]
    return out
