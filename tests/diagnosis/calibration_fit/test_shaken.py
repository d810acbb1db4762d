"""A gyro's noise where the motion itself shakes: its differences say far too much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import shaking
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.calibration_fit.shaken import shaken
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
