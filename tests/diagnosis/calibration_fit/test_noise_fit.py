"""Noise levels from differences, and from the likelihood of the innovations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.track import Spec


def test_noise_of_differences_recovers_the_true_levels() -> None:
    mag, gyro = noise_of_differences(track_of(experiment("lam", samples=4000, sigma_gyro=2e-3)))
    assert abs(mag / 1e-3 - 1) < 0.06
    assert abs(gyro / 2e-3 - 1) < 0.06


@pytest.mark.slow
def test_gyro_noise_fit_does_not_absorb_a_bias_drift() -> None:
    """Without a bound sigma_gyro would grow until the drift counts as noise."""
    made = experiment(samples=3000)
    track = track_of(made)
    ramp = np.linspace(-1, 1, 3000)[:, None] * np.array([3e-3, -2e-3, 4e-3])
    fit = fit_null(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + ramp))
    assert fit.model.sigma_gyro_rad_s <= 1.5 * noise_of_differences(track)[1] * 1.01
    assert fit.model.gyro_walk_rad_s_sqrt_s <= priors.WALK_CAP_RAD_S_SQRT_S * 1.01


def test_noise_levels_given_in_the_spec_are_kept() -> None:
    track = track_of(experiment(samples=3000))
    fit = fit_null(track, Spec(sigma_mag_gauss=2e-3, sigma_gyro_rad_s=7e-4))
    assert fit.model.sigma_mag_gauss == 2e-3
    assert fit.model.sigma_gyro_rad_s == 7e-4
    half = fit_null(track, Spec(sigma_gyro_rad_s=7e-4))
    assert half.model.sigma_gyro_rad_s == 7e-4
    assert abs(half.model.sigma_mag_gauss / 1e-3 - 1) < 0.06
