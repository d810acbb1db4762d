"""The linear starts: exact without noise, and unbiased by noise in the regressors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.epoch_data import has_motion

M = np.array([[0.55, 0.03, -0.02], [0.03, 0.45, 0.01], [-0.02, 0.01, 0.5]])
B = np.array([0.1, -0.2, 0.05])
DT = 0.03


def epoch(amplitude, noise_gauss, seed=0, n=2000):
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    rate = amplitude * np.column_stack(
        [np.sin(0.5 * t), np.sin(0.33 * t + 1), np.sin(0.21 * t + 2)]
    )
    u = np.empty((n, 3))
    u[0] = [0.36, -0.48, 0.8]
    for k in range(1, n):
        u[k] = so3.exp(-rate[k] * DT) @ u[k - 1]
    field = u @ M + B + rng.normal(size=(n, 3)) * noise_gauss
    return chain.EpochData(field, rate * DT, np.full(n, DT), np.full((n, 3), np.nan), t, True)


def test_linear_start_is_exact_without_noise():
    c = chain.linear_start([epoch(0.5, 0.0)])
    np.testing.assert_allclose(chain.symmetric(c[:6]), M, atol=1e-6)
    np.testing.assert_allclose(c[6:], B, atol=1e-6)


def test_linear_start_is_not_attenuated_by_noise():
    """Errors in variables: the mean over the noise stays at the truth, unlike that of least
    squares.
    """
    found = np.array([chain.linear_start([epoch(0.25, 5e-3, seed)]) for seed in range(12)])
    truth = np.r_[chain.upper_triangle(M), B]
    error, spread = found.mean(axis=0) - truth, found.std(axis=0) / np.sqrt(12)
    assert np.all(np.abs(error) < 4 * spread + 1e-3)
    assert np.all(spread < 0.03)


def test_linear_start_needs_an_epoch_longer_than_its_lags():
    assert chain.linear_start([epoch(0.5, 0.0, n=15)]) is None


def test_linear_start_returns_only_positive_definite_matrices():
    rng = np.random.default_rng(0)
    field = rng.normal(size=(400, 3))
    data = chain.EpochData(
        field, rng.normal(size=(400, 3)), np.full(400, DT), field, DT * field[:, 0], True
    )
    c = chain.linear_start([data])
    assert c is None or np.linalg.eigvalsh(chain.symmetric(c[:6]))[0] > 0


def test_sphere_start_is_exact_on_a_sphere():
    u = np.random.default_rng(0).normal(size=(300, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    c = chain.sphere_start(0.47 * u + B)
    np.testing.assert_allclose(c, np.r_[0.47, 0, 0, 0.47, 0, 0.47, B], atol=1e-12)


def test_sphere_start_refuses_planar_data():
    angle = np.linspace(0, 6, 100)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(100)])
    assert chain.sphere_start(circle) is None


@pytest.mark.parametrize(("amplitude", "expected"), [(0.0, False), (0.02, True), (0.5, True)])
def test_motion_is_recognised_by_rotation(amplitude, expected):
    assert has_motion(epoch(amplitude, 1e-3, n=512), np.zeros(3)) is expected


def test_no_field_at_all_is_not_motion():
    """A magnetometer that reads 0 0 0 while the vehicle turns."""
    data = epoch(0.5, 1e-3, n=512)
    data.field_b_gauss[:] = 0.0
    assert has_motion(data, np.zeros(3)) is False


def test_wandering_field_at_rest_is_not_motion():
    data = epoch(0.0, 1e-3, n=512)
    data.field_b_gauss[:, 2] += np.linspace(0, 0.05, 512)
    assert not has_motion(data, np.zeros(3))


def test_magnet_at_rest_is_not_motion_and_a_steady_turn_is():
    """The mean rate may be bias, so only the rate without the bias shows a steady turn."""
    data, bias = epoch(0.0, 1e-3, n=512), np.array([0.02, -0.01, 0.015])
    data.angle_b_rad[:] += bias * data.dt_s[:, None]
    away = np.exp(-0.5 * ((np.arange(512) - 256) / 80.0) ** 2)
    data.field_b_gauss[:] += 0.3 * away[:, None] * np.array([0.6, -0.5, 0.6])
    assert not has_motion(data, bias)
    steady = data.angle_b_rad + np.array([0.0, 0.0, 0.02]) * data.dt_s[:, None]
    assert has_motion(replace(data, angle_b_rad=steady), bias)


def test_mirrored_start_is_on_the_other_side_of_the_field_plane():
    heading = np.linspace(0.0, 2 * np.pi, 50)
    level = np.column_stack([0.2 * np.cos(heading), 0.2 * np.sin(heading), np.full(50, 0.4)])
    c = np.r_[chain.upper_triangle(M), 0.1, -0.2, 0.05]
    found = chain.mirror_hard_iron(c, level)
    np.testing.assert_allclose(found[6:], [0.1, -0.2, 0.75], atol=1e-12)
    np.testing.assert_array_equal(found[:6], c[:6])
