"""Samples taken early and late and stamped well, and samples of a regular clock stamped badly."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.diagnosis.data_quality.facts import matters
from ahrsd.diagnosis.data_quality.preparation import put_right
from ahrsd.diagnosis.data_quality.timestamps import stamps
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

_STEP_S = 0.025
_SAMPLES = 4000


def _uneven(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.arange(_SAMPLES, dtype=np.float64) * _STEP_S + rng.normal(0, 0.1 * _STEP_S, _SAMPLES)


def _track(
    taken_s: Array, stamped_s: Array, *, unit: float = 1.0, most_rad_s: float = 0.5,
    sigma_gauss: float = 1e-3,
) -> Track:  # fmt: skip
    """A sensor that turns by its rate times the steps at which it was read."""
    steps = np.diff(taken_s, prepend=taken_s[0])
    phases = np.stack([0.7 * taken_s, 1.0 + 0.9 * taken_s, 2.0 + 0.4 * taken_s], axis=1)
    rate = most_rad_s * np.sin(phases)
    h = np.array([0.2, 0.1, 0.4])
    field = np.empty((_SAMPLES, 3))
    for k, turn in enumerate(so3.exp(rate * steps[:, None])):
        h = turn.T @ h
        field[k] = h
    rng = np.random.default_rng(9)
    mag = field + 0.05 + rng.normal(0, sigma_gauss, field.shape)
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


def test_jitter_too_small_to_be_told_is_put_right_where_the_field_shows_it() -> None:
    # a hundredth of a step: beside turns of 4 rad/s it is 40 mrad/s of the rate
    quick = {"most_rad_s": 4.0, "sigma_gauss": 2e-4}
    even = np.arange(_SAMPLES, dtype=np.float64) * _STEP_S
    stamped = even + np.random.default_rng(1).normal(0, 0.01 * _STEP_S, _SAMPLES)
    track = _track(even, stamped, **quick)
    (fact,) = stamps(track)
    assert fact.parameters[0].value == pytest.approx(0.01 * _STEP_S, rel=0.05)
    assert not matters(fact)
    right = put_right(track, (fact,)).dt_s[1:]
    assert np.max(np.abs(right - _STEP_S)) < 1e-4 * _STEP_S
    # taken at those times and stamped well: left as it is
    assert stamps(_track(stamped, stamped, **quick)) == []
