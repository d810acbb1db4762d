"""The simulated experiments: what they promise about truth, signs, timing and seeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from true_trajectory import predicted_directions

from ahrsd import so3
from ahrsd.heading import tilt_compensated_heading
from ahrsd.simulation import Iron, ScenarioSettings, simulate
from ahrsd.simulation.scenarios import (
    MOTIONS,
    SCENARIOS,
    SUBSTEPS,
    generator,
    mean_rate,
    sinusoids,
)

SETS = [(scenario, motion) for scenario in SCENARIOS for motion in MOTIONS]


def angles(R_nb):
    """Roll, pitch, heading (N, 3) of rotations within 90 degrees of pitch."""
    return np.column_stack(
        [
            np.arctan2(R_nb[:, 2, 1], R_nb[:, 2, 2]),
            -np.arcsin(R_nb[:, 2, 0]),
            np.arctan2(R_nb[:, 1, 0], R_nb[:, 0, 0]),
        ]
    )


def test_the_published_sensor_in_this_projects_gauge():
    truth = Iron().truth(1e-3, 5e-3)
    assert np.linalg.det(truth.soft_iron) == pytest.approx(1.0)
    # b = A m_b with [R]'s A and m_b = (20, 120, 90) mG, by hand
    assert truth.hard_iron_gauss * 1e3 == pytest.approx([37.6, 109.4, 113.0])
    as_read = Iron(offset_behind_iron=True).truth(1e-3, 5e-3)
    assert as_read.hard_iron_gauss * 1e3 == pytest.approx([20.0, 120.0, 90.0])
    m0 = np.linalg.norm([0.227, 0.052, 0.412])
    assert truth.field_gauss / m0 == pytest.approx(np.linalg.det(Iron().soft_iron) ** (1 / 3))


def test_a_reading_is_the_published_formula():
    quiet = ScenarioSettings("mam", "rov", samples=200, noise_mag_gauss=0.0, noise_gyro_rad_s=0.0)
    made = simulate(quiet)
    iron = Iron()
    for k in (0, 57, 199):
        m_t = made.R_nb[k].T @ np.array([0.227, 0.052, 0.412])
        expected = iron.soft_iron @ (m_t + iron.pseudo_hard_iron_gauss)
        assert made.samples.raw_b_gauss[k] == pytest.approx(expected, abs=1e-15)
    bias = made.samples.gyro_b_rad_s - made.rate_b_rad_s
    assert bias == pytest.approx(np.tile([4e-3, -5e-3, 2e-3], (200, 1)))


@pytest.mark.parametrize(("scenario", "motion"), SETS)
def test_the_gyro_of_a_step_turns_the_field_of_the_row_before_into_that_of_the_row(
    scenario, motion
):
    made = simulate(ScenarioSettings(scenario, motion, seed=4, samples=2000))
    u = made.field_b / made.truth.field_gauss
    assert np.abs(predicted_directions(made) - u).max() < 6e-7  # coning within 40 ms
    late = replace(made, rate_b_rad_s=np.roll(made.rate_b_rad_s, 1, axis=0))
    assert np.abs(predicted_directions(late) - u).max() > 2e-6  # a step late would be noticed
    assert np.linalg.norm(made.field_b, axis=1) == pytest.approx(made.truth.field_gauss)


def test_mean_rate_is_the_mean_of_the_rate_over_the_step():
    rate, dt, n = np.array([0.3, -0.2, 0.5]), 0.04, 12
    steps = so3.exp(np.outer(np.arange((n - 1) * SUBSTEPS + 1) * dt / SUBSTEPS, rate))
    assert mean_rate(steps, SUBSTEPS, dt)[1:] == pytest.approx(np.tile(rate, (n - 1, 1)))
    # pure roll at a rate that grows linearly: the mean is that of the middle of the step
    t = np.arange((n - 1) * SUBSTEPS + 1) * dt / SUBSTEPS
    rolling = so3.from_yaw_pitch_roll(0 * t, 0 * t, 0.5 * t**2)
    middle = (np.arange(n - 1) + 0.5) * dt
    assert mean_rate(rolling, SUBSTEPS, dt)[1:, 0] == pytest.approx(middle)


@pytest.mark.parametrize("motion", MOTIONS)
def test_half_ranges_and_frequencies_are_those_of_the_thesis(motion):
    rate_hz = 0.5
    for seed in range(6):
        R = sinusoids("lam", motion, generator(seed, 0), 3000, rate_hz)
        reached = np.degrees(np.abs(angles(R)).max(axis=0))
        assert reached == pytest.approx([5.0, 15.0, 90.0], rel=2e-3)
        turn = angles(R[::SUBSTEPS])
        crossings = np.count_nonzero(np.diff(np.sign(turn), axis=0), axis=0)
        frequency = crossings / 2 / (3000 / rate_hz)
        if motion == "slow":
            low, high = np.array([5e-3, 5e-3, 4e-3]), np.array([10e-3, 8e-3, 8e-3])
        else:
            amplitude = np.radians([5.0, 15.0, 90.0]) * 2 * np.pi
            low, high = [0.05, 0.1, 0.2] / amplitude, [0.08, 0.3, 0.4] / amplitude
        assert np.all(frequency > low - 2e-4)
        assert np.all(frequency < high + 2e-4)


def test_noise_has_its_level_and_is_white():
    made = simulate(ScenarioSettings("wam", samples=10_000))
    mag = made.samples.raw_b_gauss - made.field_b @ made.truth.soft_iron.T
    mag -= made.truth.hard_iron_gauss
    gyro = made.samples.gyro_b_rad_s - made.rate_b_rad_s - made.truth.gyro_bias_rad_s
    for noise, sigma in ((mag, 1e-3), (gyro, 5e-3)):
        assert noise.std(axis=0) == pytest.approx(np.full(3, sigma), rel=0.04)
        assert np.abs(np.mean(noise[1:] * noise[:-1], axis=0)).max() < 0.05 * sigma**2
    assert abs(np.corrcoef(mag[:, 0], gyro[:, 0])[0, 1]) < 0.05


def test_the_same_seed_gives_the_same_bits_and_another_another_motion():
    one, same, other = (simulate(ScenarioSettings("mam", seed=s, samples=300)) for s in (3, 3, 4))
    assert np.array_equal(one.samples.raw_b_gauss, same.samples.raw_b_gauss)
    assert np.array_equal(one.samples.gyro_b_rad_s, same.samples.gyro_b_rad_s)
    assert np.abs(one.R_nb - other.R_nb).max() > 0.1


def test_sweeps_keep_the_trajectory_and_scale_the_same_noise():
    base = ScenarioSettings("mam", samples=100)
    quiet, loud = (simulate(replace(base, noise_mag_gauss=n)) for n in (1e-3, 1e-2))
    truth = quiet.field_b @ quiet.truth.soft_iron.T + quiet.truth.hard_iron_gauss
    small, large = (e.samples.raw_b_gauss - truth for e in (quiet, loud))
    assert large == pytest.approx(10 * small, rel=1e-9, abs=1e-12)
    none, double = (simulate(replace(base, iron=Iron().scaled(s))) for s in (0.0, 2.0))
    shift = double.samples.raw_b_gauss - none.samples.raw_b_gauss
    assert shift * 1e3 == pytest.approx(np.tile([75.2, 218.8, 226.0], (100, 1)))


def test_gravity_and_field_give_back_the_true_heading():
    made = simulate(ScenarioSettings("mam", samples=500))
    north_east = made.R_nb[0] @ made.field_b[0]
    declination = np.arctan2(north_east[1], north_east[0])
    found = tilt_compensated_heading(made.field_b, made.samples.accel_b_m_s2) + declination
    assert np.cos(found - angles(made.R_nb)[:, 2]) == pytest.approx(np.ones(500))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"scenario": "ham"}, "no scenario 'ham'; there are wam, mam, lam"),
        ({"motion": "fast"}, "no motion 'fast'"),
        ({"samples": 1}, "samples is 1"),
        ({"rate_hz": 0.0}, "rate_hz is 0"),
        ({"noise_mag_gauss": float("nan")}, "noise_mag_gauss is nan"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_wrong_settings_are_named(wrong, said):
    with pytest.raises(ValueError, match=said):
        ScenarioSettings(**wrong)
