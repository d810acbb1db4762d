"""Rotations: arrays of matrices R_nb (body to north-east-down) and rotation vectors."""

from __future__ import annotations

import numpy as np


def matrix_from_euler(yaw, pitch, roll):
    """R_nb (N, 3, 3) of angles (N,) in rad, in the order yaw, pitch, roll about z, y, x."""
    cy, sy = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def rate_from_euler(pitch, roll, yaw_rate, pitch_rate, roll_rate):
    """Body rate (N, 3) in rad/s, exact."""
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    return np.stack(
        [
            roll_rate - yaw_rate * sp,
            pitch_rate * cr + yaw_rate * cp * sr,
            -pitch_rate * sr + yaw_rate * cp * cr,
        ],
        axis=-1,
    )


def to_body(R_nb, v_n):
    """R^T v, for arrays (N, 3, 3) and (N, 3) or (3,)."""
    return np.einsum("nji,nj->ni", R_nb, np.broadcast_to(v_n, (*R_nb.shape[:1], 3)))


def to_world(R_nb, v_b):
    """R v, for arrays (N, 3, 3) and (N, 3) or (3,)."""
    return np.einsum("nij,nj->ni", R_nb, np.broadcast_to(v_b, (*R_nb.shape[:1], 3)))


def turned(v, angle):
    """Vectors v (N, 3) turned by rotation vectors (N, 3) or (3,), by Rodrigues' formula."""
    angle = np.broadcast_to(angle, v.shape)
    size = np.linalg.norm(angle, axis=1, keepdims=True)
    axis = angle / np.where(size > 0, size, 1.0)
    along = np.sum(axis * v, axis=1, keepdims=True) * axis
    return along + np.cos(size) * (v - along) + np.sin(size) * np.cross(axis, v)


def skew(v):
    """[v]x, (..., 3, 3)."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack(
        [
            np.stack([zero, -z, y], axis=-1),
            np.stack([z, zero, -x], axis=-1),
            np.stack([-y, x, zero], axis=-1),
        ],
        axis=-2,
    )


def direction(rng):
    """A unit vector, uniform on the sphere."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)
