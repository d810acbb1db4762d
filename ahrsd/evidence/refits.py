"""Two independent fits that check an estimate: one from the gyro, one from the field's size.

Gyro fit (for halves of the data). With R_0k of `segments`, the corrected field of a segment must
not move: R_0k (C m_k - c) = f_s, c = C b. Linear in (C, c); f_s is removed by centring. C = 0 would
do, so the trace of C is held: C = C0 + sum x_i E_i over the five traceless symmetric E_i. Noise in
the regressor m pulls C towards 0 with the weight n sigma^2; its pull on the right-hand side is
taken off, which leaves a pull towards C0: harmless where motion is rich, wanted where it is not.
Likewise the gyro's drift: R_0k wrong by milliradians looks like motion, and is weighed down.

Size fit (second opinion): |C m - c| = F over symmetric C and c by Levenberg and Marquardt, in
distances from the ellipsoid: no gyro, no gravity, and none of the quadric's troubles with signs and
shapes (Fang et al. 2011 fit the quadric; its answer need not be an ellipsoid).

Both hold what the motion does not determine at the calibration in force, by a prior as wide as
anything physical: in the plane the vertical stays, and a circle becomes the 2-D fit by itself.
"""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.evidence.segments import Nodes
from ahrsd.samples import Array

_PRIOR_MATRIX = 0.3
_PRIOR_GAUSS = 0.5
_DRIFT_RAD = 2e-3  # error of the gyro's attitude within a segment: 0.1 mrad/s for half a minute
_NODES = 1000
_ROUNDS = 60
_SETTLED = 1e-3  # of the cost, in units of one sigma squared
_PRIOR_SIGMA = np.r_[np.full(6, _PRIOR_MATRIX), np.full(3, _PRIOR_GAUSS)]
_ELEMENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _symmetric_basis() -> Array:
    """(6, 3, 3) the elements xx, xy, xz, yy, yz, zz."""
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(_ELEMENTS):
        basis[k, i, j] = basis[k, j, i] = 1.0
    return basis


_BASIS = _symmetric_basis()
_TRACELESS = np.array(
    [_BASIS[0] - _BASIS[3], _BASIS[3] - _BASIS[5], _BASIS[1], _BASIS[2], _BASIS[4]]
)


def gyro_fit(nodes: Nodes, present: Affine, sigma_gauss: float) -> Affine | None:
    """Calibration from the segments of `nodes`; None where it is no calibration.

    `sigma_gauss` is the noise of one node's field per axis.
    """
    C0 = (present.matrix + present.matrix.T) / 2
    E = _TRACELESS
    m, R = nodes.raw_b_gauss, nodes.R_0b
    rows = np.stack([*(m @ e for e in E), -m @ C0], axis=2)
    rows = np.concatenate([R @ rows, -R], axis=2)
    rows = (rows - nodes.mean(rows)[nodes.segment]).reshape(-1, 9)
    design, target = rows[:, [0, 1, 2, 3, 4, 6, 7, 8]], rows[:, 5]
    N, y = design.T @ design, design.T @ target
    y[:5] += len(m) * sigma_gauss**2 * np.einsum("aij,ij->a", E, C0)
    prior = sigma_gauss**2 / np.r_[np.full(5, _PRIOR_MATRIX), np.full(3, _PRIOR_GAUSS)] ** 2
    false_motion = len(m) * _DRIFT_RAD**2
    prior += false_motion * np.r_[np.full(5, np.mean(np.sum(m**2, axis=1))), np.ones(3)]
    c0 = C0 @ present.offset
    solution = _solve(N + np.diag(prior), y + prior * np.r_[np.zeros(5), c0])
    if solution is None:
        return None
    C = C0 + np.einsum("a,aij->ij", solution[:5], E)
    return _calibration(C, solution[5:], present)


def size_fit(nodes: Nodes, present: Affine, sigma_gauss: float) -> Affine | None:
    """Ellipsoid through all nodes; None where it does not converge to one."""
    m = nodes.raw_b_gauss[:: max(1, len(nodes.raw_b_gauss) // _NODES)]
    middle = m.mean(axis=0)
    C0 = (present.matrix + present.matrix.T) / 2
    start = _sphere_centre(m, present, sigma_gauss)
    F = float(np.mean(np.linalg.norm((m - start) @ C0, axis=1)))
    upper = [C0[i, j] for i, j in _ELEMENTS]
    prior = np.r_[upper, C0 @ (present.offset - middle)]
    x = np.r_[upper, C0 @ (start - middle)]
    cost, N, y = _size_normal(m - middle, x, F, sigma_gauss, prior=prior)
    damping = 1e-3
    for _ in range(_ROUNDS):
        step = _solve(N + damping * np.diag(np.diag(N)), y)
        if step is None:
            return None
        trial = _size_normal(m - middle, x + step, F, sigma_gauss, prior=prior)
        if not trial[0] <= cost:
            damping *= 10.0
            continue
        settled = cost - trial[0] < _SETTLED
        x, (cost, N, y), damping = x + step, trial, damping / 10.0
        if settled:
            C = np.einsum("a,aij->ij", x[:6], _BASIS)
            return _calibration(C, x[6:] + C @ middle, present)
    return None


def _size_normal(
    m: Array, x: Array, F: float, sigma_gauss: float, *, prior: Array
) -> tuple[float, Array, Array]:
    """Cost, normal matrix and right-hand side at x = (C, c), with h = C m - c.

    The residual is the distance of m from the ellipsoid to first order, g / |grad g| with
    g = (F^2 - |h|^2) / 2 and grad g = -C h; in field units the fit would shrink C to shrink noise.
    """
    C = np.einsum("a,aij->ij", x[:6], _BASIS)
    h = m @ C - x[6:]
    e = h @ C
    q = np.linalg.norm(e, axis=1)[:, None]
    g = (F**2 - np.sum(h**2, axis=1)[:, None]) / 2
    f = e @ C
    by_C = -_bilinear(h, m) / q - g * (_bilinear(e, h) + _bilinear(f, m)) / q**3
    J = np.concatenate([by_C, h / q + g * f / q**3], axis=1) / sigma_gauss
    r, p = (g / q)[:, 0] / sigma_gauss, (x - prior) / _PRIOR_SIGMA
    N = J.T @ J + np.diag(_PRIOR_SIGMA**-2)
    return float(r @ r + p @ p), N, -(J.T @ r + p / _PRIOR_SIGMA)


def _bilinear(a: Array, b: Array) -> Array:
    """(N, 6) a^T E b for the six symmetric elements E."""
    columns = [a[:, i] * b[:, j] + (a[:, j] * b[:, i] if i != j else 0.0) for i, j in _ELEMENTS]
    return np.stack(columns, axis=1)


def _sphere_centre(m: Array, present: Affine, sigma_gauss: float) -> Array:
    """Centre of the sphere |m - b|^2 = F^2, linear in b; held where it is not seen."""
    mean = m.mean(axis=0)
    d = m - mean
    square = np.sum(d**2, axis=1)
    design = 2 * d
    scale = 2 * np.sqrt(np.mean(square)) * max(sigma_gauss, 1e-4)
    weight = (scale / _PRIOR_GAUSS) ** 2
    N = design.T @ design + weight * np.eye(3)
    b = np.linalg.solve(N, design.T @ (square - square.mean()) + weight * (present.offset - mean))
    return np.asarray(b + mean)


def _solve(N: Array, y: Array) -> Array | None:
    """N^-1 y for a symmetric N that must be positive definite; None where it is not."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    if values[0] <= 1e-13:
        return None
    return np.asarray(scale * (vectors @ ((vectors.T @ (scale * y)) / values)))


def _calibration(C: Array, c: Array, present: Affine) -> Affine | None:
    """C and C b as a calibration of the present one's determinant; None unless C is positive."""
    if np.linalg.eigvalsh(C)[0] <= 0.05:
        return None
    scale = np.cbrt(np.linalg.det(present.matrix) / np.linalg.det(C))
    return Affine(scale * C, np.asarray(np.linalg.solve(C, c), dtype=float))
