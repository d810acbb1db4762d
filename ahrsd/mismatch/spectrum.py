"""At which frequency: lines in the periodogram of the whitened innovations (Fisher's g)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.samples import Array


@dataclass(frozen=True, slots=True)
class Line:
    """A line in the spectrum of one axis: its share of the axis' power and its probability."""

    frequency_hz: float
    axis: int
    share: float
    p_value: float


def lines(innovation: Array, rate_hz: float, p_limit: float = 1e-4) -> tuple[Line, ...]:
    """The strongest line of each axis (N, 3) that noise alone would show less often than p_limit.

    Fisher's test of the largest ordinate of n: p ~ n exp(-g n).  The spectrum is divided by its
    running median first, so coloured noise has no lines.
    """
    count = len(innovation)
    if count < 64:
        return ()
    taper = np.hanning(count)[:, None]
    power = np.abs(np.fft.rfft((innovation - innovation.mean(axis=0)) * taper, axis=0)) ** 2
    power = power[2:-1]
    frequency = np.fft.rfftfreq(count, 1.0 / rate_hz)[2:-1]
    found = []
    for axis in range(3):
        flat = power[:, axis] / (_running_median(power[:, axis], 101) / np.log(2.0))
        best = int(np.argmax(flat))
        p_value = min(1.0, 3.0 * len(flat) * float(np.exp(-flat[best])))
        if p_value < p_limit:
            near = power[max(0, best - 2) : best + 3, axis].sum() / power[:, axis].sum()
            found.append(Line(float(frequency[best]), axis, float(near), p_value))
    return tuple(sorted(found, key=lambda line: line.p_value))


def _running_median(values: Array, width: int) -> Array:
    """Median over `width` neighbours, coarse: of blocks half as wide, interpolated."""
    step = width // 2
    centres = np.arange(step, max(len(values) - step, step + 1), step)
    medians = [float(np.median(values[max(0, c - step) : c + step + 1])) for c in centres]
    return np.maximum(np.interp(np.arange(len(values)), centres, medians), 1e-300)
