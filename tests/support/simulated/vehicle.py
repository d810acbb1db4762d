"""A vehicle whose truth is known: way, attitude, field, and a sensor with iron on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ahrsd.calibration import Affine
from ahrsd.evaluation import EvaluationTrack, StoredCalibration
from ahrsd.evaluation.heading import Fixes
from ahrsd.samples import Array

SOFT_IRON = np.array([[1.05, 0.03, 0.0], [0.03, 0.95, 0.02], [0.0, 0.02, 1.01]])
HARD_IRON = np.array([0.05, -0.03, 0.04])
FIELD_N = np.array([0.20, -0.05, 0.45])  # declination atan2(-0.05, 0.20)
DECLINATION_DEG = float(np.degrees(np.arctan2(-0.05, 0.20)))


@dataclass(frozen=True)
class Vehicle:
    track: EvaluationTrack
    heading_rad: Array
    R_nb: Array
    fixes: Fixes
    course_rad: Array


def drive() -> Vehicle:
    """200 s at 50 Hz on two loops, rolling and pitching, with a side slip of 5 deg; 1 Hz fixes."""
    t = np.arange(10_000) / 50.0
    course = 0.06 * t + 0.6 * np.sin(0.11 * t)
    heading = course - np.radians(5.0)
    pitch, roll = 0.06 * np.sin(0.7 * t), 0.10 * np.sin(0.5 * t + 1.0)
    R = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]))
    R_nb = R.as_matrix()
    rate = np.vstack([np.zeros(3), (R[:-1].inv() * R[1:]).as_rotvec() * 50.0])
    speed = 6.0 + np.sin(0.05 * t)
    velocity_n = np.column_stack([speed * np.cos(course), speed * np.sin(course), 0 * t])
    steps = 0.5 * (velocity_n[1:] + velocity_n[:-1]) / 50.0
    place = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    velocity_b = np.einsum("kji,kj->ki", R_nb, velocity_n)
    field_b = np.einsum("kji,j->ki", R_nb, FIELD_N)
    raw = field_b @ SOFT_IRON.T + HARD_IRON
    accel = np.einsum("kji,j->ki", R_nb, np.array([0.0, 0.0, -9.81]))
    names = ("velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s")
    track = EvaluationTrack(
        time_s=t, raw_b_gauss=raw, before_b_gauss=raw, gyro_b_rad_s=rate, accel_b_m_s2=accel,
        covariates=dict(zip(names, velocity_b.T, strict=True)),
    )  # fmt: skip
    fixes = Fixes(t[::50], place[::50, 0], place[::50, 1], "GPS")
    return Vehicle(track, heading, R_nb, fixes, course)


def truth() -> StoredCalibration:
    """The truth as a calibration."""
    return StoredCalibration(
        "c.json", "magyc", "another", True, Affine(np.linalg.inv(SOFT_IRON), HARD_IRON)
    )
