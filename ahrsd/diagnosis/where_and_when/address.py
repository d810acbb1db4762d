"""Where a named term acts: when, on which axes, in which regime of what was logged."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Where
from ahrsd.diagnosis.columns.roles import shown
from ahrsd.diagnosis.effects.effect import Setting
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.where_and_when.intervals import spans
from ahrsd.diagnosis.where_and_when.locate import segments
from ahrsd.samples import Array

AXES = ("x", "y", "z")
_STRETCHES = 100
#: parts of the largest axis, and of the largest stretch, that count;  of the whole time, from where
#: on it is everywhere
_AXIS, _STRETCH, _EVERYWHERE = 0.2, 0.15, 0.6


def where_of(track: Track, added: Array, setting: Setting, frame: str) -> Where:
    """The address of a term that adds (N, 3) gauss or rad/s to the readings."""
    spread = np.sqrt(np.mean(added**2, axis=0))
    axes = tuple(AXES[k] for k in range(3) if spread[k] > _AXIS * spread.max())
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
    found = spans(cut.edges_s, size > _STRETCH * size.max())
    if sum(b - a for a, b in found) > _EVERYWHERE * track.duration_s:
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
        return f"{shown(str(name))} > {low:.3g}"
    below = high < float(np.median(values))
    return f"{shown(str(name))} < {high:.3g}" if below else f"follows {shown(str(name))}"
