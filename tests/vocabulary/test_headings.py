"""Headings against the formulas of the thesis, by roll and pitch ([R] 2.1-2.2)."""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.heading import tilt_compensated_heading, wrapped


def by_roll_and_pitch(field_b: np.ndarray, accel_b: np.ndarray) -> np.ndarray:
    """roll = atan2(-ay, -az), pitch = atan2(ax, sqrt(ay^2 + az^2)), heading = atan2(-my, mx) of
    the field turned back by them."""
    ax, ay, az = accel_b.T
    roll, pitch = np.arctan2(-ay, -az), np.arctan2(ax, np.hypot(ay, az))
    mx, my, mz = field_b.T
    level_x = mx * np.cos(pitch) + (my * np.sin(roll) + mz * np.cos(roll)) * np.sin(pitch)
    level_y = my * np.cos(roll) - mz * np.sin(roll)
    return np.arctan2(-level_y, level_x)


def attitudes(count: int, seed: int) -> np.ndarray:
    """(N, 3, 3) R_nb, none of them with the nose straight up or down."""
    draw = np.random.default_rng(seed)
    R = so3.exp(draw.uniform(-np.pi, np.pi, size=(count * 2, 3)))
    return R[np.abs(R[:, 2, 0]) < 0.98][:count]


def test_it_is_the_heading_by_roll_and_pitch():
    R_nb = attitudes(500, 1)
    field_b = np.array([0.24, 0.02, 0.42]) @ R_nb
    accel_b = np.array([0.0, 0.0, -9.81]) @ R_nb
    found = tilt_compensated_heading(field_b, accel_b)
    assert np.abs(wrapped(found - by_roll_and_pitch(field_b, accel_b))).max() < 1e-9


def test_it_is_the_angle_from_magnetic_north_to_the_nose():
    R_nb = attitudes(500, 2)
    found = tilt_compensated_heading(
        np.array([0.3, 0.0, 0.4]) @ R_nb, np.array([0.0, 0.0, -9.81]) @ R_nb
    )
    assert np.abs(wrapped(found - np.arctan2(R_nb[:, 1, 0], R_nb[:, 0, 0]))).max() < 1e-9


def test_east_is_a_quarter_turn():
    east = np.array([[0.0, -0.3, 0.4]])  # nose east: north is to the left, which is -y
    assert np.degrees(tilt_compensated_heading(east, np.array([[0.0, 0.0, -9.8]]))) == 90.0


def test_strength_of_field_and_force_does_not_matter():
    R_nb = attitudes(50, 3)
    field_b, accel_b = np.array([0.2, 0.1, 0.4]) @ R_nb, np.array([0.0, 0.0, -9.81]) @ R_nb
    one = tilt_compensated_heading(field_b, accel_b)
    assert np.allclose(one, tilt_compensated_heading(7.0 * field_b, 0.1 * accel_b))


def test_wrapped():
    angles = np.array([0.0, 3.5, -3.5, 2 * np.pi, 7.0, 1.0 - 6 * np.pi])
    expected = np.array([0.0, 3.5 - 2 * np.pi, 2 * np.pi - 3.5, 0.0, 7.0 - 2 * np.pi, 1.0])
    assert np.allclose(wrapped(angles), expected)
