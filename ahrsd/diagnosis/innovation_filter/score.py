"""The score of one group of columns, everything else projected out.

In units of one prior deviation per parameter (theta = scale * phi) the projected information is
diagonalised, G = V diag(l) V^T; directions that one prior deviation would not show (l < 1) are left
out, so what is said has the degrees of freedom that the motion offers and no others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.samples import Array

#: Directions with less information than this share of the group's own are dropped: not observable.
_RANK_SHARE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What the data say on one group; r observable directions of its p parameters.

    basis:       (p, r) theta = basis @ z, z in prior deviations
    information: (r,) of z;  score: (r,)
    """

    basis: Array
    information: Array
    score: Array

    @property
    def rank(self) -> int:
        """Observable directions."""
        return len(self.information)

    @property
    def value(self) -> Array:
        """(p,) least-squares parameters, zero in unobservable directions."""
        return np.asarray(self.basis @ (self.score / self.information))


def total_score(G: Array, s: Array, information: Array, scale: Array) -> Score:
    """The score of one group from its projected information (p, p) and score (p,).

    information: (p,) before anything was projected out
    """
    whole = G * scale[:, None] * scale
    values, vectors = np.linalg.eigh((whole + whole.T) / 2)
    before = float(np.sum(information * scale**2))
    kept = values > max(1.0, _RANK_SHARE * before)
    V = vectors[:, kept]
    return Score(scale[:, None] * V, values[kept], (s * scale) @ V)


def solve(G: Array, right: Array) -> Array:
    """G^+ right for a positive semi-definite G, columns scaled to one unit of information."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(G * scale[:, None] * scale)
    kept = values > _RANK_SHARE * 1e-3 * len(values)
    basis = vectors[:, kept]
    inner = (basis.T @ (scale[:, None] * right)) / values[kept][:, None]
    return np.asarray(scale[:, None] * (basis @ inner))
