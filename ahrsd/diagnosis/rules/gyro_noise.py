"""A gyro whose noise is louder for a while, where that is all that an unknown is.

Noise of the rate adds up: while it is loud the field wanders off as if something in the world had
moved it.  The gyro itself tells: the second differences of its readings hold no motion to speak of,
and those of white noise go to and fro.  Asked only where an unknown is to be told, and believed
only where the unknown is there while the gyro is loud: a shaken vehicle's gyro is loud, too.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Unexplained, Value, Where
from ahrsd.diagnosis.data_quality.facts import Fact, spans_of
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

_BLOCK_S = 1.0
_LOUD = 4.0  # times the usual variance
_MOST_SHARE = 0.4  # of the recording; beyond, there is no usual level
_INSIDE = 0.7  # of an unknown's time
#: correlation of successive second differences, -2/3 of white noise, at most
_OPPOSED = -0.55
_POWER = 6.0  # of a second difference of white noise of unit power


def loud_gyro(left: Unexplained, track: Track) -> Fact | None:
    """The gyro's burst of noise in which the unknown is; None where there is none."""
    if not left.detected or left.where is None or len(track) < 100:
        return None
    bend = np.diff(np.nan_to_num(track.gyro_b_rad_s), n=2, axis=0)
    whole = np.isfinite(track.dt_s[1:-1]) & np.isfinite(track.dt_s[2:])
    power = np.where(whole, np.sum(bend**2, axis=1), 0.0)
    block = ((track.time_s[1:-1] - track.time_s[0]) / _BLOCK_S).astype(int)
    size = np.bincount(block, weights=whole.astype(float))
    level = np.bincount(block, weights=power) / np.maximum(3.0 * _POWER * size, 1.0)
    usual = float(np.median(level[size > 0]))
    loud = (level > _LOUD * usual) & (size > 0)
    if not loud.any() or loud.mean() > _MOST_SHARE or usual <= 0.0:
        return None
    first_s = float(track.time_s[0])
    spans = [(first_s + a * _BLOCK_S, first_s + b * _BLOCK_S) for a, b in spans_of(loud, 1)]
    if _inside(left.where.intervals_s, spans) < _INSIDE or not _white(bend[loud[block] & whole]):
        return None
    sigma = float(np.sqrt(np.average(level[loud], weights=size[loud]) - usual))
    times = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in spans)
    ratio = np.sqrt(1.0 + sigma**2 / usual)
    begin, end = spans[0]
    return Fact(
        "noise_burst",
        f"from {times} s the gyro's noise is {ratio:.2g} times its usual level",
        Where(tuple(spans), ("x", "y", "z"), "noise"),
        0.98,
        (Value("gyro", sigma, sigma * 0.1, "rad/s"),),
        {"onset_s": begin, "length_s": end - begin},
    )


def _inside(inner: tuple[tuple[float, float], ...], outer: list[tuple[float, float]]) -> float:
    """Share of the time of spans that is within others."""
    both = sum(max(0.0, min(b, d) - max(a, c)) for a, b in inner for c, d in outer)
    return both / max(sum(b - a for a, b in inner), 1e-9)


def _white(bend: Array) -> bool:
    """Whether second differences (n, 3) go to and fro as those of white noise do, on every axis."""
    power = np.sum(bend**2, axis=0)
    return bool(np.all(np.sum(bend[1:] * bend[:-1], axis=0) < _OPPOSED * power))
