"""Two independent fits that check an estimate: one from the gyro, one from the field's size.

Gyro fit (for halves of the data). With R_0k from `attitude`, the corrected field of a segment must
not move: R_0k (C m_k - c) = f_s, c = C b. Linear in (C, c); f_s is removed by centring. C = 0 would
do, so the trace of C is held: C = C0 + sum x_i E_i over the five traceless symmetric E_i. Noise in
the regressor m adds sigma^2 tr(E_i E_j) to the normal matrix on average; it is taken off again.

Size fit (second opinion): |C (m - b)| = F by Gauss-Newton over symmetric C and b: an ellipsoid, in
the units of the field, without gyro, gravity or the quadric's sign and shape troubles (Fang et al.
2011 fit the quadric; its answer need not be an ellipsoid).

Both hold what the motion does not determine at the calibration in force, by a prior as wide as
anything physical: in the plane the vertical stays, and a circle becomes the 2-D fit by itself.
"""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.evidence.attitude import Bools, Nodes
from ahrsd.samples import Array

_PRIOR_MATRIX = 0.3
_PRIOR_GAUSS = 0.5
_NODES = 2000
_ROUNDS = 30
_ELEMENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def symmetric_basis() -> Array:
    """(6, 3, 3) the elements xx, xy, xz, yy, yz, zz."""
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(_ELEMENTS):
        basis[k, i, j] = basis[k, j, i] = 1.0
    return basis


def _traceless_basis() -> Array:
    full = symmetric_basis()
    return np.array([full[0] - full[3], full[3] - full[5], full[1], full[2], full[4]])


def gyro_fit(nodes: Nodes, use: Bools, present: Affine, sigma_gauss: float) -> Affine | None:
    """Calibration from the segments marked in `use` (S,); None where it is no calibration.

    `sigma_gauss` is the noise of one node's field per axis.
    """
    C0 = (present.matrix + present.matrix.T) / 2
    E = _traceless_basis()
    chosen = use[nodes.segment]
    m, R = nodes.raw_b_gauss, nodes.R_0b
    columns = [np.einsum("nij,nj->ni", R, m @ e) for e in E]
    design = np.concatenate([np.stack(columns, axis=2), -R], axis=2)
    target = -np.einsum("nij,nj->ni", R, m @ C0)
    design = (design - nodes.mean(design)[nodes.segment])[chosen].reshape(-1, 8)
    target = (target - nodes.mean(target)[nodes.segment])[chosen].ravel()
    count = np.count_nonzero(chosen)
    if count == 0:
        return None
    N, y = design.T @ design, design.T @ target
    noise = count * sigma_gauss**2
    N[:5, :5] -= noise * np.einsum("aij,bij->ab", E, E)
    y[:5] += noise * np.einsum("aij,ij->a", E, C0)
    prior = sigma_gauss**2 / np.r_[np.full(5, _PRIOR_MATRIX), np.full(3, _PRIOR_GAUSS)] ** 2
    c0 = C0 @ present.offset
    solution = _solve(N + np.diag(prior), y + prior * np.r_[np.zeros(5), c0])
    if solution is None:
        return None
    C = C0 + np.einsum("a,aij->ij", solution[:5], E)
    return _calibration(C, solution[5:], present)


def size_fit(nodes: Nodes, present: Affine, sigma_gauss: float) -> Affine | None:
    """Ellipsoid through all nodes; None where it does not converge to one."""
    m = nodes.raw_b_gauss[:: max(1, len(nodes.raw_b_gauss) // _NODES)]
    C0 = (present.matrix + present.matrix.T) / 2
    prior_sigma = np.r_[np.full(6, _PRIOR_MATRIX), np.full(3, _PRIOR_GAUSS)]
    start = _sphere_centre(m, present, sigma_gauss)
    F = float(np.mean(np.linalg.norm((m - start) @ C0, axis=1)))
    centre = np.r_[[C0[i, j] for i, j in _ELEMENTS], present.offset]
    x = np.r_[centre[:6], start]
    basis = symmetric_basis()
    for _ in range(_ROUNDS):
        C = np.einsum("a,aij->ij", x[:6], basis)
        d = m - x[6:]
        h = d @ C
        size = np.linalg.norm(h, axis=1)
        u = h / size[:, None]
        J = np.column_stack([np.einsum("ni,aij,nj->na", u, basis, d), -u @ C]) / sigma_gauss
        N = J.T @ J + np.diag(prior_sigma**-2)
        step = _solve(N, J.T @ ((F - size) / sigma_gauss) + (centre - x) / prior_sigma**2)
        if step is None or not np.isfinite(step).all():
            return None
        x = x + step * min(1.0, 0.3 / float(np.max(np.abs(step))))
        if np.max(np.abs(step)) < 1e-7:
            C = np.einsum("a,aij->ij", x[:6], basis)
            return _calibration(C, C @ x[6:], present)
    return None


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
