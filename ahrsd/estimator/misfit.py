"""How much more the epochs disagree than their covariances allow: 1 for a perfect model.

At the optimum an epoch's gradient r_i on (c, bias) has the covariance S_i (its information) if the
model is right, so r_i^T S_i^-1 r_i averages to its rank, less what the fit used up. Coloured noise,
a wandering field or a lag make it larger, and the covariance of the estimate is multiplied by it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.estimator.factors import Factor, Stack
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
        H, g = Stack([factor], graph.c, graph.nodes).here(walk=False)
        s, n = _scores(H, g)
        self._sum, self._count = _MEMORY * self._sum + s, _MEMORY * self._count + n

    def value(self, factors: Sequence[Factor], graph: Graph, step: Step) -> float:
        """Mean square of the scores per degree of freedom, where `step` leads.

        At the joint optimum, not at the present values: what all epochs ask for together is not
        disagreement.
        """
        dc, dy = step
        H, g = Stack(factors, graph.c, graph.nodes).here(walk=False)
        ahead = np.array([np.concatenate([dc, dy[f.a], dy[f.b]]) for f in factors])
        s, n = _scores(H, g + (H @ ahead[:, :, None])[:, :, 0])
        total, count = self._sum + s, self._count + n
        return total / max(count - _USED, 0.2 * count, 1.0)


def _scores(H: Array, g: Array) -> tuple[float, float]:
    """Sum of squares and degrees of freedom of several epochs, borders eliminated."""
    cross = H[:, _KEEP[:, None], _BORDERS]
    gain = cross @ np.linalg.pinv(H[:, _BORDERS[:, None], _BORDERS], rcond=1e-12, hermitian=True)
    S = H[:, _KEEP[:, None], _KEEP] - gain @ np.swapaxes(cross, 1, 2)
    r = g[:, _KEEP] - (gain @ g[:, _BORDERS, None])[:, :, 0]
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), 1e-30))
    values, vectors = np.linalg.eigh(S * scale[:, :, None] * scale[:, None, :])
    good = values > 1e-4
    projected = (np.swapaxes(vectors, 1, 2) @ (scale * r)[:, :, None])[:, :, 0]
    return float(np.sum(projected[good] ** 2 / values[good])), float(np.count_nonzero(good))
