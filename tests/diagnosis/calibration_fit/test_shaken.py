"""A gyro's noise where the motion itself shakes: its differences say far too much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import shaking, wobbling
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.calibration_fit.gyro_readings import shaken
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.track import Spec


@pytest.mark.parametrize("scenario", ["wam", "mam", "lam"])
@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 100.0])
def test_smooth_motion_is_not_shaken(scenario: str, rate_hz: float) -> None:
    for seed in range(3):
        made = experiment(scenario, seed=seed, samples=4000, rate_hz=rate_hz)
        assert not shaken(track_of(made))


@pytest.mark.parametrize("name", ["broad/01_undisturbed_slow_rotation_A", "vn100/drive_2022_rahul"])
@pytest.mark.recordings
def test_real_motion_is_shaken(name: str) -> None:
    assert shaken(recorded(name))


def test_what_else_is_wrong_is_not_taken_for_quiet() -> None:
    """Three minutes of a motor's field of 50 mG: the noise of the gyro is not found beside it."""
    track = shaking(4)
    mag = track.mag_b_gauss.copy()
    mag[:, 0] += 0.05 * np.sign(np.sin(2 * np.pi * track.time_s / 17.0))
    problem, _ = problem_of(replace(track, mag_b_gauss=mag), Spec())
    assert problem.spec.shaken_gyro_rad_s is None


def test_one_axis_that_a_propeller_shakes_says_nothing_of_the_gyro_s_noise() -> None:
    track = track_of(experiment("wam", seed=3, samples=6000, sigma_gyro=3e-4))
    rate = track.gyro_b_rad_s.copy()
    rate[:, 0] += 5e-3 * np.sin(2 * np.pi * 11.0 * track.time_s)
    assert noise_of_differences(replace(track, gyro_b_rad_s=rate))[1] == pytest.approx(
        3e-4, rel=0.15
    )


def test_where_the_averaged_rows_differ_by_their_motion_the_noise_is_that_of_the_recorded() -> None:
    sigma_gyro = 3e-4
    problem, _ = problem_of(wobbling(sigma_gyro), Spec())
    assert problem.thin > 1
    of_row = sigma_gyro / np.sqrt(problem.thin)
    assert noise_of_differences(problem.track)[1] > 2 * of_row
    assert problem.spec.sigma_gyro_rad_s == pytest.approx(of_row, rel=0.3)
