"""A random walk of the gyro bias beyond the ordinary is found; another time course is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.fixture(scope="module")
def track():
    return made(Trial(seed=11, samples=7500, rate_hz=25.0, scenario="wam", noise="white")).track


@pytest.mark.slow
def test_large_bias_random_walk_is_found_without_residual(track):
    steps = np.random.default_rng(3).normal(size=(len(track), 3)) * np.sqrt(0.04)
    walked = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + 4e-5 * np.cumsum(steps, axis=0))
    found = diagnose(walked)
    assert [one.effect for one in found.findings] == ["gyro_bias_drift"]
    assert not found.unexplained.detected


@pytest.mark.slow  # a short one: inference/test_diagnose
@pytest.mark.parametrize(
    ("seed", "size"),
    [
        # the few modes of the effect explain a tenth of what a larger walk of the filter gains
        (19, 1.2e-5),
        # if the filter's walk is that of an ordinary bias, the residual does not look like a walk
        (21, 2.6e-5),
    ],
)
def test_random_walk_is_found_when_the_modes_of_the_effect_hardly_describe_it(track, seed, size):
    steps = np.random.default_rng(seed).normal(size=(len(track), 3)) * np.sqrt(0.04)
    walked = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + size * np.cumsum(steps, axis=0))
    found = diagnose(walked)
    assert [one.effect for one in found.findings] == ["gyro_bias_drift"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_oscillating_bias_is_not_a_random_walk(track):
    swing = 6e-4 * np.sin(2 * np.pi * track.time_s / 37.0)[:, None] * np.array([1.0, -0.5, 0.7])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + swing))
    assert "gyro_bias_drift" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"


@pytest.mark.slow
def test_bias_step_and_startup_are_not_a_random_walk(track):
    """Both explain with three numbers what a random walk needs all its freedom for."""
    onset_s = 0.4 * (track.time_s[0] + track.time_s[-1])
    jump = np.where(track.time_s > onset_s, 1.0, 0.0)[:, None] * np.array([4e-4, -3e-4, 2e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + jump))
    assert [one.effect for one in found.findings] == ["gyro_bias_step"]
    assert found.findings[0].where.intervals_s[0][0] == pytest.approx(onset_s, abs=3.0)
    warm = np.exp(-(track.time_s - track.time_s[0]) / 30.0)[:, None] * np.array([9e-4, 6e-4, -6e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + warm))
    assert [one.effect for one in found.findings] == ["gyro_startup"]


@pytest.mark.slow
def test_small_startup_is_more_probable_than_a_random_walk(track):
    """5.7 nats over the modes of a walk, 21 over the filter's own walk; a smaller one was once
    taken for noise.
    """
    warm = np.exp(-(track.time_s - track.time_s[0]) / 120.0)[:, None]
    cold = 3e-4 * np.array([0.6, 0.5, -0.62])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + warm * cold))
    assert [one.effect for one in found.findings] == ["gyro_startup"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_ordinary_random_walk_gives_no_other_finding(track):
    steps = np.random.default_rng(4).normal(size=(len(track), 3)) * np.sqrt(0.04)
    walked = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + 5e-6 * np.cumsum(steps, axis=0))
    assert {one.effect for one in diagnose(walked).findings} <= {"gyro_bias_drift"}


@pytest.mark.slow
def test_small_gyro_scale_is_found_with_a_random_walk(track):
    steps = np.random.default_rng(3).normal(size=(len(track), 3)) * np.sqrt(0.04)
    scaled = track.gyro_b_rad_s * np.array([1.004, 0.997, 1.005])
    walked = replace(track, gyro_b_rad_s=scaled + 4e-5 * np.cumsum(steps, axis=0))
    found = diagnose(walked)
    assert {one.effect for one in found.findings} == {"gyro_bias_drift", "gyro_scale"}
    assert all(one.confidence > 0.5 for one in found.findings)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_soft_iron_step_is_found_with_a_large_random_walk(seed):
    """A walk of 1e-4 hides the iron. Once only a free process was found, or a height and the
    earth's rotation.

    The residual without the walk appears in the sensor, not in the gyro.
    """
    trial = Trial(seed=11, samples=7500, rate_hz=25.0, scenario="wam", noise="white")
    iron = made(replace(trial, effects=(("soft_iron_step", 1.0),))).track
    steps = np.random.default_rng(seed).normal(size=(len(iron), 3)) * np.sqrt(0.04)
    walked = replace(iron, gyro_b_rad_s=iron.gyro_b_rad_s + 1e-4 * np.cumsum(steps, axis=0))
    found = diagnose(walked)
    assert {one.effect for one in found.findings} == {"gyro_bias_drift", "soft_iron_step"}
    assert not found.unexplained.detected
