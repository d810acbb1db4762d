"""Where a recovered course changes: it is piecewise constant.

Its changes are chosen one by one, each the one that explains most of what is left (exact: with the
segments' joint Gram, so that the filter's memory from one segment into the next is not taken for a
change), as long as it gains more than it costs; after each one those that have become superfluous
go.
"""

from __future__ import annotations

import itertools

import numpy as np

from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.samples import Array

#: nats that a change point must gain beyond its three coefficients: 1 in 1000 by chance over the
#: hundred places where it could be, log(1e5)
CHANGE_COST = 11.5


def change_points(G: Array, s: Array, axes: int = 3, most: int = 12) -> list[int]:
    """Segments (1 ... J - 1) with which a new level begins.

    G (J axes, J axes) information and s (J axes,) score, everything else projected out,
    segment-major; at most `most` changes.
    """
    J = len(s) // axes
    steps = np.kron(np.triu(np.ones((J, J))), np.eye(axes)).T  # step j = segments j ... J - 1
    G_steps, s_steps = steps.T @ G @ steps, steps.T @ s
    chosen: list[int] = []
    gain = 0.0
    while len(chosen) < min(most, J - 1):
        trials = {
            k: _explained(G_steps, s_steps, [*chosen, k], axes)
            for k in range(1, J)
            if k not in chosen
        }
        best = max(trials, key=lambda k: trials[k])
        if (trials[best] - gain) / 2 < CHANGE_COST + axes / 2:
            break
        chosen.append(best)
        gain = trials[best]
        for k in list(chosen[:-1]):
            without = [other for other in chosen if other != k]
            left = _explained(G_steps, s_steps, without, axes)
            if (gain - left) / 2 < CHANGE_COST / 2:
                chosen, gain = without, left
    return sorted(chosen)


def explained(G: Array, s: Array, changes: list[int], axes: int = 3) -> float:
    """Score statistic that changes at these segments explain; G, s as in `change_points`."""
    J = len(s) // axes
    steps = np.kron(np.triu(np.ones((J, J))), np.eye(axes)).T
    return _explained(steps.T @ G @ steps, steps.T @ s, changes, axes)


def levels(course: Array, deviation: Array, changes: list[int]) -> Array:
    """(J, axes) the course averaged between the changes, weighted by its deviations (J,)."""
    edges = [0, *changes, len(course)]
    out = np.empty_like(course)
    for start, end in itertools.pairwise(edges):
        weight = 1.0 / np.maximum(deviation[start:end], 1e-12) ** 2
        out[start:end] = np.average(course[start:end], axis=0, weights=weight)
    return out


def _explained(G: Array, s: Array, chosen: list[int], axes: int) -> float:
    if not chosen:
        return 0.0
    index = np.concatenate([np.arange(k * axes, (k + 1) * axes) for k in chosen])
    return float(s[index] @ solve(G[np.ix_(index, index)], s[index, None])[:, 0])
