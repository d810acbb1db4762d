"""The one way from a residual to GTSAM's CustomFactor.

A Jacobian of the wrong shape kills the process there, a vector in its place is read from memory
that nobody wrote, and a residual that is not a number ends the optimiser without a word. So shapes
and values are checked here, before every return.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import gtsam
import numpy as np

from ahrsd.baselines.data import MethodError
from ahrsd.samples import Array

Residual = Callable[[Array], tuple[Array, Array]]
"""x, the variables one after the other -> residual (rows,) and its derivative (rows, len(x))."""


def variable(i: int) -> int:
    """Key of a graph's i-th variable."""
    return int(gtsam.symbol("x", i))


def split(x: Array, lengths: Sequence[int]) -> list[Array]:
    """The variables that x consists of."""
    edges = np.cumsum([0, *lengths])
    return [x[a:b] for a, b in pairwise(edges)]


def values_of(x: Array, lengths: Sequence[int]) -> gtsam.Values:
    """x as GTSAM's values."""
    values = gtsam.Values()
    for i, part in enumerate(split(x, lengths)):
        values.insert(variable(i), part)
    return values


def vector_of(values: gtsam.Values, count: int) -> Array:
    """x of the first `count` variables."""
    return np.concatenate([values.atVector(variable(i)) for i in range(count)])


def custom_factor(
    residual: Residual, rows: int, lengths: Sequence[int], sigma: float
) -> gtsam.CustomFactor:
    """A factor of `rows` rows on all the variables, each row with the same sigma.

    MethodError, out of whatever optimises, where the residual is not finite.
    """
    edges = np.cumsum([0, *lengths])

    def evaluate(
        _: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None
    ) -> Array:
        r, J = residual(vector_of(values, len(lengths)))
        if r.shape != (rows,) or J.shape != (rows, int(edges[-1])):
            raise MethodError(f"a factor of {rows} rows returned {r.shape} and {J.shape}")
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            raise MethodError("diverged: a residual is not finite")
        if H is not None:
            for i, (a, b) in enumerate(pairwise(edges)):
                H[i] = np.asfortranarray(J[:, a:b])
        return r

    noise = gtsam.noiseModel.Isotropic.Sigma(rows, sigma)
    return gtsam.CustomFactor(noise, [variable(i) for i in range(len(lengths))], evaluate)
