"""When: the stretches in which a recovered course departs from its usual level.

The course is piecewise constant, its changes chosen one by one, each the one that explains most of
what is left (exact: with the segments' joint Gram, so that the filter's memory from one segment
into the next is not taken for a change), as long as it gains more than it costs; after each one
those that have become superfluous go.  The level in force for longest is the usual one.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.gram import solve
from ahrsd.samples import Array

#: nats that a change point must gain beyond its three coefficients: 1 in 1000 by chance over the
#: hundred places where it could be, log(1e5)
CHANGE_COST = 11.5
#: deviations by which a course's beginning and end are still away from its usual level
STILL = 2.0


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


def departures(
    edges_s: Array, level: Array, deviation: Array, course: Array, share: float = 0.25
) -> list[tuple[float, float]]:
    """Spans in which the level (J, axes) is away from the one in force for longest.

    Away: by more than `share` of the largest departure and 3 deviations (J,), and on either side as
    far as the course itself (J, axes) still shows it (`reaching`).  The whole span where the course
    has no usual level: where none is in force for 40 % of the time.
    """
    length = np.diff(edges_s)
    distance = np.linalg.norm(level[:, None] - level[None], axis=2)
    largest = float(distance.max(initial=0.0))
    if largest == 0.0:
        return [(float(edges_s[0]), float(edges_s[-1]))]
    alike = distance <= np.maximum(share * largest, 3.0 * np.minimum.outer(deviation, deviation))
    usual = alike @ length
    home = int(np.argmax(usual))
    if usual[home] < 0.4 * length.sum():
        return [(float(edges_s[0]), float(edges_s[-1]))]
    usual_course = np.average(course[alike[home]], axis=0)
    return spans(edges_s, reaching(~alike[home], course - usual_course, deviation))


def reaching(inside: Array, course: Array, deviation: Array) -> Array:
    """(J,) `inside` (J,) with the segments beside each span that still go its way.

    What comes and goes slowly has no level of its own at its beginning and end: a segment belongs
    to it as long as its course (J, axes) is `STILL` deviations (J,) away in the span's direction.
    """
    out = np.asarray(inside, bool).copy()
    padded = np.concatenate([[False], out, [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    for start, end in zip(starts, ends, strict=True):
        mean = course[start:end].mean(axis=0)
        along = course @ mean / max(float(np.linalg.norm(mean)), 1e-300) / deviation
        before = np.flatnonzero(along[:start] <= STILL)
        after = np.flatnonzero(along[end:] <= STILL)
        out[before[-1] + 1 if len(before) else 0 : start] = True
        out[end : end + after[0] if len(after) else len(out)] = True
    return out


def spans(edges_s: Array, inside: NDArray[np.bool] | Array) -> list[tuple[float, float]]:
    """Joined (start, end) of the segments that are inside."""
    padded = np.concatenate([[False], np.asarray(inside, bool), [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    return [(float(edges_s[a]), float(edges_s[b])) for a, b in zip(starts, ends, strict=True)]


def _explained(G: Array, s: Array, chosen: list[int], axes: int) -> float:
    if not chosen:
        return 0.0
    index = np.concatenate([np.arange(k * axes, (k + 1) * axes) for k in chosen])
    return float(s[index] @ solve(G[np.ix_(index, index)], s[index, None])[:, 0])
