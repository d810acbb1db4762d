"""Laws of rotations in three regimes: random, near the identity, near pi."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ahrsd import so3

unit = st.floats(-1.0, 1.0)
axes = (
    st.tuples(unit, unit, unit)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)
angles = st.one_of(
    st.floats(0.0, 3.1),
    st.floats(0.0, 1e-2),
    st.floats(-16, -2).map(lambda e: 10.0**e),
    st.floats(-12, -3).map(lambda e: np.pi - 10.0**e),
)


@given(axes, angles)
def test_exp_is_a_rotation_by_the_angle_about_the_axis(axis, angle):
    R = so3.exp(axis * angle)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-13)
    np.testing.assert_allclose(R @ axis, axis, atol=1e-14)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    np.testing.assert_allclose(
        R @ across, np.cos(angle) * across + np.sin(angle) * np.cross(axis, across), atol=1e-14
    )


@given(axes, angles)
def test_log_undoes_exp(axis, angle):
    phi = axis * angle
    np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, atol=2e-8)
    np.testing.assert_allclose(so3.exp(so3.log(so3.exp(phi))), so3.exp(phi), atol=1e-11)


def test_log_keeps_relative_accuracy_near_the_identity():
    phi = np.array([[3e-9, -2e-9, 1e-9], [1e-6, 0.0, 2e-6], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, rtol=1e-9, atol=1e-24)


def test_log_of_half_turns_is_the_axis_up_to_its_sign():
    for axis in np.vstack([np.eye(3), [[0.6, -0.8, 0.0], [-1 / 3, 2 / 3, 2 / 3]]]):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        found = so3.log(R)
        assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
        assert abs(found @ axis) == pytest.approx(np.pi, abs=1e-9)


def test_log_of_many_handles_regimes_side_by_side():
    phi = np.array([[0.3, -0.2, 0.1], [0.0, 0.0, 0.0], [0.0, np.pi - 1e-7, 0.0], [1e-5, 0, 0]])
    np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, atol=1e-12)


@given(axes, angles, axes)
def test_left_jacobian_is_the_derivative_of_exp(axis, angle, direction):
    phi, h = axis * angle, 1e-6
    _, J = so3.exp_and_left_jacobian(phi)
    moved = so3.exp(phi + h * direction) @ so3.exp(phi - h * direction).T
    np.testing.assert_allclose(so3.log(moved) / (2 * h), J @ direction, atol=3e-9)


def test_yaw_pitch_and_roll_are_turned_in_that_order():
    angles = np.random.default_rng(3).uniform(-np.pi, np.pi, (50, 3))
    expected = Rotation.from_euler("ZYX", angles).as_matrix()
    np.testing.assert_allclose(so3.from_yaw_pitch_roll(*angles.T), expected, atol=2e-15)


def test_composed_increments_are_turned_one_after_the_other():
    phi = np.random.default_rng(4).normal(size=(20, 3, 3))
    first, second, third = (Rotation.from_rotvec(phi[:, k]) for k in range(3))
    np.testing.assert_allclose(
        so3.exp(so3.compose(phi)), (first * second * third).as_matrix(), atol=1e-14
    )


def test_taylor_and_closed_form_meet():
    axis = np.array([0.48, -0.6, 0.64])
    below, above = (so3.exp_and_left_jacobian(axis * t) for t in (1e-3 * (1 - 1e-9), 1e-3))
    np.testing.assert_allclose(below[0], above[0], atol=5e-12)
    np.testing.assert_allclose(below[1], above[1], atol=5e-12)


@given(axes, axes)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(so3.skew(a) @ b, np.cross(a, b), atol=1e-15)


@given(axes)
def test_tangent_basis_is_orthonormal(u):
    T = so3.tangent_basis(u[None])[0]
    np.testing.assert_allclose(T.T @ T, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(T.T @ u, 0.0, atol=1e-14)


@pytest.mark.parametrize("z", [1.0, -1.0, 0.0, -0.0])
def test_tangent_basis_at_its_seam(z):
    u = np.array([[np.sqrt(1 - z * z), 0.0, z]])
    T = so3.tangent_basis(u)[0]
    np.testing.assert_allclose(np.column_stack([T, u[0]]).T @ T, np.eye(3)[:, :2], atol=1e-15)
