"""Methods that need no attitude and no gyro: ellipsoid fit, TWOSTEP, and the norm-preserving ones.

-- Ellipsoid fit after Fang et al. 2011, with the quadric conditions of [R] appendix A --

    a x^2 + b y^2 + c z^2 + 2f yz + 2g xz + 2h xy + 2p x + 2q y + 2r z + d = 0,   a + b + c = -3

is linear once a = -3 - b - c is put in. That constraint rewards a large coefficient along an axis
in which the readings vary little; Fang's own, 4 a b - (2 h)^2 = 1, does not where that axis is z,
and can be chosen (`MethodSettings.ellipsoid_constraint`). With Q = [[a h g] [h b f] [g f c]] and
n = [p q r],

    hard iron = -Q^-1 n,    C^T C = Q up to scale and sign

The trace of -3 makes Q negative for an ellipsoid: its sign is fixed before the root is taken, so
the soft iron is the positive definite one. A quadric is a real ellipsoid if and only if (1) Q has
rank 3, (2) E = [[Q n] [n^T d]] has rank 4, (3) det E < 0, (4) the eigenvalues of Q have one sign.

-- TWOSTEP: bias, scale and non-orthogonality without attitude (Alonso & Shuster 2002) --

Model (I + D) B_k - b = O_k H_k + noise with D symmetric; with E = 2 D + D^2 and c = (I + D) b

    z_k = |B_k|^2 - |H_k|^2 = L_k theta - |b(theta)|^2 + v_k
    theta = [c, E11, E22, E33, E12, E13, E23]
    L_k = [2 B^T, -B1^2, -B2^2, -B3^2, -2 B1 B2, -2 B1 B3, -2 B2 B3]
    mean of v = -3 s^2,   variance of v = 4 s^2 |(I + D) B_k - b|^2 + 6 s^4

Step 1 takes weighted means away, and with them |b|^2: linear in theta. Where |H_k| is the same for
all samples, E = -I and c = 0 solve that exactly and say nothing; step 1 is then the one for the
bias alone, E = 0. Step 2 is Gauss-Newton on
the full likelihood, with |b(theta)|^2 = c^T (I + E)^-1 c and, v = (I + E)^-1 c,

    d|b|^2/dc = 2 v,   d|b|^2/dE = -[v1^2 v2^2 v3^2 2 v1 v2  2 v1 v3  2 v2 v3]

halving steps that do not lower it, until theta moves by less than 1e-12 in its own information.
A = (I + D)^-1, hard iron A b. The size of A is what |H_k| makes it.

-- The norm-preserving methods of [L]: the hard iron alone, |B_k - b| = |H_k|, A = I --

Total least squares, and three ways to preserve the norm: as a constraint, with the constraint
solved away, and where the field's magnitude is itself measured with noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ahrsd.baselines.data import (
    MethodData,
    MethodError,
    MethodFit,
    MethodSettings,
    answer,
    mag_noise,
)
from ahrsd.estimator.chain import upper_triangle
from ahrsd.samples import Array

# -- Ellipsoid fit ---------------------------------------------------------------------------------


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


def estimate_ellipsoid(data: MethodData, settings: MethodSettings) -> MethodFit:
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


# -- TWOSTEP ---------------------------------------------------------------------------------------


_TWOSTEP_MAX_ITERATIONS = 200
_TWOSTEP_TOLERANCE = 1e-12
_MAX_HALVINGS = 30
_COLLAPSED = 0.05  # eigenvalue of I + E below which step 1 found next to nothing


def design(field: Array) -> Array:
    """L (N, 9) of readings (N, 3)."""
    x, y, z = field.T
    columns = [2 * field, -x * x, -y * y, -z * z, -2 * x * y, -2 * x * z, -2 * y * z]
    return np.asarray(np.column_stack(columns))


def matrix_of(theta: Array) -> Array:
    """I + E (3, 3)."""
    e = theta[3:]
    E = np.array([[e[0], e[3], e[4]], [e[3], e[1], e[5]], [e[4], e[5], e[2]]])
    return np.asarray(np.eye(3) + E)


def bias_size(theta: Array) -> tuple[float, Array]:
    """|b|^2 and its derivative (9,) by theta."""
    v = np.linalg.solve(matrix_of(theta), theta[:3])
    x, y, z = v
    gradient = np.array(
        [2 * x, 2 * y, 2 * z, -x * x, -y * y, -z * z, -2 * x * y, -2 * x * z, -2 * y * z]
    )
    return float(theta[:3] @ v), gradient


def _root(theta: Array) -> Array:
    """I + D.  MethodError where I + E is not positive definite."""
    values, vectors = np.linalg.eigh(matrix_of(theta))
    if values[0] <= 0:
        raise MethodError("diverged: I + E is not positive definite")
    return np.asarray(vectors @ np.diag(np.sqrt(values)) @ vectors.T)


def _weights(theta: Array, field: Array, sigma: float) -> Array:
    """Square roots of the inverse variances of v (N,)."""
    root = _root(theta)
    true = field @ root - np.linalg.solve(root, theta[:3])
    return np.asarray((4 * sigma**2 * np.sum(true * true, axis=1) + 6 * sigma**4) ** -0.5)


def centred(L: Array, z: Array, weights: Array) -> Array:
    """Step 1: theta (columns of L,) of L theta = z with the weighted means taken away."""
    w2 = weights**2 / np.sum(weights**2)
    return np.asarray(
        np.linalg.lstsq((L - w2 @ L) * weights[:, None], (z - w2 @ z) * weights, rcond=None)[0]
    )


def first_step(L: Array, z: Array, weights: Array) -> Array:
    """theta (9,) of step 1, of the bias alone where the whole collapses."""
    theta = centred(L, z, weights)
    if np.linalg.eigvalsh(matrix_of(theta))[0] > _COLLAPSED:
        return theta
    return np.concatenate([centred(L[:, :3], z, weights), np.zeros(6)])


def _residual(theta: Array, L: Array, z: Array) -> Array:
    return np.asarray(z - L @ theta + bias_size(theta)[0])


def _halved(theta: Array, step: Array, L: Array, z: Array, weights: Array) -> Array:
    """The longest halving of the step that keeps I + E positive and raises no cost."""
    cost = float(np.sum((_residual(theta, L, z) * weights) ** 2))
    for _ in range(_MAX_HALVINGS):
        new = theta + step
        if np.linalg.eigvalsh(matrix_of(new))[0] > 0:
            found = float(np.sum((_residual(new, L, z) * weights) ** 2))
            if found <= cost * (1 + 1e-12):  # rounding, at the very end
                return step
        step = step / 2
    raise MethodError("no step lowers the cost: I + E stays on the edge of positive definite")


def estimate_twostep(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A and b.  MethodError where no step is possible any more, or where it does not end."""
    sigma = mag_noise(data, settings)
    field = data.raw_b_gauss
    L = design(field)
    z = np.sum(field * field, axis=1) - data.field_norms() ** 2 + 3 * sigma**2
    theta = first_step(L, z, _weights(np.zeros(9), field, sigma))
    for count in range(1, _TWOSTEP_MAX_ITERATIONS + 1):
        weights = _weights(theta, field, sigma)
        J = (L - bias_size(theta)[1]) * weights[:, None]
        step = np.linalg.lstsq(J, _residual(theta, L, z) * weights, rcond=None)[0]
        step = _halved(theta, np.asarray(step), L, z, weights)
        theta = theta + step
        if float(np.sum((J @ step) ** 2)) < _TWOSTEP_TOLERANCE:
            return _fit(theta, count)
    raise MethodError(f"no end after {_TWOSTEP_MAX_ITERATIONS} iterations")


def _fit(theta: Array, count: int) -> MethodFit:
    root = _root(theta)
    answer(upper_triangle(root), np.zeros(3))  # refuses what no sensor is
    A = np.asarray(np.linalg.inv(root), dtype=np.float64)
    return MethodFit(A, A @ np.asarray(np.linalg.solve(root, theta[:3])), None, count)


# -- The norm-preserving methods -------------------------------------------------------------------


ResidualOfCentre = Callable[[Array], tuple[Array, Array]]
_NORM_TOLERANCE = 1e-14  # relative; the sums are smooth and tiny, so the solver may go to the end
_NORM_MAX_EVALUATIONS = 500


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
    from scipy.optimize import least_squares  # dear to import, and seldom needed

    def value(b: Array) -> Array:
        return function(b)[0]

    def derivative(b: Array) -> Array:
        return function(b)[1]

    found = least_squares(
        value,
        start,
        jac=derivative,
        method="lm",
        xtol=_NORM_TOLERANCE,
        ftol=_NORM_TOLERANCE,
        gtol=_NORM_TOLERANCE,
        max_nfev=_NORM_MAX_EVALUATIONS,
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
