"""TWOSTEP: bias, scale and non-orthogonality without attitude (Alonso & Shuster 2002).

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
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.checks import mag_noise
from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.soft_iron import answer
from ahrsd.estimator.chain import upper_triangle
from ahrsd.samples import Array

_MAX_ITERATIONS = 200
_TOLERANCE = 1e-12
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


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A and b.  MethodError where no step is possible any more, or where it does not end."""
    sigma = mag_noise(data, settings)
    field = data.raw_b_gauss
    L = design(field)
    z = np.sum(field * field, axis=1) - data.field_norms() ** 2 + 3 * sigma**2
    theta = first_step(L, z, _weights(np.zeros(9), field, sigma))
    for count in range(1, _MAX_ITERATIONS + 1):
        weights = _weights(theta, field, sigma)
        J = (L - bias_size(theta)[1]) * weights[:, None]
        step = np.linalg.lstsq(J, _residual(theta, L, z) * weights, rcond=None)[0]
        step = _halved(theta, np.asarray(step), L, z, weights)
        theta = theta + step
        if float(np.sum((J @ step) ** 2)) < _TOLERANCE:
            return _fit(theta, count)
    raise MethodError(f"no end after {_MAX_ITERATIONS} iterations")


def _fit(theta: Array, count: int) -> MethodFit:
    root = _root(theta)
    answer(upper_triangle(root), np.zeros(3))  # refuses what no sensor is
    A = np.asarray(np.linalg.inv(root), dtype=np.float64)
    return MethodFit(A, A @ np.asarray(np.linalg.solve(root, theta[:3])), None, count)
