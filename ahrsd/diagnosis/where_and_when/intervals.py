"""When: the stretches in which a recovered course departs from its usual level.

The level in force for longest is the usual one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array

#: of the largest departure: from which on it is one
AWAY = 0.25
#: deviations by which a course's beginning and end are still away from its usual level
STILL = 2.0


def departures(edges_s: Array, course: Array, deviation: Array) -> list[tuple[float, float]]:
    """Spans in which a course (J, axes) is away from the level that is in force for longest.

    Away: by more than `AWAY` of the largest departure and 3 deviations (J,), and on either side as
    far as the course still shows it (`reaching`).  The whole span where the course
    has no usual level: where none is in force for 40 % of the time.
    """
    length = np.diff(edges_s)
    distance = np.linalg.norm(course[:, None] - course[None], axis=2)
    largest = float(distance.max(initial=0.0))
    if largest == 0.0:
        return [(float(edges_s[0]), float(edges_s[-1]))]
    alike = distance <= np.maximum(AWAY * largest, 3.0 * np.minimum.outer(deviation, deviation))
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
