"""Noise levels estimated from data with known noise."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator import chain, noise
from ahrsd.estimator.parameters import EstimatorParameters

TRUE = chain.Noise(1.5e-3, 5e-3)
DT = 0.04
M = np.array([[0.55, 0.03, -0.02], [0.03, 0.45, 0.01], [-0.02, 0.01, 0.5]])


def epochs(count, seed=0):
    rng = np.random.default_rng(seed)
    n = 512
    for _ in range(count):
        u = np.empty((n, 3))
        u[0] = rng.normal(size=3)
        u[0] /= np.linalg.norm(u[0])
        phase = rng.uniform(0, 6, 3)
        rate = 0.4 * np.sin(0.7 * DT * np.arange(n)[:, None] + phase)
        for k in range(1, n):
            u[k] = so3.exp(-rate[k] * DT) @ u[k - 1]
        field = u @ M + rng.normal(size=(n, 3)) * TRUE.mag_gauss
        gyro = rate + rng.normal(size=(n, 3)) * TRUE.gyro_rad_s
        yield chain.EpochData(
            field, gyro * DT, np.full(n, DT), np.full((n, 3), np.nan), np.arange(n) * DT, True
        )


def residuals_at(data, used):
    """Residuals of an epoch at its optimal directions, with known calibration."""
    x = np.r_[chain.upper_triangle(M), np.zeros(3)]
    u = chain.start_directions(M, np.zeros(3), data.field_b_gauss)
    for _ in range(3):
        q = chain.linearise(data, u, x, np.zeros(3), used)
        z = np.zeros(16)
        z[12:] = -np.linalg.solve(q.H[12:, 12:], q.g[12:])
        u = chain.move_directions(u, q, z)
    q = chain.linearise(data, u, x, np.zeros(3), used)
    return noise.residual_sums(q, data, used, noise.Typical.of(data))


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [(0.6, 1.6), *(one for one in ((1.0, 1.0), (2.0, 0.7)))],
)
def test_both_sigmas_are_recovered_from_any_start(wrong):
    data = list(epochs(30))
    used = chain.Noise(TRUE.mag_gauss * wrong[0], TRUE.gyro_rad_s * wrong[1])
    for _ in range(12):
        found = [residuals_at(d, used) for d in data]
        used = noise.pool_noise(found, chain.Noise(1.0, 1.0), EstimatorParameters())
    assert used.mag_gauss == pytest.approx(TRUE.mag_gauss, rel=0.03)
    assert used.gyro_rad_s == pytest.approx(TRUE.gyro_rad_s, rel=0.03)


def test_first_guess_of_white_noise_is_right_on_smooth_motion():
    guesses = [noise.first_guess(d, EstimatorParameters()) for d in epochs(10)]
    middle = noise.median_noise(guesses)
    assert middle.mag_gauss == pytest.approx(TRUE.mag_gauss, rel=0.05)
    assert middle.gyro_rad_s == pytest.approx(TRUE.gyro_rad_s, rel=0.05)


def test_differences_ignore_a_ramp_and_outliers():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(4000, 3)) * 0.2 + np.arange(4000)[:, None] * 5.0
    values[::100] += 1e3
    assert noise.noise_of_differences(values) == pytest.approx(0.2, rel=0.06)


def test_pooled_noise_excludes_disturbed_epochs():
    quiet = [noise.Residuals(1e-6 * 1000, 1000.0, 25e-6 * 50, 50.0)] * 9
    loud = noise.Residuals(1e-2 * 1000, 1000.0, 25e-6 * 50, 50.0)
    found = noise.pool_noise([*quiet, loud], chain.Noise(1.0, 1.0), EstimatorParameters())
    assert found.mag_gauss == pytest.approx(1e-3)
    assert found.gyro_rad_s == pytest.approx(5e-3)


def test_gyro_noise_is_limited_to_the_vicinity_of_its_first_guess():
    found = [noise.Residuals(1e-3, 1000.0, 1.0, 50.0)]
    guess = chain.Noise(1e-3, 4e-3)
    assert noise.pool_noise(found, guess, EstimatorParameters()).gyro_rad_s == pytest.approx(6e-3)


def test_disturbed_epoch_has_a_higher_noise_level_of_its_own():
    usual = chain.Noise(1e-3, 5e-3)
    loud = noise.Residuals(1e-4 * 1500, 1500.0, 25e-6 * 40, 40.0)
    own = noise.shrink_noise(loud, usual, EstimatorParameters())
    assert own.mag_gauss == pytest.approx(np.sqrt((0.15 + 1e-4) / 1600))
    assert own.gyro_rad_s == pytest.approx(5e-3)


def test_noise_estimate_has_a_floor():
    still = noise.Residuals(0.0, 1500.0, 0.0, 40.0)
    found = noise.pool_noise([still], chain.Noise(1e-3, 1e-3), EstimatorParameters())
    assert found == chain.Noise(1e-5, 1e-6)


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ({"epoch_steps": 8}, "epoch_steps is 8: at least 64"),
        ({"window_steps": 100}, "window_steps is 100: at least epoch_steps, 512"),
        ({"outlier_sigma": 0.0}, "outlier_sigma is 0.0: it must be a positive number"),
        ({"prior_soft_iron": float("nan")}, "prior_soft_iron is nan"),
    ],
)
def test_error_names_the_setting_out_of_range(setting, text):
    with pytest.raises(ValueError, match=text):
        EstimatorParameters(**setting)
