"""NP, Method 1 of [L] (2.33-2.37): norm preservation as a constrained problem.

    minimise 1/2 sum |B~_k - B_k|^2 / s_k^2  over all B_k and b,  subject to |B_k - b| = |H_k|

3 N + 3 unknowns and N constraints, by sequential quadratic programming. With d_k = B_k - b, rho_k =
|d_k|, n_k = d_k / rho_k, e_k = B~_k - B_k and the multipliers mu_k = n_k . e_k, the Lagrangian's
curvature across n_k is a_k = mu_k / rho_k. Given the step of b that of B_k is explicit,

    along n_k:   n_k . dB_k = n_k . db - (rho_k - |H_k|)
    across n_k:  dB_k = (e_k + a_k db) / (1 + a_k)

and db solves, with q_k = a_k / (1 + a_k),

    sum [n n^T + q (I - n n^T)] db = sum n (rho - |H| + n . e) + q (I - n n^T) e

Negative a_k are left out where that matrix would not be positive definite. Ends where the B_k meet
the constraints and db vanishes; s_k is the same for all readings here and cancels.
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.sphere import distances, linear_centre
from ahrsd.samples import Array

_MAX_ITERATIONS = 500
_STEP_GAUSS = 1e-12
_CONSTRAINT_GAUSS = 1e-12
_LEAST_CURVATURE = -0.9  # across the constraint; at -1 a reading is where the hard iron is
_LEAST_EIGENVALUE = 1e-4  # of the matrix of db, per reading


def solve(field: Array, norms: Array, start: Array) -> tuple[Array, Array, int]:
    """b (3,), B_k (N, 3) and the iterations.  MethodError where they do not end."""
    b, B = start.copy(), field.copy()
    for count in range(1, _MAX_ITERATIONS + 1):
        rho, n = distances(B, b)
        e = field - B
        along = np.sum(n * e, axis=1)
        across = e - along[:, None] * n
        a = np.maximum(along / rho, _LEAST_CURVATURE)
        db, a = _step_of_b(n, rho - norms + along, across, a)
        parallel = n @ db
        dB = (across + a[:, None] * (db - parallel[:, None] * n)) / (1 + a)[:, None]
        B = B + dB + (parallel - rho + norms)[:, None] * n
        b = b + db
        violation = float(np.max(np.abs(np.linalg.norm(B - b, axis=1) - norms)))
        if float(np.linalg.norm(db)) < _STEP_GAUSS and violation < _CONSTRAINT_GAUSS:
            return b, B, count
    raise MethodError(f"no end after {_MAX_ITERATIONS} iterations")


def _step_of_b(n: Array, rest: Array, across: Array, a: Array) -> tuple[Array, Array]:
    """db (3,) and the curvatures (N,) that were used, the negative ones only where they may."""
    matrix, q = _matrix(n, a)
    if np.linalg.eigvalsh(matrix)[0] <= _LEAST_EIGENVALUE * len(n):
        a = np.maximum(a, 0.0)
        matrix, q = _matrix(n, a)
    return np.asarray(np.linalg.solve(matrix, n.T @ rest + q @ across)), a


def _matrix(n: Array, a: Array) -> tuple[Array, Array]:
    q = a / (1 + a)
    return np.asarray(n.T @ (n * (1 - q)[:, None]) + np.sum(q) * np.eye(3)), q


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known or the search does not end."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    b, _, count = solve(field, norms, linear_centre(field))
    return MethodFit(None, b, None, count)
