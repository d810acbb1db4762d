"""A gyro's noise where the motion itself shakes: its differences say far too much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, recorded, track_of

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.calibration_fit.shaken import shaken
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.track import Spec, Track

SIGMA_MAG, SIGMA_GYRO = 6e-4, 1e-3


def shaking(seed: int, *, jitter_rad_s: float = 0.05) -> Track:
    """Five minutes of turning by hand, which trembles in three of four spells of six seconds."""
    rng = np.random.default_rng(seed)
    count, rate_hz = 12_000, 40.0
    time_s = np.arange(count) / rate_hz
    slow = np.cumsum(rng.normal(size=(count // 40 + 2, 3)), axis=0)
    slow = 0.5 * (slow - slow.mean(axis=0)) / slow.std(axis=0)
    knots = np.arange(len(slow)) * 40 / rate_hz
    rate = np.column_stack([np.interp(time_s, knots, one) for one in slow.T])
    on = np.repeat(rng.random(count // 240) < 0.75, 240)
    rate += jitter_rad_s * on[:, None] * rng.normal(size=(count, 3))
    turn = so3.exp(rate / rate_hz)
    field_b = np.empty((count, 3))
    R_nb = np.eye(3)
    for k in range(count):
        R_nb = R_nb @ turn[k]
        field_b[k] = R_nb.T @ [0.2, 0.05, 0.45]
    A = np.array([[1.03, 0.02, -0.01], [0.02, 0.96, 0.01], [-0.01, 0.01, 1.01]])
    mag = field_b @ A + [0.05, -0.08, 0.03] + SIGMA_MAG * rng.normal(size=(count, 3))
    gyro = rate + [2e-3, -1e-3, 1.5e-3] + SIGMA_GYRO * rng.normal(size=(count, 3))
    dt_s = np.r_[np.nan, np.diff(time_s)]
    return Track(time_s, dt_s, mag, gyro, None, {}, (slice(0, count),))


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


@pytest.mark.parametrize("seed", [1, 2])
def test_the_noise_is_found_below_what_differences_say(seed: int) -> None:
    track = shaking(seed)
    assert shaken(track)
    problem, start = problem_of(track, Spec(), EFFECTS, LIMITS)
    assert problem.spec.shaken_gyro_rad_s is not None
    assert problem.spec.shaken_gyro_rad_s * np.sqrt(problem.thin) > 10 * SIGMA_GYRO
    assert 0.6 < start.sigma_gyro_rad_s * np.sqrt(problem.thin) / SIGMA_GYRO < 1.6
    assert 0.95 < start.sigma_mag_gauss * np.sqrt(problem.averaged) / SIGMA_MAG < 1.05
    assert not diagnose(track).mismatch


def test_a_bias_that_jumps_is_seen_through_the_shaking() -> None:
    track = shaking(3)
    gyro = track.gyro_b_rad_s.copy()
    gyro[6000:, 1] += 4e-4
    found = diagnose(replace(track, gyro_b_rad_s=gyro)).findings
    assert [one.effect for one in found] == ["gyro_bias_step"]
    assert abs(found[0].where.intervals_s[0][0] - 150.0) < 10.0


def test_what_else_is_wrong_is_not_taken_for_quiet() -> None:
    """Three minutes of a motor's field of 50 mG: the noise of the gyro is not found beside it."""
    track = shaking(4)
    mag = track.mag_b_gauss.copy()
    mag[:, 0] += 0.05 * np.sign(np.sin(2 * np.pi * track.time_s / 17.0))
    problem, _ = problem_of(replace(track, mag_b_gauss=mag), Spec(), EFFECTS, LIMITS)
    assert problem.spec.shaken_gyro_rad_s is None
