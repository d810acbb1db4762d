"""Recordings whose motion itself shakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import SIGMA_GYRO, SIGMA_MAG, shaking

from ahrsd.diagnosis.calibration_fit.gyro_readings import is_shaken
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Spec


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_noise_is_found_below_the_level_of_differences_when_shaken(seed: int) -> None:
    track = shaking(seed)
    assert is_shaken(track)
    problem, start = build_problem(track, Spec())
    assert problem.spec.shaken_gyro_rad_s is not None
    assert problem.spec.shaken_gyro_rad_s * np.sqrt(problem.thin) > 10 * SIGMA_GYRO
    assert 0.6 < start.sigma_gyro_rad_s * np.sqrt(problem.thin) / SIGMA_GYRO < 1.6
    assert 0.95 < start.sigma_mag_gauss * np.sqrt(problem.averaged) / SIGMA_MAG < 1.05
    assert not diagnose(track).mismatch


@pytest.mark.slow
def test_bias_step_is_found_when_shaken() -> None:
    track = shaking(3)
    gyro = track.gyro_b_rad_s.copy()
    gyro[6000:, 1] += 4e-4
    found = diagnose(replace(track, gyro_b_rad_s=gyro)).findings
    assert [one.effect for one in found] == ["gyro_bias_step"]
    assert abs(found[0].where.intervals_s[0][0] - 150.0) < 10.0
