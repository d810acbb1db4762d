"""Ellipsoid fit after Fang et al. 2011, with the quadric conditions of [R] appendix A.

    a x^2 + b y^2 + c z^2 + 2f yz + 2g xz + 2h xy + 2p x + 2q y + 2r z + d = 0,   a + b + c = -3

is linear once a = -3 - b - c is put in. That constraint rewards a large coefficient along an axis
in which the readings vary little; Fang's own, 4 a b - (2 h)^2 = 1, does not where that axis is z,
and can be chosen (`MethodSettings.ellipsoid_constraint`). With Q = [[a h g] [h b f] [g f c]] and
n = [p q r],

    hard iron = -Q^-1 n,    C^T C = Q up to scale and sign

The trace of -3 makes Q negative for an ellipsoid: its sign is fixed before the root is taken, so
the soft iron is the positive definite one. A quadric is a real ellipsoid if and only if (1) Q has
rank 3, (2) E = [[Q n] [n^T d]] has rank 4, (3) det E < 0, (4) the eigenvalues of Q have one sign.
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.soft_iron import answer
from ahrsd.estimator.chain import upper_triangle
from ahrsd.samples import Array

_RANK = 1e-9  # smallest eigenvalue over the largest that still counts as not zero
_MANY = "the readings fit many quadrics: turn about more axes"


def quadric(field: Array) -> tuple[Array, Array, float]:
    """Q (3, 3), n (3,) and d of readings (N, 3) near the origin, of size about 1; trace Q = -3."""
    x, y, z = field.T
    columns = [
        y * y - x * x, z * z - x * x, 2 * y * z, 2 * x * z, 2 * x * y,
        2 * x, 2 * y, 2 * z, np.ones(len(x)),
    ]  # fmt: skip
    found, _, rank, _ = np.linalg.lstsq(np.column_stack(columns), 3 * x * x, rcond=_RANK)
    if rank < 9:
        raise MethodError(_MANY)
    b, c, f, g, h, p, q, r, d = found
    Q = np.array([[-3 - b - c, h, g], [h, b, f], [g, f, c]])
    return Q, np.array([p, q, r]), float(d)


def fang_quadric(field: Array) -> tuple[Array, Array, float]:
    """The same with 4 a b - (2 h)^2 = 1: a 3x3 eigenvalue problem in (a, 2h, b), as Fang et al."""
    x, y, z = field.T
    ones = np.ones(len(x))
    # first the seven free coefficients, which follow from the three: R22^T R22 is left for these
    S = np.column_stack([z * z, y * z, x * z, x, y, z, ones, x * x, x * y, y * y])
    R = np.asarray(np.linalg.qr(S).R)
    scales = np.linalg.svd(R, compute_uv=False)  # the last one is 0 where the fit is perfect
    if scales[8] < _RANK * scales[0]:
        raise MethodError(_MANY)
    constraint = np.array([[0.0, 0.0, 2.0], [0.0, -1.0, 0.0], [2.0, 0.0, 0.0]])
    values, vectors = np.linalg.eig(np.linalg.solve(constraint, R[7:, 7:].T @ R[7:, 7:]))
    three = np.real(vectors[:, int(np.argmax(np.real(values)))])  # the only positive one
    c, f2, g2, p2, q2, r2, d = -np.linalg.solve(R[:7, :7], R[:7, 7:] @ three)
    a, h2, b = three
    Q = np.array([[a, h2 / 2, g2 / 2], [h2 / 2, b, f2 / 2], [g2 / 2, f2 / 2, c]])
    return Q, np.array([p2, q2, r2]) / 2, float(d)


def refuse_other_quadrics(Q: Array, n: Array, d: float) -> None:
    """MethodError naming the condition that fails, unless the quadric is a real ellipsoid."""
    E = np.block([[Q, n[:, None]], [n[None, :], np.array([[d]])]])
    small, large = np.linalg.eigvalsh(Q), np.linalg.eigvalsh(E)
    if np.min(np.abs(small)) < _RANK * np.max(np.abs(small)):
        raise MethodError("the quadric that fits is no ellipsoid: Q has rank below 3 (a cylinder)")
    if np.min(np.abs(large)) < _RANK * np.max(np.abs(large)):
        raise MethodError("the quadric that fits is no ellipsoid: E has rank below 4 (a cone)")
    if not (np.all(small > 0) or np.all(small < 0)):
        raise MethodError("the quadric that fits is no ellipsoid: Q's signs differ (a hyperboloid)")
    if np.linalg.det(E) >= 0:
        raise MethodError("the quadric that fits is no real ellipsoid: det E is not negative")


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A of unit volume and b.  MethodError where the readings fit no ellipsoid."""
    middle = data.raw_b_gauss.mean(axis=0)
    field = data.raw_b_gauss - middle
    size = float(np.sqrt(np.mean(field * field)))
    fit = fang_quadric if settings.ellipsoid_constraint == "fang" else quadric
    Q, n, d = fit(field / size)
    refuse_other_quadrics(Q, n, d)
    values, vectors = np.linalg.eigh(Q if Q[0, 0] > 0 else -Q)
    C = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    A, _ = answer(upper_triangle(C), np.zeros(3))
    return MethodFit(A, middle - size * np.linalg.solve(Q, n), None, 1)
