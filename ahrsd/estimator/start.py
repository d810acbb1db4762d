"""The first linearisation point, from a linear problem: no starting value, no iteration.

Over a lag of L rows with the gyro's rotation R the corrected field must turn with the sensor:

    C m_(k+L) - R C m_k - (I - R) d = 0,    d = C b

linear and homogeneous in the symmetric C (6) and d (3). The field's noise enters the regressors of
C, adding (its variance) * D with D = 2 diag(1,2,2,1,2,1) per row triple to their Gram matrix, so
plain least squares would shrink C where motion is small; minimising v^T G v / v^T D v instead is
the errors-in-variables solution: the smallest generalised eigenvector. The sign and scale of C
follow from det C > 0 and |C (m - b)| = 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import eigh

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.samples import Array

_LAGS_S = (0.6, 1.8, 4.5)  # from quick turns to slow ones
_NOISE_GRAM = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])


def linear_start(epochs: Sequence[chain.EpochData]) -> Array | None:
    """c = [M (6), b (3)] in gauss, or None where the linear problem has no sound answer."""
    gram = np.zeros((9, 9))
    rows = 0
    for data in epochs:
        turned = _orientation(data)
        columns = chain.symmetric_columns(data.field_b_gauss)
        piece = np.zeros(len(data)) if data.linked is None else np.cumsum(data.linked == 0)
        for lag_s in _LAGS_S:
            lag = max(1, round(lag_s / float(np.median(data.dt_s[1:]))))
            same = piece[lag:] == piece[:-lag]
            R = np.swapaxes(turned[lag:], 1, 2) @ turned[:-lag]
            phi = np.concatenate([columns[lag:] - R @ columns[:-lag], R - np.eye(3)], axis=2)
            flat = phi[same].reshape(-1, 9)
            gram += flat.T @ flat
            rows += int(np.count_nonzero(same))
    if rows == 0:
        return None
    return _solve(gram, rows, np.vstack([d.field_b_gauss for d in epochs]))


def sphere_start(field: Array) -> Array | None:
    """c of the sphere |m - b| = r fitted linearly to (N, 3): |m|^2 = 2 m.b + (r^2 - |b|^2)."""
    centre = field.mean(axis=0)
    m = field - centre
    design = np.column_stack([2 * m, np.ones(len(m))])
    solution, _, rank, _ = np.linalg.lstsq(design, np.sum(m * m, axis=1), rcond=1e-9)
    r2 = solution[3] + solution[:3] @ solution[:3]
    if rank < 4 or r2 <= 0:
        return None
    return np.concatenate([chain.upper_triangle(np.eye(3) * np.sqrt(r2)), solution[:3] + centre])


def mirrored(c: Array, field: Array) -> Array:
    """c with its hard iron on the other side of the plane that lies best among fields (N, 3)."""
    centre = field.mean(axis=0)
    away = field - centre
    normal = np.linalg.eigh(away.T @ away)[1][:, 0]
    out = c.copy()
    out[6:9] += 2.0 * normal * (normal @ (centre - c[6:9]))
    return out


def _orientation(data: chain.EpochData) -> Array:
    """R_0k of every step against the epoch's first, (n, 3, 3)."""
    return so3.products(so3.exp(np.vstack([np.zeros((1, 3)), data.angle_b_rad[1:]])))


def _solve(gram: Array, rows: int, field: Array) -> Array | None:
    G11, G12, G22 = gram[:6, :6], gram[:6, 6:], gram[6:, 6:]
    ridge = 1e-9 * np.trace(G22) / 3 + 1e-12
    back = np.linalg.solve(G22 + ridge * np.eye(3), G12.T)
    reduced = G11 - G12 @ back
    _, vectors = eigh((reduced + reduced.T) / 2, np.diag(2.0 * rows * _NOISE_GRAM))
    c6 = vectors[:, 0]
    C = chain.symmetric(c6)
    d = -back @ c6
    if np.trace(C) < 0:
        C, d = -C, -d
    eigenvalues = np.linalg.eigvalsh(C)
    if eigenvalues[0] <= 0.05 * eigenvalues[-1]:
        return None
    b = np.linalg.solve(C, d)
    scale = float(np.median(np.linalg.norm((field - b) @ C, axis=1)))
    if not np.isfinite(scale) or scale <= 0:
        return None
    M = np.asarray(np.linalg.inv(C / scale), dtype=np.float64)
    return np.concatenate([chain.upper_triangle(M), b])
