"""How much more the epochs disagree than their covariances allow: 1 for a perfect model.

At the optimum an epoch's gradient r_i on (c, bias) has the covariance S_i (its information) if the
model is right, so r_i^T S_i^-1 r_i averages to its rank, less what the fit used up. Coloured noise,
a wandering field or a lag make it larger, and the covariance of the estimate is multiplied by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.estimator.factors import Factor
from ahrsd.estimator.graph import Graph, Step
from ahrsd.samples import Array

_KEEP, _BORDERS = np.r_[0:12], np.r_[12:14, 17:19]
_USED = 12.0  # parameters that the fit took from the scores
_MEMORY = 0.98  # per epoch that left the window


@dataclass(frozen=True, slots=True, eq=False)
class MisfitScore:
    """What an epoch asks of z = [c, bias] (12,) from where it was linearised, its borders at best.

    The whitened gradient is `asked` (12,) there and `turning` (12, 12) z more elsewhere.

    freedom: degrees of freedom; directions of which the epoch says nothing ask for nothing.
    """

    asked: Array
    turning: Array
    freedom: float


def scores(factors: Sequence[Factor]) -> list[MisfitScore]:
    """Of several epochs' factors."""
    H, g = np.array([f.H for f in factors]), np.array([f.g for f in factors])
    cross = H[:, _KEEP[:, None], _BORDERS]
    gain = cross @ np.linalg.pinv(H[:, _BORDERS[:, None], _BORDERS], rcond=1e-12, hermitian=True)
    S = H[:, _KEEP[:, None], _KEEP] - gain @ np.swapaxes(cross, 1, 2)
    r = g[:, _KEEP] - (gain @ g[:, _BORDERS, None])[:, :, 0]
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), 1e-30))
    values, vectors = np.linalg.eigh(S * scale[:, :, None] * scale[:, None, :])
    good = values > 1e-4
    root = np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0)
    whiten = root[:, :, None] * np.swapaxes(vectors, 1, 2) * scale[:, None, :]
    asked = (whiten @ r[:, :, None])[:, :, 0]
    freedom = np.count_nonzero(good, axis=1).astype(float)
    return [MisfitScore(*each) for each in zip(asked, whiten @ S, freedom, strict=True)]


class Misfit:
    """Scores of the epochs that left the window, and the figure with those that are in it."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0.0

    def remember(self, factor: Factor, score: MisfitScore, graph: Graph) -> None:
        """An epoch leaves the window: keep its score."""
        bias = graph.nodes[factor.a].bias
        s, n = _squares([factor], [score], graph.c, bias[None])
        self._sum, self._count = _MEMORY * self._sum + s, _MEMORY * self._count + n

    def value(
        self, factors: Sequence[Factor], scores: Sequence[MisfitScore], graph: Graph, step: Step
    ) -> tuple[float, float]:
        """Mean square of the scores per degree of freedom, where `step` leads, and its sigma by
        chance were the model right.

        At the joint optimum, not at the present values: what all epochs ask for together is not
        disagreement.
        """
        dc, dy = step
        biases = np.array([graph.nodes[f.a].bias + dy[f.a][:3] for f in factors])
        s, n = _squares(factors, scores, graph.c + dc, biases)
        total, count = self._sum + s, self._count + n
        freedom = max(count - _USED, 0.2 * count, 1.0)
        return total / freedom, float(np.sqrt(2.0 / freedom))


def _squares(
    factors: Sequence[Factor], scores: Sequence[MisfitScore], c: Array, biases: Array
) -> tuple[float, float]:
    """Sum of squares of what is asked for at c and the biases (N, 3), and degrees of freedom."""
    z = np.empty((len(factors), 12))
    z[:, :9] = c - np.array([f.point.c for f in factors])
    z[:, 9:] = biases - np.array([f.point.a.bias for f in factors])
    turning = np.array([s.turning for s in scores])
    asked = np.array([s.asked for s in scores]) + (turning @ z[:, :, None])[:, :, 0]
    return float(np.sum(asked * asked)), sum(s.freedom for s in scores)
