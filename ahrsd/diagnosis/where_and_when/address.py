"""Where an effect acts: intervals in time, sensor axes, and range of the logged covariate.

For a time series of coefficients the intervals are those in which it departs from its usual level
(`departure_intervals`), which is the level that lasts longest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Where
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.effects.effect import Setting
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.where_and_when.locate import equal_segments
from ahrsd.samples import Array

AXES = ("x", "y", "z")
_SEGMENTS = 100


def locate_contribution(track: Track, added: Array, setting: Setting, frame: str) -> Where:
    """The `Where` of an effect that adds (N, 3) gauss or rad/s to the readings."""
    spread = np.sqrt(np.mean(added**2, axis=0))
    axes = tuple(AXES[k] for k in range(3) if spread[k] > priors.ACTS_ON_AXIS * spread.max())
    frequency = setting.get("frequency_hz")
    width = 1.0 / max(track.duration_s, 1e-9)
    return Where(
        _active_intervals(track, added, setting),
        axes,
        frame,
        _regime_text(track, added, setting),
        None if frequency is None else (float(frequency) - width, float(frequency) + width),
    )


def _active_intervals(
    track: Track, added: Array, setting: Setting
) -> tuple[tuple[float, float], ...]:
    """From the onset on, if the setting has one; else the segments with most of the effect."""
    if "onset_s" in setting and "length_s" not in setting:
        return ((float(setting["onset_s"]), float(setting.get("end_s", track.time_s[-1]))),)
    segments = equal_segments(track.time_s, _SEGMENTS)
    size = np.array(
        [
            np.sqrt(np.mean(added[segments.index == k] ** 2))
            if (segments.index == k).any()
            else 0.0
            for k in range(len(segments))
        ]
    )
    found = joined_intervals(segments.edges_s, size > priors.ACTS_IN_STRETCH * size.max())
    if sum(b - a for a, b in found) > priors.ACTS_EVERYWHERE * track.duration_s:
        found = [(float(track.time_s[0]), float(track.time_s[-1]))]
    return tuple(found)


def _regime_text(track: Track, added: Array, setting: Setting) -> str | None:
    """`motor_current_a > 6`: the upper range of the covariate, where the effect adds most."""
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


def departure_intervals(
    edges_s: Array, series: Array, deviation: Array
) -> list[tuple[float, float]]:
    """Intervals in which a time series (J, axes) departs from the level that lasts longest.

    A segment departs if it is further away than `DEPARTED` of the largest departure and 3 standard
    deviations (J,).  Each interval is extended as far as the departure is visible
    (`extend_departures`).  The whole time is returned if no level lasts for 40 % of it.
    """
    length = np.diff(edges_s)
    distance = np.linalg.norm(series[:, None] - series[None], axis=2)
    largest = float(distance.max(initial=0.0))
    if largest == 0.0:
        return [(float(edges_s[0]), float(edges_s[-1]))]
    alike = distance <= np.maximum(
        priors.DEPARTED * largest, 3.0 * np.minimum.outer(deviation, deviation)
    )
    usual = alike @ length
    usual_segment = int(np.argmax(usual))
    if usual[usual_segment] < 0.4 * length.sum():
        return [(float(edges_s[0]), float(edges_s[-1]))]
    usual_course = np.average(series[alike[usual_segment]], axis=0)
    return joined_intervals(
        edges_s, extend_departures(~alike[usual_segment], series - usual_course, deviation)
    )


def extend_departures(inside: Array, series: Array, deviation: Array) -> Array:
    """(J,) `inside` (J,), with each interval extended by the segments that still depart likewise.

    A source that comes and goes slowly has no sharp beginning and end.  A segment therefore
    belongs to the interval as long as the time series (J, axes) is more than `STILL_DEPARTED`
    standard deviations (J,) away in the direction of the interval's mean.
    """
    out = np.asarray(inside, bool).copy()
    padded = np.concatenate([[False], out, [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    for start, end in zip(starts, ends, strict=True):
        mean = series[start:end].mean(axis=0)
        along = series @ mean / max(float(np.linalg.norm(mean)), 1e-300) / deviation
        before = np.flatnonzero(along[:start] <= priors.STILL_DEPARTED)
        after = np.flatnonzero(along[end:] <= priors.STILL_DEPARTED)
        out[before[-1] + 1 if len(before) else 0 : start] = True
        out[end : end + after[0] if len(after) else len(out)] = True
    return out


def joined_intervals(edges_s: Array, inside: NDArray[np.bool] | Array) -> list[tuple[float, float]]:
    """Joined (start, end) of the segments that are inside."""
    padded = np.concatenate([[False], np.asarray(inside, bool), [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    return [(float(edges_s[a]), float(edges_s[b])) for a, b in zip(starts, ends, strict=True)]
