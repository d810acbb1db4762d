"""One epoch: n field directions linked by the gyroscope, eliminated onto what the epochs share.

Model of an epoch (frame b, sensor; u_k unit vectors, M = A |h|):

    field    m_k = M u_k + b + noise,                   noise_mag per axis
    motion   u_k = Exp(-(phi_k - w_b dt_k)) u_(k-1) + tangential noise of noise_gyro * dt_k

The field's magnitude never changes along the chain, because u_k stays on the sphere: the norm
information of TWOSTEP and the rotation information of MAGYC are one likelihood, and nothing is
differentiated. Gyro noise about u_k itself moves nothing and needs no state. A row may stand for
several steps (`Averaging`): then m_k = M P_k u_k + b, with less noise.

Each u_k moves in its tangent plane, u_k + T_k d_k. Gauss-Newton then gives a block tridiagonal
system in the d_k, bordered by what is shared: x = [M (6), b (3)], the epoch's gyro bias (3) and the
two border directions (2 + 2), which the neighbouring epochs see too. The interior is eliminated by
a banded Cholesky factorisation; what remains is one quadratic in 16 numbers, whatever n is.

Residuals and their derivatives (checked numerically in tests/estimator/test_chain.py):

    r_k = (m_k - M u_k - b) / s_m        d/dd_k = -M T_k / s_m,  d/db = -I / s_m
    q_k = T_k^T R_k u_(k-1) / (s_g dt_k) d/dd_k = -I, d/dd_(k-1) = T_k^T R_k T_(k-1),
                                         d/dw_b = -T_k^T [R_k u_(k-1)]x Jl dt_k  (all / (s_g dt_k))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.estimator.elimination import Interior, eliminated
from ahrsd.estimator.rows import (
    Averaging,
    Chain,
    EpochData,
    FieldPart,
    MotionPart,
    Noise,
    Rows,
    interior,
    parts,
    robust_weights,
    symmetric,
    symmetric_columns,
    upper_triangle,
)
from ahrsd.samples import Array

__all__ = [
    "Averaging",
    "Chain",
    "EpochData",
    "Noise",
    "Quadratic",
    "Rows",
    "interior",
    "linearise",
    "linearise_all",
    "move",
    "parts",
    "robust_weights",
    "squares",
    "start_directions",
    "symmetric",
    "symmetric_columns",
    "upper_triangle",
]

FIRST = slice(12, 14)
LAST = slice(14, 16)
WIDTH = 16
_SPOKEN = np.r_[0:12, 16]  # of the 17 numbers, gradient last: those that all directions couple to
_FIELD = np.ix_(np.r_[0:9, 16], np.r_[0:9, 16])
_MOTION = np.ix_(np.r_[9:12, 16], np.r_[9:12, 16])


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """An epoch's cost around its linearisation point: c + g^T z + z^T H z / 2, z of WIDTH numbers.

    `cost` and the sums of squares of the whitened residuals are those with the interior directions
    at their best for z = 0; tangents (3, 2, n); weights (n,) those of the field residuals; seen
    (2, n) the squared sizes of the columns of M P_k T_k.
    """

    H: Array
    g: Array
    cost: float
    interior: Interior
    tangents: Array
    weights: Array
    seen: Array
    sum_mag: float
    sum_gyro: float
    count_mag: float
    count_gyro: float


def start_directions(M: Array, b: Array, field: Array) -> Array:
    """Directions from the field alone, normalised M^-1 (m - b), (n, 3)."""
    v = np.linalg.solve(M, (field - b).T).T
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12))


def linearise(
    data: EpochData,
    u: Array,
    x: Array,
    bias: Array,
    noise: Noise,
    *,
    weights: Array | None = None,
) -> Quadratic:
    """Quadratic of one epoch at directions u (n, 3), x = [M6, b], bias (3,) in rad/s."""
    return linearise_all([Chain(data, u, bias, noise, weights)], x)[0]


def linearise_all(
    chains: Sequence[Chain], x: Array, *, outlier_sigma: float | None = None
) -> list[Quadratic]:
    """Quadratics of several epochs at the same x = [M6, b], as chains in one row.

    With `outlier_sigma` the weights are those of the residuals here (`robust_weights`).
    LinAlgError where the directions of one are not determined.
    """
    rows = Rows.of(chains)
    field, motion = parts(rows, x, outlier_sigma)
    blocks = interior(field, motion)
    inside = eliminated(*blocks, rows.first, rows.last)
    ends = list(zip(rows.first.tolist(), rows.last.tolist(), strict=True))
    insides = [inside.part(a, b) for a, b in ends]
    sums = _sums(field, motion, blocks, rows)
    sums -= np.array([part.half.T @ part.half for part in insides])
    best = field.r + np.einsum("rin,ni->rn", field.own, inside.step(np.zeros(WIDTH)))
    sum_mag = np.add.reduceat(np.sum(best**2, axis=0), rows.first)
    count_mag = 3.0 * np.add.reduceat(field.weights * rows.measured, rows.first)
    count_gyro = 2.0 * np.add.reduceat((rows.stiff > 0.0).astype(np.float64), rows.first)
    return [
        Quadratic(
            H=sums[k, :WIDTH, :WIDTH].copy(),  # a view would keep all epochs' arrays alive
            g=sums[k, :WIDTH, WIDTH].copy(),
            cost=0.5 * float(sums[k, WIDTH, WIDTH]),
            interior=insides[k],
            tangents=field.tangents[:, :, a : b + 1].copy(),
            weights=field.weights[a : b + 1].copy(),
            seen=field.seen[:, a : b + 1].copy(),
            sum_mag=float(sum_mag[k]),
            sum_gyro=max(float(sums[k, WIDTH, WIDTH] - sum_mag[k]), 0.0),
            count_mag=float(count_mag[k]),
            count_gyro=float(count_gyro[k]),
        )
        for k, (a, b) in enumerate(ends)
    ]


def _sums(
    field: FieldPart, motion: MotionPart, blocks: tuple[Array, Array, Array], rows: Rows
) -> Array:
    """Each epoch's Hessian, gradient and square sum (E, 17, 17), all directions as they are."""
    diag, _, border = blocks
    sums = np.zeros((len(rows.first), WIDTH + 1, WIDTH + 1))
    for k, (a, b) in enumerate(zip(rows.first, rows.last + 1, strict=True)):
        sums[k][_FIELD] = squares(field.J[:, 2:, a:b])
        sums[k][_MOTION] += squares(motion.J[:, 2:, a:b])
    for where, ends in ((FIRST, rows.first), (LAST, rows.last)):
        sums[:, where, where] = diag[:, :, ends].transpose(2, 0, 1)
        sums[:, where, _SPOKEN] = border[:, :, ends].transpose(2, 0, 1)
        sums[:, _SPOKEN, where] = border[:, :, ends].transpose(2, 1, 0)
    return sums


def squares(J: Array) -> Array:
    """Sum of J_rn J_rn^T over residuals r and rows n, (i, i), of J (r, i, n)."""
    return np.asarray((J @ J.transpose(0, 2, 1)).sum(axis=0))


def move(u: Array, quadratic: Quadratic, z: Array) -> Array:
    """Directions after the shared quantities and borders moved by z (WIDTH,): back-substitution."""
    step = np.empty((len(u), 2))
    step[0], step[-1] = z[FIRST], z[LAST]
    step[1:-1] = quadratic.interior.step(z)
    moved = u + np.einsum("cin,ni->nc", quadratic.tangents, step)
    return np.asarray(moved / np.sqrt(np.sum(moved * moved, axis=1, keepdims=True)))
