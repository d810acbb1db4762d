"""What the norm-preserving methods of [L] share: the hard iron alone, |B_k - b| = |H_k|, A = I."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from ahrsd.baselines.data import MethodError, MethodFit
from ahrsd.samples import Array

Function = Callable[[Array], tuple[Array, Array]]
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


def minimise(function: Function, start: Array) -> MethodFit:
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
