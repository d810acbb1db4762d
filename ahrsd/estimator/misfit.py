"""How much more the epochs disagree than their covariances allow: 1 for a perfect model.

At the optimum an epoch's gradient r_i on (c, bias) has the covariance S_i (its information) if the
model is right, so r_i^T S_i^-1 r_i averages to its rank, less what the fit used up. Coloured noise,
a wandering field or a lag make it larger, and the covariance of the estimate is multiplied by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.estimator.factors import Factor
from ahrsd.estimator.graph import Graph, Step
from ahrsd.samples import Array

_KEEP, _BORDERS = np.r_[0:12], np.r_[12:14, 17:19]
_USED = 12.0  # parameters that the fit took from the scores
_MEMORY = 0.98  # per epoch that left the window


class Misfit:
    """Scores of the epochs that left the window, and the figure with those that are in it."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0.0

    def remember(self, factor: Factor, graph: Graph) -> None:
        """An epoch leaves the window: keep its score."""
        s, n = _score(*_alone(factor, graph))
        self._sum, self._count = _MEMORY * self._sum + s, _MEMORY * self._count + n

    def value(self, factors: Sequence[Factor], graph: Graph, step: Step) -> float:
        """Mean square of the scores per degree of freedom, where `step` leads.

        At the joint optimum, not at the present values: what all epochs ask for together is not
        disagreement.
        """
        total, count = self._sum, self._count
        dc, dy = step
        for factor in factors:
            H, g = _alone(factor, graph)
            s, n = _score(H, g + H @ np.concatenate([dc, dy[factor.a], dy[factor.b]]))
            total, count = total + s, count + n
        return total / max(count - _USED, 0.2 * count, 1.0)


def _alone(factor: Factor, graph: Graph) -> tuple[Array, Array]:
    """An epoch's quadratic at the present values, without the walk of the bias."""
    return replace(factor, walk=0.0).at(graph.c, graph.nodes[factor.a], graph.nodes[factor.b])


def _score(H: Array, g: Array) -> tuple[float, float]:
    cross = H[np.ix_(_KEEP, _BORDERS)]
    inverse = np.linalg.pinv(H[np.ix_(_BORDERS, _BORDERS)], rcond=1e-12)
    S = H[np.ix_(_KEEP, _KEEP)] - cross @ inverse @ cross.T
    r = g[_KEEP] - cross @ inverse @ g[_BORDERS]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-30))
    values, vectors = np.linalg.eigh(S * np.outer(scale, scale))
    good = values > 1e-4
    projected = (vectors.T @ (scale * r))[good]
    return float(np.sum(projected**2 / values[good])), float(np.count_nonzero(good))
