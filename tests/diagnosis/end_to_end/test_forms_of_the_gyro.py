"""Errors of the gyro that no name has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.one_model.diagnose import diagnose
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
