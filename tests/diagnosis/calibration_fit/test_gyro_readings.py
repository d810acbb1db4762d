"""Recognition of delta angles, and the gyro's noise level when the motion itself shakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import shaking, wobbling
from tracks import experiment, recorded, track_of

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.gyro_readings import is_shaken, with_delta_angles
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import cold_start
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array

_FINE = 50  # instants per step
_STEP_S = 0.05


def _tumbling(quick: float, samples: int = 6000) -> tuple[Array, Array, Array]:
    """Mean rates, rotation vectors over dt, and field (mG) of a motion of about `quick` rad/s."""
    fine_s = _STEP_S / _FINE
    t = np.arange(samples * _FINE) * fine_s
    rates = [(2.1, 0.3), (1.7, 1.1), (2.6, 2.0)]
    w = quick * np.stack([np.sin(f * quick * t + p) for f, p in rates], axis=1)
    turns = so3.exp(w * fine_s).reshape(samples, _FINE, 3, 3)
    step = turns[:, 0]
    for k in range(1, _FINE):
        step = step @ turns[:, k]
    field = np.empty((samples, 3))
    h = np.array([200.0, 60.0, 400.0])
    for k in range(samples):
        h = step[k].T @ h
        field[k] = h
    return w.reshape(samples, _FINE, 3).mean(axis=1), so3.log(step) / _STEP_S, field


def _track(rate: Array, field_mgauss: Array, seed: int = 4) -> Track:
    rng = np.random.default_rng(seed)
    time_s = np.arange(len(rate), dtype=np.float64) * _STEP_S
    dt = np.diff(time_s, prepend=np.nan)
    mag = 1e-3 * (field_mgauss + 50.0 + rng.normal(0, 0.6, rate.shape))
    gyro = rate + 0.01 + rng.normal(0, 3e-4, rate.shape)
    return Track(time_s, dt, mag, gyro, None, {}, (slice(0, len(rate)),))


def _with_delta_angles(track: Track) -> Track:
    return with_delta_angles(track, cold_start(track, Spec()))


def test_mean_rates_are_converted_to_delta_angles_when_tumbling() -> None:
    mean, exact, field = _tumbling(1.0)
    before = float(np.sqrt(np.mean((mean - exact) ** 2)))
    track = _track(mean, field)
    noise = track.gyro_b_rad_s - mean
    after = float(
        np.sqrt(np.mean((_with_delta_angles(track).gyro_b_rad_s - noise - exact)[1:] ** 2))
    )
    assert before > 1e-4  # as large as the noise: the difference would be detected
    assert after < 0.1 * before


def test_delta_angles_are_unchanged() -> None:
    _, exact, field = _tumbling(1.0)
    track = _track(exact, field)
    assert _with_delta_angles(track) is track


def test_rates_are_unchanged_when_the_motion_is_slow() -> None:
    mean, _, field = _tumbling(0.1)
    track = _track(mean, field)
    assert _with_delta_angles(track) is track


def test_gyro_scale_error_is_not_taken_for_mean_rates() -> None:
    _, exact, field = _tumbling(1.0)
    track = _track(exact * np.array([1.02, 0.99, 1.01]), field)
    assert _with_delta_angles(track) is track


def test_rates_are_unchanged_when_the_sensor_shakes_between_samples() -> None:
    """The neighbouring samples then do not determine the rate within a step."""
    mean, _, field = _tumbling(1.0)
    shaken = mean + np.random.default_rng(2).normal(0, 1.0, mean.shape)
    track = _track(shaken, field)
    assert _with_delta_angles(track) is track


@pytest.mark.parametrize("scenario", ["wam", "mam", "lam"])
@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 100.0])
def test_smooth_motion_is_not_classified_as_shaken(scenario: str, rate_hz: float) -> None:
    for seed in range(3):
        made = experiment(scenario, seed=seed, samples=4000, rate_hz=rate_hz)
        assert not is_shaken(track_of(made))


@pytest.mark.parametrize("name", ["broad/01_undisturbed_slow_rotation_A", "vn100/drive_2022_rahul"])
@pytest.mark.recordings
def test_real_motion_is_classified_as_shaken(name: str) -> None:
    assert is_shaken(recorded(name))


@pytest.mark.slow
def test_gyro_noise_is_not_estimated_when_a_large_disturbance_remains() -> None:
    """A motor's field of 50 mG during three minutes hides the noise of the gyro."""
    track = shaking(4)
    mag = track.mag_b_gauss.copy()
    mag[:, 0] += 0.05 * np.sign(np.sin(2 * np.pi * track.time_s / 17.0))
    problem, _ = build_problem(replace(track, mag_b_gauss=mag), Spec())
    assert problem.spec.shaken_gyro_rad_s is None


def test_vibration_of_one_axis_does_not_raise_the_gyro_noise_estimate() -> None:
    track = track_of(experiment("wam", seed=3, samples=6000, sigma_gyro=3e-4))
    rate = track.gyro_b_rad_s.copy()
    rate[:, 0] += 5e-3 * np.sin(2 * np.pi * 11.0 * track.time_s)
    assert noise_of_differences(replace(track, gyro_b_rad_s=rate))[1] == pytest.approx(
        3e-4, rel=0.15
    )


def test_gyro_noise_is_estimated_from_recorded_rows_when_averaged_rows_wobble() -> None:
    sigma_gyro = 3e-4
    problem, _ = build_problem(wobbling(sigma_gyro), Spec())
    assert problem.thin > 1
    of_row = sigma_gyro / np.sqrt(problem.thin)
    assert noise_of_differences(problem.track)[1] > 2 * of_row
    assert problem.spec.sigma_gyro_rad_s == pytest.approx(of_row, rel=0.3)
