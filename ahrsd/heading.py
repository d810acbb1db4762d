"""Heading from field and gravity, vectorised.

Level the field with the specific force f (which points up at rest) and compare the sensor's x axis
with it: with d = -f / |f|, m_l = m - d (d.m), x_l = x - d (d.x),

    heading = atan2(d . (m_l x x_l), m_l . x_l)

the angle from magnetic north to the sensor's forward axis, positive to the east, as the thesis' [R]
2.1-2.2 gives it by roll and pitch (tests/vocabulary/test_headings.py compares the two).
"""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array

_FORWARD = np.array([1.0, 0.0, 0.0])


def tilt_compensated_heading(field_b: Array, accel_b_m_s2: Array) -> Array:
    """Magnetic heading in rad, (N,), of (N, 3) corrected fields and specific forces."""
    down = -accel_b_m_s2 / np.linalg.norm(accel_b_m_s2, axis=1, keepdims=True)
    level = field_b - down * np.sum(down * field_b, axis=1, keepdims=True)
    forward = _FORWARD - down * down[:, :1]
    across = np.sum(down * np.cross(level, forward), axis=1)
    return np.asarray(np.arctan2(across, np.sum(level * forward, axis=1)))


def wrapped(angle_rad: Array) -> Array:
    """The same angles in -pi..pi."""
    return np.asarray(np.arctan2(np.sin(angle_rad), np.cos(angle_rad)))
