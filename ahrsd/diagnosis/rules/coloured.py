"""White and slow noise as a law of its spectrum, rather than as one figure for its colour.

A magnetometer's slow noise forgets within a second or so: at frequency f it has 1 / (1 + (2 pi f
t)^2) of its power at zero.  What is slower than can be measured beside an effect follows from the
form.  Along the field the filter remembers noise for longer than across it, so each has a law.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.samples import Array

#: times within which noise forgets; what remembers for longer is a course
TIMES_S = np.geomspace(0.1, 3.0, 12)
#: power of the slow noise at frequency zero, over the white one's
SLOW = np.concatenate([[0.0], np.geomspace(0.1, 1000.0, 33)])


@dataclass(frozen=True, slots=True)
class Law:
    """White noise of power `white`, and `slow` times that, at frequency zero, that forgets."""

    white: float
    slow: float
    time_s: float

    def power(self, frequency_hz: Array) -> Array:
        """Power at these frequencies."""
        return np.asarray(self.white * (1.0 + self.slow * _shape(frequency_hz, self.time_s)))


@dataclass(frozen=True, slots=True, eq=False)
class Coloured:
    """Noise along and across a direction that changes, unit (N, 3); rows as evenly spaced."""

    along: Law
    across: Law
    unit: Array
    rate_hz: float

    def whitened(self, values: Array) -> Array:
        """Of (N, 3) or (N, 3, p), so that this noise becomes white and of power one."""
        cube = values.reshape(len(values), 3, -1)
        part = np.einsum("ni,nip->np", self.unit, cube)
        rest = cube - self.unit[:, :, None] * part[:, None, :]
        frequency_hz = np.asarray(np.fft.rfftfreq(len(values), 1.0 / self.rate_hz), np.float64)
        part = _filtered(part, self.along.power(frequency_hz) ** -0.5)
        rest = _filtered(rest, self.across.power(frequency_hz) ** -0.5)
        return np.asarray(rest + self.unit[:, :, None] * part[:, None, :]).reshape(values.shape)


def coloured(left: Array, unit: Array, rate_hz: float, least_hz: float) -> Coloured:
    """The noise in what is left (N, 3), along the directions unit (N, 3) and across them.

    least_hz: frequencies below this say nothing of it
    """
    part = np.sum(left * unit, axis=1, keepdims=True)
    frequency_hz = np.fft.rfftfreq(len(left), 1.0 / rate_hz)
    seen = frequency_hz >= max(least_hz, frequency_hz[1])

    def law(values: Array, axes: int) -> Law:
        density = np.sum(np.abs(np.fft.rfft(values, axis=0)) ** 2, axis=1) / (len(left) * axes)
        return likeliest(frequency_hz[seen], density[seen])

    return Coloured(law(part, 1), law(left - part * unit, 2), unit, rate_hz)


def likeliest(frequency_hz: Array, density: Array) -> Law:
    """The law of a periodogram (F,), by Whittle's likelihood."""
    best, found = np.inf, Law(1.0, 0.0, float(TIMES_S[0]))
    for time_s in TIMES_S:
        shape = 1.0 + SLOW[:, None] * _shape(frequency_hz, float(time_s))
        white = np.mean(density / shape, axis=1)
        loss = np.log(white) + np.mean(np.log(shape), axis=1)
        k = int(np.argmin(loss))
        if loss[k] < best:
            best, found = float(loss[k]), Law(float(white[k]), float(SLOW[k]), float(time_s))
    return found


def _shape(frequency_hz: Array, time_s: float) -> Array:
    return np.asarray(1.0 / (1.0 + np.square(2.0 * np.pi * frequency_hz * time_s)))


def _filtered(values: Array, gain: Array) -> Array:
    gain = gain.reshape(-1, *([1] * (values.ndim - 1)))
    return np.asarray(np.fft.irfft(np.fft.rfft(values, axis=0) * gain, n=len(values), axis=0))
