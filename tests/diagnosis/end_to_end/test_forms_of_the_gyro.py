"""Errors of the gyro that no name has: unknown, in its frame."""

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
def test_a_gyro_that_is_off_for_a_while_is_no_object_outside(seed: int) -> None:
    """It was a field that the vehicle passed, or a jump of the field, and something else beside."""
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
def test_a_scale_that_differs_between_the_senses_of_rotation_has_no_name(track: Track) -> None:
    added = np.abs(track.gyro_b_rad_s) * np.array([3e-3, -4e-3, 5e-3])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + added))
    assert found.findings == ()
    assert found.unexplained.detected


@pytest.mark.slow
def test_a_gyro_that_turns_more_to_one_side_has_its_mean_scale_and_an_unknown_of_the_gyro():
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
def test_a_bias_that_swells_and_fades_is_no_steps():
    """Three steps that end where they began say nothing but that it came and went."""
    track = made(Trial(12, samples=8_000, rate_hz=25.0)).track
    part = np.clip((track.time_s - track.time_s[0] - 140.0) / 40.0, 0.0, 1.0)
    swell = np.sin(np.pi * part)[:, None] ** 2 * np.array([8e-4, 7e-4, -9e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + swell))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
