"""Three ways to write a soft iron in numbers, each with its derivative.

All give C = A^-1 as c = [00 01 02 11 12 22]:

    unit volume   6 terms of A, rescaled A (l0 l1 l2)^(-1/3) each time  ([R] appendix A)
    triangle      the 6 terms of C themselves                           (magical-bfg, -ifg)
    Cholesky      C = L L^T, L = [[e^p0 0 0] [p1 e^p2 0] [p3 p4 e^-(p0+p2)]]: positive definite
                  and of det 1 whatever p is                            ([M], magyc-bfg, -ifg)
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodError
from ahrsd.estimator.chain import symmetric, upper_triangle
from ahrsd.samples import Array

_LARGEST_CONDITION = 50.0  # of A: no sensor in use is distorted like that; a diverged fit is


def _symmetric_basis() -> Array:
    return np.stack([symmetric(row) for row in np.eye(6)])


BASIS = _symmetric_basis()  # (6, 3, 3): E_j = d(symmetric(x)) / d x_j


def positive(a6: Array) -> bool:
    """Whether symmetric(a6) is positive definite."""
    return bool(np.isfinite(a6).all() and np.linalg.eigvalsh(symmetric(a6))[0] > 0)


def unit_volume(a6: Array) -> tuple[Array, Array]:
    """c (6,) of A = symmetric(a6) rescaled to det 1, and dc/da6 (6, 6), singular along A.

    With s = det^(-1/3):  C = A^-1 / s,  dC = -C dA C s + C tr(A^-1 dA) / 3.
    MethodError where A is not positive definite.
    """
    A = symmetric(a6)
    if not positive(a6):
        raise MethodError("diverged: the soft iron is no longer positive definite")
    s = float(np.linalg.det(A)) ** (-1 / 3)
    inverse = np.linalg.inv(A)
    C = inverse / s
    J = np.empty((6, 6))
    for j, E in enumerate(BASIS):
        J[:, j] = upper_triangle(-C @ E @ C * s + C * np.trace(inverse @ E) / 3)
    return upper_triangle(C), J


def triangle(c6: Array) -> tuple[Array, Array]:
    """c itself and the identity."""
    return c6.copy(), np.eye(6)


def cholesky(p: Array) -> tuple[Array, Array]:
    """c (6,) of C = L L^T and dc/dp (6, 5):  dC = dL L^T + L dL^T."""
    with np.errstate(over="ignore"):  # infinite where a search diverges; the factor says so
        x, y, z = np.exp(p[0]), np.exp(p[2]), np.exp(-(p[0] + p[2]))
    L = np.array([[x, 0, 0], [p[1], y, 0], [p[3], p[4], z]])
    dL = np.zeros((5, 3, 3))
    dL[0, 0, 0], dL[0, 2, 2] = x, -z
    dL[1, 1, 0] = 1.0
    dL[2, 1, 1], dL[2, 2, 2] = y, -z
    dL[3, 2, 0] = 1.0
    dL[4, 2, 1] = 1.0
    J = np.stack([upper_triangle(d @ L.T + L @ d.T) for d in dL], axis=1)
    return upper_triangle(L @ L.T), J


def answer(c6: Array, pseudo: Array) -> tuple[Array, Array]:
    """A of unit volume and b = A b' of c and b' at any common scale.

    MethodError where C is not positive definite or the answer no sensor's.
    """
    C = symmetric(c6)
    if not (np.isfinite(c6).all() and np.isfinite(pseudo).all()):
        raise MethodError("diverged: the answer is not finite")
    values = np.linalg.eigvalsh(C)
    if values[0] <= 0:
        raise MethodError("the matrix that fits best is not positive definite: no soft iron")
    if values[-1] > _LARGEST_CONDITION * values[0]:
        raise MethodError(
            f"the soft iron that fits best is distorted {values[-1] / values[0]:.0f} : 1: "
            "the motion does not determine it"
        )
    A = np.asarray(np.linalg.inv(C), dtype=np.float64)
    b = A @ pseudo  # the scale of C and b' cancels here
    return rescaled(A), b


def rescaled(A: Array) -> Array:
    """A (l0 l1 l2)^(-1/3), symmetric to the last bit."""
    A = (A + A.T) / 2
    return np.asarray(A * float(np.linalg.det(A)) ** (-1 / 3))
