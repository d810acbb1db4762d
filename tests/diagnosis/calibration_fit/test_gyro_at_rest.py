"""A gyro that stands: what moves its bias, and nothing where nothing does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import COUNT, RATE_HZ, standing, warming

from ahrsd.diagnosis.calibration_fit.gyro_at_rest import find_bias_drift_at_rest
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.track import Track


def told(track: Track):
    return find_bias_drift_at_rest(fit_null(track, walk=False).context(), EFFECTS)


@pytest.mark.parametrize(
    "seed", [4, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (5, 6))]
)
def test_nothing_is_said_of_a_bias_that_stays_or_wanders_as_an_ordinary_one(seed: int):
    steps = np.random.default_rng(seed).normal(0.0, 4e-6 / np.sqrt(RATE_HZ), (COUNT, 3))
    assert told(standing(1e-3 + np.cumsum(steps, axis=0), warming(), seed)) == ()


def test_a_bias_that_follows_the_temperature_is_named_with_its_slope():
    warmth = warming()
    slope = np.array([5e-5, -2e-5, -1.5e-4])
    (found,) = told(standing(1e-3 + (warmth - 12.0)[:, None] * slope, warmth))
    assert found.effect == "gyro_bias_temperature"
    assert found.where.frame == "gyro"
    np.testing.assert_allclose([p.value for p in found.parameters], slope, atol=3e-5)
    assert found.heldout is None


def test_without_a_thermometer_the_same_bias_drifts():
    slope = np.array([5e-5, -2e-5, -1.5e-4])
    (found,) = told(standing(1e-3 + (warming() - 12.0)[:, None] * slope))
    names = {found.effect, *(share.effect for share in found.alternatives)}
    assert "gyro_bias_drift" in names
    assert "gyro_bias_temperature" not in names
    assert found.confidence + sum(s.confidence for s in found.alternatives) == pytest.approx(
        1, abs=0.02
    )


@pytest.mark.slow
def test_a_vehicle_that_turns_a_little_on_its_straight_course_does_not_stand():
    passed = np.arange(COUNT) / RATE_HZ
    rate = 1e-3 * np.cos(2 * np.pi * passed / 290.0)[:, None] * np.array([1.0, -0.6, 0.8])
    track = standing(1e-3 + rate)
    assert told(track), "the same readings at rest are a bias that moves"
    angle = np.cumsum(rate, axis=0) / RATE_HZ
    field = track.mag_b_gauss + np.cross(np.array([0.2, 0.05, 0.4]), angle)
    assert told(replace(track, mag_b_gauss=field)) == ()
