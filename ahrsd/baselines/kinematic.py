"""The residual that MAGICAL and MAGYC share, and its derivative.

A field fixed in the world turns against the sensor: h' = -w x h. With h = C m - b', b' = C b,

    r = [w - w_b]x (C m - b') + C m'        ([R], [M])
    dr/dc = [w - w_b]x S(m) + S(m'),   dr/db' = -[w - w_b]x,   dr/dw_b = [C m - b']x

S(v) c = symmetric(c) v. Checked numerically in tests/baselines/test_methods_jacobians.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.baselines.data import MethodFit
from ahrsd.baselines.soft_iron import answer
from ahrsd.baselines.windows import Kinematics
from ahrsd.estimator.chain import symmetric, symmetric_columns
from ahrsd.samples import Array

Shape = Callable[[Array], tuple[Array, Array]]


def residual(kin: Kinematics, c6: Array, pseudo: Array, bias: Array) -> tuple[Array, Array]:
    """r (3n,) in gauss/s and its derivative (3n, 12) by [c (6), b' (3), w_b (3)]."""
    K = so3.skew(kin.rate - bias)
    C = symmetric(c6)
    h = kin.field @ C - pseudo
    r = np.einsum("nij,nj->ni", K, h) + kin.derivative @ C
    J = np.empty((len(kin), 3, 12))
    J[:, :, :6] = K @ symmetric_columns(kin.field) + symmetric_columns(kin.derivative)
    J[:, :, 6:9] = -K
    J[:, :, 9:] = so3.skew(h)
    return r.ravel(), J.reshape(-1, 12)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Numbers x = [p of the soft iron, b' (3), w_b (3)] and how p becomes C.

    nodes: lengths of the graph's variables, which together are x
    norm:  whether a factor |C|_F - 1 fixes the scale
    """

    shape: Shape
    start: Array
    nodes: tuple[int, ...]
    norm: bool

    def residual(self, kin: Kinematics, x: Array) -> tuple[Array, Array]:
        """r (3n,) and dr/dx (3n, len(x))."""
        c6, J6 = self.shape(x[:-6])
        r, J = residual(kin, c6, x[-6:-3], x[-3:])
        return r, np.hstack([J[:, :6] @ J6, J[:, 6:]])

    def norm_residual(self, x: Array) -> tuple[Array, Array]:
        """|C|_F - 1 (1,) and its derivative (1, len(x))."""
        c6, J6 = self.shape(x[:-6])
        twice = c6 * _COUNTED
        size = float(np.sqrt(c6 @ twice))
        J = np.zeros((1, len(x)))
        J[0, :-6] = twice @ J6 / size
        return np.array([size - 1.0]), J

    def fit(self, x: Array, iterations: int, note: str = "") -> MethodFit:
        """The answer at x.  MethodError where it is not one."""
        A, b = answer(self.shape(x[:-6])[0], x[-6:-3])
        return MethodFit(A, b, x[-3:].copy(), iterations, note)


_COUNTED = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])  # how often each term stands in the matrix
