"""Samples taken early and late and stamped well, and samples of a regular clock stamped badly."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.diagnosis.stamps import stamps
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

_STEP_S = 0.025
_SAMPLES = 4000


def _uneven(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.arange(_SAMPLES, dtype=np.float64) * _STEP_S + rng.normal(0, 0.1 * _STEP_S, _SAMPLES)


def _track(taken_s: Array, stamped_s: Array, *, unit: float = 1.0) -> Track:
    """A sensor that turns by its rate times the steps at which it was read."""
    steps = np.diff(taken_s, prepend=taken_s[0])
    rate = 0.5 * np.sin(np.stack([0.7 * taken_s, 1.0 + 0.9 * taken_s, 2.0 + 0.4 * taken_s], axis=1))
    h = np.array([0.2, 0.1, 0.4])
    field = np.empty((_SAMPLES, 3))
    for k, turn in enumerate(so3.exp(rate * steps[:, None])):
        h = turn.T @ h
        field[k] = h
    rng = np.random.default_rng(9)
    mag = field + 0.05 + rng.normal(0, 1e-3, field.shape)
    gyro = unit * (rate + rng.normal(0, 5e-4, rate.shape))
    dt = np.diff(stamped_s, prepend=np.nan)
    return Track(stamped_s, dt, mag, gyro, None, {}, (slice(0, _SAMPLES),))


@pytest.mark.parametrize("unit", [1.0, 57.29578])
def test_samples_taken_unevenly_and_stamped_well_are_no_jitter(unit: float) -> None:
    taken = _uneven(1)
    assert stamps(_track(taken, taken, unit=unit)) == []


@pytest.mark.parametrize("unit", [1.0, 57.29578])
def test_samples_of_a_regular_clock_stamped_unevenly_are(unit: float) -> None:
    (fact,) = stamps(_track(np.arange(_SAMPLES, dtype=np.float64) * _STEP_S, _uneven(1), unit=unit))
    assert fact.effect == "timestamp_jitter"
    assert fact.parameters[0].value == pytest.approx(0.1 * _STEP_S, rel=0.05)
