"""Where a named term acts: when, on which axes, in which regime of what was logged.

When is where a recovered course departs from its usual level (`departures`), the one that is in
force for longest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Where
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.effects.effect import Setting
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.where_and_when.locate import segments
from ahrsd.samples import Array

AXES = ("x", "y", "z")
_STRETCHES = 100


def where_of(track: Track, added: Array, setting: Setting, frame: str) -> Where:
    """The address of a term that adds (N, 3) gauss or rad/s to the readings."""
    spread = np.sqrt(np.mean(added**2, axis=0))
    axes = tuple(AXES[k] for k in range(3) if spread[k] > priors.ACTS_ON_AXIS * spread.max())
    frequency = setting.get("frequency_hz")
    width = 1.0 / max(track.duration_s, 1e-9)
    return Where(
        _when(track, added, setting),
        axes,
        frame,
        _regime(track, added, setting),
        None if frequency is None else (float(frequency) - width, float(frequency) + width),
    )


def _when(track: Track, added: Array, setting: Setting) -> tuple[tuple[float, float], ...]:
    if "onset_s" in setting and "length_s" not in setting:
        return ((float(setting["onset_s"]), float(setting.get("end_s", track.time_s[-1]))),)
    cut = segments(track.time_s, _STRETCHES)
    size = np.array(
        [
            np.sqrt(np.mean(added[cut.index == k] ** 2)) if (cut.index == k).any() else 0.0
            for k in range(len(cut))
        ]
    )
    found = spans(cut.edges_s, size > priors.ACTS_IN_STRETCH * size.max())
    if sum(b - a for a, b in found) > priors.ACTS_EVERYWHERE * track.duration_s:
        found = [(float(track.time_s[0]), float(track.time_s[-1]))]
    return tuple(found)


def _regime(track: Track, added: Array, setting: Setting) -> str | None:
    """`motor_current_a > 6`: the covariate's upper range, where the term acts most."""
    name = setting.get("covariate")
    values = track.covariates.get(str(name))
    if values is None or not np.isfinite(values).any():
        return None
    size = np.linalg.norm(added, axis=1)
    strong = values[size >= np.median(size)]
    low, high = float(np.min(strong)), float(np.max(strong))
    if low > float(np.median(values)) * 0.9:
        return f"{label(str(name))} > {low:.3g}"
    below = high < float(np.median(values))
    return f"{label(str(name))} < {high:.3g}" if below else f"follows {label(str(name))}"


def departures(edges_s: Array, course: Array, deviation: Array) -> list[tuple[float, float]]:
    """Spans in which a course (J, axes) is away from the level that is in force for longest.

    Away: by more than `DEPARTED` of the largest departure and 3 deviations (J,), and on either side
    as far as the course still shows it (`reaching`).  The whole span where the course has no usual
    level: where none is in force for 40 % of the time.
    """
    length = np.diff(edges_s)
    distance = np.linalg.norm(course[:, None] - course[None], axis=2)
    largest = float(distance.max(initial=0.0))
    if largest == 0.0:
        return [(float(edges_s[0]), float(edges_s[-1]))]
    alike = distance <= np.maximum(
        priors.DEPARTED * largest, 3.0 * np.minimum.outer(deviation, deviation)
    )
    usual = alike @ length
    home = int(np.argmax(usual))
    if usual[home] < 0.4 * length.sum():
        return [(float(edges_s[0]), float(edges_s[-1]))]
    usual_course = np.average(course[alike[home]], axis=0)
    return spans(edges_s, reaching(~alike[home], course - usual_course, deviation))


def reaching(inside: Array, course: Array, deviation: Array) -> Array:
    """(J,) `inside` (J,) with the segments beside each span that still go its way.

    What comes and goes slowly has no level of its own at its beginning and end: a segment belongs
    to it as long as its course (J, axes) is `STILL_DEPARTED` deviations (J,) away in the span's
    direction.
    """
    out = np.asarray(inside, bool).copy()
    padded = np.concatenate([[False], out, [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    for start, end in zip(starts, ends, strict=True):
        mean = course[start:end].mean(axis=0)
        along = course @ mean / max(float(np.linalg.norm(mean)), 1e-300) / deviation
        before = np.flatnonzero(along[:start] <= priors.STILL_DEPARTED)
        after = np.flatnonzero(along[end:] <= priors.STILL_DEPARTED)
        out[before[-1] + 1 if len(before) else 0 : start] = True
        out[end : end + after[0] if len(after) else len(out)] = True
    return out


def spans(edges_s: Array, inside: NDArray[np.bool] | Array) -> list[tuple[float, float]]:
    """Joined (start, end) of the segments that are inside."""
    padded = np.concatenate([[False], np.asarray(inside, bool), [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    return [(float(edges_s[a]), float(edges_s[b])) for a, b in zip(starts, ends, strict=True)]
