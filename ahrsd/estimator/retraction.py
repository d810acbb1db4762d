"""How the calibration moves by a finite step: along the valley of the likelihood, not straight.

Where motion is nearly planar the data fix the field's directions u_k up to a common shift along
the turn's axis. With C = M^-1 and d = C b, u_k = (C m_k - d) / r, and that family is linear in
(C, d) up to the common scale r; in (M, b) it is strongly curved, and a Gauss-Newton step leaves it
at once. So a step dc of [M (6), b (3)] is taken in (C, d), and the scale is restored from the
field's moments.
To first order nothing changes: derivatives, sigmas and the optimum are those of [M, b].
"""

from __future__ import annotations

import numpy as np

from ahrsd.estimator import chain
from ahrsd.samples import Array


class Moments:
    """First and second moments of the field that the calibration was estimated from."""

    def __init__(self) -> None:
        self._count = 0.0
        self._sum: Array = np.zeros(3)
        self._squares: Array = np.zeros((3, 3))

    def take(self, field: Array) -> None:
        """Add rows (n, 3) in gauss."""
        self._count += len(field)
        self._sum = self._sum + field.sum(axis=0)
        self._squares = self._squares + field.T @ field

    def mean_square(self, C: Array, d: Array) -> float:
        """Mean of |C m - d|^2, 0 before the first row."""
        if self._count == 0:
            return 0.0
        total = np.sum((C @ self._squares) * C) - 2 * d @ C @ self._sum + self._count * d @ d
        return float(total / self._count)


def retract(c: Array, dc: Array, moments: Moments) -> Array:
    """c = [M (6), b (3)] after a step dc; plainly c + dc where C would not stay positive."""
    M, dM = chain.symmetric(c[:6]), chain.symmetric(dc[:6])
    C = np.linalg.inv(M)
    dC = -C @ dM @ C
    d, dd = C @ c[6:], dC @ c[6:] + C @ dc[6:]
    if np.linalg.eigvalsh(C + dC)[0] <= 0:
        return np.asarray(c + dc)
    scale = np.sqrt(1.0 + moments.mean_square(dC, dd))
    new = np.linalg.inv((C + dC) / scale)
    return np.concatenate([chain.upper_triangle(new), new @ (d + dd) / scale])


def curvature(c: Array, covariance: Array, moments: Moments) -> Array:
    """What the valley's curvature adds to the covariance (9, 9) of c.

    One sigma along a principal direction ends q beside the straight line, t sigmas t^2 q: of a
    standard normal t that has the mean square 3 q q^T.
    """
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    added = np.zeros((9, 9))
    for value, vector in zip(values, vectors.T, strict=True):
        step = np.sqrt(max(float(value), 0.0)) * scale * vector
        q = (retract(c, step, moments) + retract(c, -step, moments)) / 2 - c
        added += 3 * np.outer(q, q)
    return added
