"""Smooth functions of time as sums of sines and smooth steps; derivatives are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sine:
    """amplitude * sin(2 pi frequency t + phase)."""

    amplitude: float
    frequency_hz: float
    phase: float

    def at(self, t):
        """Value, first and second derivative."""
        omega = 2 * np.pi * self.frequency_hz
        s, c = np.sin(omega * t + self.phase), np.cos(omega * t + self.phase)
        return (
            self.amplitude * s,
            self.amplitude * omega * c,
            -self.amplitude * omega**2 * s,
        )


@dataclass(frozen=True)
class Rise:
    """From 0 to `amount` between start and start + length, three times differentiable."""

    amount: float
    start_s: float
    length_s: float

    def at(self, t):
        """Value, first and second derivative."""
        x = np.clip((t - self.start_s) / self.length_s, 0.0, 1.0)
        value = x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)
        first = 140 * x**3 * (1 - x) ** 3
        second = 420 * x**2 * (1 - x) ** 2 * (1 - 2 * x)
        a = self.amount
        return a * value, a * first / self.length_s, a * second / self.length_s**2


@dataclass(frozen=True)
class Line:
    """offset + slope t."""

    offset: float
    slope: float = 0.0

    def at(self, t):
        """Value, first and second derivative."""
        return self.offset + self.slope * t, np.full_like(t, self.slope), np.zeros_like(t)


@dataclass(frozen=True)
class Curve:
    """A sum of parts."""

    parts: tuple

    def at(self, t):
        """Value, first and second derivative, each (N,)."""
        value, first, second = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        for part in self.parts:
            v, f, s = part.at(t)
            value, first, second = value + v, first + f, second + s
        return value, first, second


def wave(rng, amplitude, low_hz, high_hz, parts=3):
    """A Curve of incommensurate sines; the first one has most of the amplitude."""
    shares = np.array([1.0, 0.3, 0.15][:parts])
    shares = shares / shares.sum()
    frequency = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz)))
    ratios = (1.0, 1.618 * rng.uniform(0.9, 1.1), 2.414 * rng.uniform(0.9, 1.1))
    return Curve(
        tuple(
            Sine(amplitude * share, frequency * ratio, rng.uniform(0, 2 * np.pi))
            for share, ratio in zip(shares, ratios)
        )
    )
