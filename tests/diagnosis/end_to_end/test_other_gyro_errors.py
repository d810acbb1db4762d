"""Errors of the gyro that no effect of the library describes: unknown, in the gyro's frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    return made(Trial(seed=11, samples=7500, rate_hz=25.0, scenario="wam", noise="white")).track


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 8])
def test_temporary_gyro_bias_is_not_attributed_to_an_external_object(seed: int) -> None:
    """It was once taken for a passed field, or a step of the field, and a further cause."""
    quiet = made(Trial(seed=seed, samples=7500, rate_hz=25.0, scenario="mam", noise="white")).track
    inside = (quiet.time_s > 150.0) & (quiet.time_s < 190.0)
    spell = inside[:, None] * np.array([-1.7e-4, 2.0e-4, 1.4e-4])
    found = diagnose(replace(quiet, gyro_b_rad_s=quiet.gyro_b_rad_s + spell))
    assert found.findings == ()
    assert found.unexplained.where.frame == "gyro"
    (begin_s, end_s), *_ = found.unexplained.where.intervals_s
    assert begin_s == pytest.approx(150.0, abs=6.0)
    assert end_s == pytest.approx(190.0, abs=6.0)


@pytest.mark.slow
def test_scale_that_depends_on_the_sense_of_rotation_is_unknown(track: Track) -> None:
    added = np.abs(track.gyro_b_rad_s) * np.array([3e-3, -4e-3, 5e-3])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + added))
    assert found.findings == ()
    assert found.unexplained.detected


@pytest.mark.slow
def test_one_sided_gyro_scale_is_found_as_its_mean_with_an_unknown_of_the_gyro():
    track = made(Trial(8, samples=8_000, rate_hz=25.0)).track
    rate = track.gyro_b_rad_s
    uneven = rate + 0.004 * np.maximum(rate, 0.0)
    found = diagnose(replace(track, gyro_b_rad_s=uneven))
    (scale,) = found.findings
    assert {scale.effect, *(one.effect for one in scale.alternatives)} == {
        "clock_rate",
        "gyro_scale",
    }
    assert scale.parameters[0].value == pytest.approx(0.002, abs=2e-4)
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
    assert found.unexplained.evidence_nats > 15.0


@pytest.mark.slow
def test_bias_that_rises_and_falls_smoothly_is_not_steps():
    """Three steps that end at the initial value only show that the bias was temporary."""
    track = made(Trial(12, samples=8_000, rate_hz=25.0)).track
    part = np.clip((track.time_s - track.time_s[0] - 140.0) / 40.0, 0.0, 1.0)
    swell = np.sin(np.pi * part)[:, None] ** 2 * np.array([8e-4, 7e-4, -9e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + swell))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
