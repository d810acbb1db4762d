"""Which recordings have delta angles, and a gyro's noise where the motion itself shakes."""

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
    """Of a motion of about `quick` rad/s: mean rates, rotation vectors over dt, field (mG)."""
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


def _told(track: Track) -> Track:
    return with_delta_angles(track, cold_start(track, Spec()))


def test_mean_rates_of_a_tumbling_sensor_become_turns_of_the_steps() -> None:
    mean, exact, field = _tumbling(1.0)
    before = float(np.sqrt(np.mean((mean - exact) ** 2)))
    track = _track(mean, field)
    noise = track.gyro_b_rad_s - mean
    after = float(np.sqrt(np.mean((_told(track).gyro_b_rad_s - noise - exact)[1:] ** 2)))
    assert before > 1e-4  # as much as the noise: it would be seen
    assert after < 0.1 * before


def test_delta_angles_stay_as_they_are() -> None:
    _, exact, field = _tumbling(1.0)
    track = _track(exact, field)
    assert _told(track) is track


def test_where_the_motion_is_slow_nothing_is_done() -> None:
    mean, _, field = _tumbling(0.1)
    track = _track(mean, field)
    assert _told(track) is track


def test_a_gyro_of_the_wrong_scale_is_not_taken_for_mean_rates() -> None:
    _, exact, field = _tumbling(1.0)
    track = _track(exact * np.array([1.02, 0.99, 1.01]), field)
    assert _told(track) is track


def test_rates_that_do_not_follow_the_motion_are_left_alone() -> None:
    """A body that shakes between the samples: the neighbours say nothing of a step."""
    mean, _, field = _tumbling(1.0)
    shaken = mean + np.random.default_rng(2).normal(0, 1.0, mean.shape)
    track = _track(shaken, field)
    assert _told(track) is track


@pytest.mark.parametrize("scenario", ["wam", "mam", "lam"])
@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 100.0])
def test_smooth_motion_is_not_shaken(scenario: str, rate_hz: float) -> None:
    for seed in range(3):
        made = experiment(scenario, seed=seed, samples=4000, rate_hz=rate_hz)
        assert not is_shaken(track_of(made))


@pytest.mark.parametrize("name", ["broad/01_undisturbed_slow_rotation_A", "vn100/drive_2022_rahul"])
@pytest.mark.recordings
def test_real_motion_is_shaken(name: str) -> None:
    assert is_shaken(recorded(name))


@pytest.mark.slow
def test_what_else_is_wrong_is_not_taken_for_quiet() -> None:
    """Three minutes of a motor's field of 50 mG: the noise of the gyro is not found beside it."""
    track = shaking(4)
    mag = track.mag_b_gauss.copy()
    mag[:, 0] += 0.05 * np.sign(np.sin(2 * np.pi * track.time_s / 17.0))
    problem, _ = build_problem(replace(track, mag_b_gauss=mag), Spec())
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
    problem, _ = build_problem(wobbling(sigma_gyro), Spec())
    assert problem.thin > 1
    of_row = sigma_gyro / np.sqrt(problem.thin)
    assert noise_of_differences(problem.track)[1] > 2 * of_row
    assert problem.spec.sigma_gyro_rad_s == pytest.approx(of_row, rel=0.3)
