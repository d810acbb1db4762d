"""The norm-preserving methods of [L]: the hard iron alone, |B_k - b| = |H_k|, A = I.

Total least squares, and three ways to preserve the norm: as a constraint, with the constraint
solved away, and where the field's magnitude is itself measured with noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from ahrsd.baselines.checks import mag_noise
from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.samples import Array

ResidualOfCentre = Callable[[Array], tuple[Array, Array]]
_TOLERANCE = 1e-14  # relative; the sums are smooth and tiny, so the solver may go to the end
_MAX_EVALUATIONS = 500


def linear_centre(field: Array) -> Array:
    """Centre (3,) of the sphere of any radius that fits (N, 3) linearly: |m|^2 = 2 m.b + const."""
    middle = field.mean(axis=0)
    m = field - middle
    squares = np.sum(m * m, axis=1)
    found, _, rank, _ = np.linalg.lstsq(2 * m, squares - squares.mean(), rcond=1e-9)
    if rank < 3:
        raise MethodError("the readings lie in a plane: the sphere's centre is not determined")
    return np.asarray(found + middle)


def distances(field: Array, b: Array) -> tuple[Array, Array]:
    """|B_k - b| (N,) and the unit vectors (N, 3) from b to B_k."""
    d = field - b
    rho = np.linalg.norm(d, axis=1)
    if not np.all(rho > 0):
        raise MethodError("diverged: the hard iron is one of the readings")
    return rho, np.asarray(d / rho[:, None])


def minimise(function: ResidualOfCentre, start: Array) -> MethodFit:
    """b that minimises the sum of squares of `function`: b -> r (N,), dr/db (N, 3)."""

    def value(b: Array) -> Array:
        return function(b)[0]

    def derivative(b: Array) -> Array:
        return function(b)[1]

    found = least_squares(
        value,
        start,
        jac=derivative,
        method="lm",
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=_TOLERANCE,
        max_nfev=_MAX_EVALUATIONS,
    )
    if not found.success:
        raise MethodError(f"no end after {found.nfev} evaluations")
    return MethodFit(None, np.asarray(found.x), None, int(found.nfev))


# -- TLS -------------------------------------------------------------------------------------------
#
# Total least squares on the effective measurement (Crassidis & Cheng 2020, as in [L] 2.25-2.32).
#
#     z_k = |B~_k|^2 - |H_k|^2 = 2 B~_k . b - |b|^2 + v_k
#
# The readings' noise is in the regressor 2 B~_k too, so that v_k = 2 (B~_k - b) . noise to first
# order: its variance 4 s_k^2 |B~_k - b|^2 moves with b. The reduced form that carries it along:
#
#     J(b) = 1/2 sum (|B~_k - b|^2 - |H_k|^2)^2 / (4 s_k^2 |B~_k - b|^2)
#
# With rho = |B~_k - b| a row is (rho - H^2 / rho) / 2 and its derivative -(1 + H^2 / rho^2) / 2
# along the unit vector from b to B~_k. s_k is the same for all readings here and cancels.


def tls_rows(b: Array, field: Array, norms: Array) -> tuple[Array, Array]:
    """r (N,) and dr/db (N, 3)."""
    rho, n = distances(field, b)
    ratio = norms**2 / rho
    return (rho - ratio) / 2, -(1 + ratio / rho)[:, None] / 2 * n


def estimate_tls(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    return minimise(lambda b: tls_rows(b, field, norms), linear_centre(field))


# -- NP --------------------------------------------------------------------------------------------
#
# NP, Method 1 of [L] (2.33-2.37): norm preservation as a constrained problem.
#
#     minimise 1/2 sum |B~_k - B_k|^2 / s_k^2  over all B_k and b,  subject to |B_k - b| = |H_k|
#
# 3 N + 3 unknowns and N constraints, by sequential quadratic programming. With d_k = B_k - b, rho_k
# = |d_k|, n_k = d_k / rho_k, e_k = B~_k - B_k and the multipliers mu_k = n_k . e_k, the
# Lagrangian's curvature across n_k is a_k = mu_k / rho_k. Given the step of b that of B_k is
# explicit,
#
#     along n_k:   n_k . dB_k = n_k . db - (rho_k - |H_k|)
#     across n_k:  dB_k = (e_k + a_k db) / (1 + a_k)
#
# and db solves, with q_k = a_k / (1 + a_k),
#
#     sum [n n^T + q (I - n n^T)] db = sum n (rho - |H| + n . e) + q (I - n n^T) e
#
# Negative a_k are left out where that matrix would not be positive definite. Ends where the B_k
# meet the constraints and db vanishes; s_k is the same for all readings here and cancels.


_NP_MAX_ITERATIONS = 500
_STEP_GAUSS = 1e-12
_CONSTRAINT_GAUSS = 1e-12
_LEAST_CURVATURE = -0.9  # across the constraint; at -1 a reading is where the hard iron is
_LEAST_EIGENVALUE = 1e-4  # of the matrix of db, per reading


def solve_np(field: Array, norms: Array, start: Array) -> tuple[Array, Array, int]:
    """b (3,), B_k (N, 3) and the iterations.  MethodError where they do not end."""
    b, B = start.copy(), field.copy()
    for count in range(1, _NP_MAX_ITERATIONS + 1):
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
    raise MethodError(f"no end after {_NP_MAX_ITERATIONS} iterations")


def _step_of_b(n: Array, rest: Array, across: Array, a: Array) -> tuple[Array, Array]:
    """db (3,) and the curvatures (N,) that were used, the negative ones only where they may."""
    matrix, q = _np_matrix(n, a)
    if np.linalg.eigvalsh(matrix)[0] <= _LEAST_EIGENVALUE * len(n):
        a = np.maximum(a, 0.0)
        matrix, q = _np_matrix(n, a)
    return np.asarray(np.linalg.solve(matrix, n.T @ rest + q @ across)), a


def _np_matrix(n: Array, a: Array) -> tuple[Array, Array]:
    q = a / (1 + a)
    return np.asarray(n.T @ (n * (1 - q)[:, None]) + np.sum(q) * np.eye(3)), q


def estimate_np(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known or the search does not end."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    b, _, count = solve_np(field, norms, linear_centre(field))
    return MethodFit(None, b, None, count)


# -- FNP -------------------------------------------------------------------------------------------
#
# FNP, Method 2 of [L] (2.38-2.55): norm preservation with the constraint solved away.
#
#     J(b) = 1/2 sum s_k^-2 (|B~_k - b| - |H_k|)^2,    B_k = b + |H_k| (B~_k - b) / |B~_k - b|
#
# The same answer as NP from three unknowns. s_k is the same for all readings here and cancels.


def fnp_rows(b: Array, field: Array, norms: Array) -> tuple[Array, Array]:
    """r (N,) and dr/db (N, 3)."""
    rho, n = distances(field, b)
    return rho - norms, -n


def estimate_fnp(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    return minimise(lambda b: fnp_rows(b, field, norms), linear_centre(field))


# -- NP with an uncertain field --------------------------------------------------------------------
#
# NP with an uncertain field, Method 3 of [L] (2.56-2.73): |H_k| is itself measured, with noise.
#
#     minimise 1/2 sum |B~_k - b - B'_k|^2 / s_k^2 + (H~_k - |B'_k|)^2 / s_h^2   over all B'_k and b
#
# in turn over B'_k = B_k - b, which lies along n_k, from b to B~_k, and is c_k rho_k + (1 - c_k)
# H~_k long with rho_k = |B~_k - b| and c_k = s_h^2 / (s_k^2 + s_h^2), and over b, the mean of B~_k
# - B'_k:
#
#     db = mean (1 - c_k) (rho_k - H~_k) n_k
#
# A field less sure than the readings has c_k near 1 and turns that crawl: they are lengthened by 1
# / mean (1 - c_k), which ends at the same place. Where all samples have the same noise, c_k cancels
# and b is FNP's; `MethodSettings.sigma_field_gauss` of every sample makes a difference. The errors
# of |H_k| count as independent; an error common to all of them is not what this model knows.


_MAX_TURNS = 50_000
_LEFT_GAUSS = 1e-9


def solve_np_uncertain_field(
    field: Array, norms: Array, weights: Array, start: Array
) -> tuple[Array, int]:
    """b (3,) and the turns; weights (N,) are 1 - c_k, at any scale.

    In the end each turn leaves the same part of the error, so what is left is a geometric series.
    MethodError where that is not below 1e-9 gauss in 50,000 turns.
    """
    b, before = start.copy(), np.inf
    axes = np.ascontiguousarray(field.T)
    share = weights / np.sum(weights)
    for count in range(1, _MAX_TURNS + 1):
        d = axes - b[:, None]
        rho = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        if not np.all(rho > 0):
            raise MethodError("diverged: the hard iron is one of the readings")
        step = d @ (share * (1 - norms / rho))
        b = b + step
        moved = float(np.sqrt(step @ step))
        if moved < _LEFT_GAUSS * max(1 - moved / before, 0.0) or moved == 0.0:
            return b, count
        before = moved
    raise MethodError(f"no end after {_MAX_TURNS} turns")


def estimate_np_uncertain_field(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known or the turns do not end."""
    field, norms = data.raw_b_gauss, data.field_norms()
    sigma = np.asarray(settings.sigma_field_gauss, dtype=np.float64)
    if sigma.ndim and sigma.shape != (len(data),):
        raise MethodError(f"sigma_field_gauss has {sigma.shape}: one number or {len(data)}")
    noise = mag_noise(data, settings) ** 2
    weights = np.broadcast_to(noise / (noise + sigma**2), (len(data),))
    b, count = solve_np_uncertain_field(field, norms, weights, linear_centre(field))
    return MethodFit(None, b, None, count)
