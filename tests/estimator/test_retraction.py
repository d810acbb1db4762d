"""Finite steps of the calibration: first order unchanged, the planar valley followed."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.estimator import chain
from ahrsd.estimator.graph import Moments, curvature, retract

M = np.array([[0.55, 0.03, -0.02], [0.03, 0.45, 0.01], [-0.02, 0.01, 0.5]])
B = np.array([0.1, -0.2, 0.05])
C9 = np.r_[chain.upper_triangle(M), B]


def planar(height, count=40):
    """Directions on the circle of the sphere at this height, and their moments under (M, B)."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    level = np.sqrt(1 - height**2)
    u = np.column_stack([level * np.cos(angle), level * np.sin(angle), np.full(count, height)])
    moments = Moments()
    moments.take(u @ M + B)
    return u, moments


def test_small_steps_are_additive():
    _, moments = planar(0.6)
    dc = np.random.default_rng(0).normal(size=9)
    for h in (1e-4, 1e-5):
        error = retract(C9, h * dc, moments) - (C9 + h * dc)
        assert np.linalg.norm(error) < 60 * h**2


@pytest.mark.parametrize("shift", [-0.3, 0.2, 0.9])
def test_the_valley_of_a_planar_turn_is_followed_to_any_distance(shift):
    """Tangent of the valley: u -> u + shift z, less what is radial. All of its way explains the
    field: what is corrected stays on the unit sphere, at another height.
    """
    u, moments = planar(0.3)
    field = u @ M + B
    dc = np.r_[chain.upper_triangle(0.3 * shift * M), -shift * M[:, 2]]
    new = retract(C9, dc, moments)
    found = np.linalg.solve(chain.symmetric(new[:6]), (field - new[6:]).T).T
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    tangential = shift * (1 - 0.3**2)
    height = (0.3 + tangential) / np.sqrt(1 + tangential**2 + shift**2 * 0.3**2 * (1 - 0.3**2))
    np.testing.assert_allclose(found[:, 2], height, atol=1e-12)
    straight = np.linalg.solve(chain.symmetric((C9 + dc)[:6]), (field - (C9 + dc)[6:]).T)
    assert abs(np.linalg.norm(straight, axis=0).mean() - 1) > 0.1 * shift**2


def test_where_the_matrix_would_not_stay_positive_the_step_is_plain():
    _, moments = planar(0.6)
    dc = np.r_[chain.upper_triangle(1.5 * M), np.zeros(3)]
    np.testing.assert_array_equal(retract(C9, dc, moments), C9 + dc)


def test_without_data_the_scale_is_left_alone():
    dc = np.r_[np.zeros(6), 0.01, 0.0, 0.0]
    np.testing.assert_allclose(retract(C9, dc, Moments()), C9 + dc, atol=1e-12)


def test_curvature_is_what_the_straight_covariance_misses():
    """Along the valley of a planar turn, against moves of a standard normal size."""
    _, moments = planar(0.3)
    step = 0.05 * np.r_[chain.upper_triangle(0.3 * M), -M[:, 2]]
    t = np.random.default_rng(0).normal(size=4000)
    beside = np.array([retract(C9, k * step, moments) - C9 - k * step for k in t])
    expected = beside.T @ beside / len(t)
    added = curvature(C9, np.outer(step, step) + 1e-16 * np.eye(9), moments)
    assert np.trace(expected) > 0
    np.testing.assert_allclose(added, expected, atol=0.12 * np.abs(expected).max())
