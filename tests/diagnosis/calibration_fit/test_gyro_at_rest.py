"""Bias drift of a gyro at rest: found when the bias changes, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import COUNT, RATE_HZ, standing, warming

from ahrsd.diagnosis.calibration_fit.gyro_at_rest import find_bias_drift_at_rest
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.track import Track


def drift_findings(track: Track):
    return find_bias_drift_at_rest(fit_null(track, walk=False).context(), EFFECTS)


@pytest.mark.parametrize(
    "seed", [4, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (5, 6))]
)
def test_no_drift_is_reported_for_an_ordinary_random_walk(seed: int):
    steps = np.random.default_rng(seed).normal(0.0, 4e-6 / np.sqrt(RATE_HZ), (COUNT, 3))
    assert drift_findings(standing(1e-3 + np.cumsum(steps, axis=0), warming(), seed)) == ()


def test_temperature_dependent_bias_is_found_with_its_slope():
    warmth = warming()
    slope = np.array([5e-5, -2e-5, -1.5e-4])
    (found,) = drift_findings(standing(1e-3 + (warmth - 12.0)[:, None] * slope, warmth))
    assert found.effect == "gyro_bias_temperature"
    assert found.where.frame == "gyro"
    np.testing.assert_allclose([p.value for p in found.parameters], slope, atol=3e-5)
    assert found.heldout is None


def test_same_bias_is_reported_as_drift_without_a_temperature_column():
    slope = np.array([5e-5, -2e-5, -1.5e-4])
    (found,) = drift_findings(standing(1e-3 + (warming() - 12.0)[:, None] * slope))
    names = {found.effect, *(share.effect for share in found.alternatives)}
    assert "gyro_bias_drift" in names
    assert "gyro_bias_temperature" not in names
    assert found.confidence + sum(s.confidence for s in found.alternatives) == pytest.approx(
        1, abs=0.02
    )


@pytest.mark.slow
def test_slow_turns_on_a_straight_course_are_not_taken_for_rest():
    passed = np.arange(COUNT) / RATE_HZ
    rate = 1e-3 * np.cos(2 * np.pi * passed / 290.0)[:, None] * np.array([1.0, -0.6, 0.8])
    track = standing(1e-3 + rate)
    assert drift_findings(track), "the same readings at rest are a bias that moves"
    angle = np.cumsum(rate, axis=0) / RATE_HZ
    field = track.mag_b_gauss + np.cross(np.array([0.2, 0.05, 0.4]), angle)
    assert drift_findings(replace(track, mag_b_gauss=field)) == ()
