"""The unknown that has no course: it is told, and in which frame."""

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.one_model.diagnose import diagnose


@pytest.mark.slow
def test_a_gyro_that_turns_more_to_one_side_is_an_unknown_of_the_gyro():
    track = made(Trial(8, samples=8_000, rate_hz=25.0)).track
    rate = track.gyro_b_rad_s
    uneven = rate + 0.004 * np.maximum(rate, 0.0)
    found = diagnose(replace(track, gyro_b_rad_s=uneven))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
    assert found.unexplained.evidence_nats > 15.0


@pytest.mark.slow  # a shorter form: test_rivals
def test_a_bias_that_swells_and_fades_is_no_steps():
    """Three steps that end where they began say nothing but that it came and went."""
    track = made(Trial(12, samples=8_000, rate_hz=25.0)).track
    part = np.clip((track.time_s - track.time_s[0] - 140.0) / 40.0, 0.0, 1.0)
    swell = np.sin(np.pi * part)[:, None] ** 2 * np.array([8e-4, 7e-4, -9e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + swell))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
