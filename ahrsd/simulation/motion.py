"""How the sensor turns: sinusoids in roll, pitch and heading ([R] chapter 5).

    angle_i(t) = A_i sin(2 pi f_i t + phi_i),   phi_i uniform in 0..2 pi, f_i uniform per run

[R] gives the half-ranges A_i and no frequencies. "slow" has those of the authors' early code, in
which the field's derivative is buried in noise; "rov" the peak rates 2 pi f_i A_i of their later
code.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array

SUBSTEPS = 8  # per sample; the attitude itself is exact at every one of them

#: Half-ranges of roll, pitch and heading in degrees: wide, medium and low angular movement.
SCENARIOS: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {"wam": (180.0, 180.0, 180.0), "mam": (5.0, 45.0, 180.0), "lam": (5.0, 15.0, 90.0)}
)
#: Ranges per angle from which each run draws, and whether they are frequencies or peak rates.
MOTIONS: Mapping[str, tuple[str, tuple[tuple[float, float], ...]]] = MappingProxyType(
    {
        "slow": ("frequency_hz", ((5e-3, 10e-3), (5e-3, 8e-3), (4e-3, 8e-3))),
        "rov": ("peak_rate_rad_s", ((0.05, 0.08), (0.1, 0.3), (0.2, 0.4))),
    }
)


def rotation_nb(roll: Array, pitch: Array, heading: Array) -> Array:
    """R_nb (N, 3, 3) = Rz(heading) Ry(pitch) Rx(roll) of angles (N,) in rad."""
    c1, s1 = np.cos(roll), np.sin(roll)
    c2, s2 = np.cos(pitch), np.sin(pitch)
    c3, s3 = np.cos(heading), np.sin(heading)
    R = np.empty((len(roll), 3, 3))
    R[:, 0] = np.stack([c3 * c2, c3 * s2 * s1 - s3 * c1, c3 * s2 * c1 + s3 * s1], axis=1)
    R[:, 1] = np.stack([s3 * c2, s3 * s2 * s1 + c3 * c1, s3 * s2 * c1 - c3 * s1], axis=1)
    R[:, 2] = np.stack([-s2, c2 * s1, c2 * c1], axis=1)
    return R


def sinusoids(
    scenario: str, motion: str, rng: np.random.Generator, samples: int, rate_hz: float
) -> Array:
    """Attitude R_nb ((samples - 1) * SUBSTEPS + 1, 3, 3) at the sub-steps; row 0 is sample 0.

    Raises KeyError for an unknown scenario or motion.
    """
    half_range = np.radians(SCENARIOS[scenario])
    kind, ranges = MOTIONS[motion]
    drawn = np.array([rng.uniform(low, high) for low, high in ranges])
    frequency_hz = drawn if kind == "frequency_hz" else drawn / (2 * np.pi * half_range)
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    time_s = np.arange((samples - 1) * SUBSTEPS + 1) / (SUBSTEPS * rate_hz)
    angle = half_range * np.sin(2 * np.pi * frequency_hz * time_s[:, None] + phase)
    return rotation_nb(*angle.T)


def mean_rate(R_nb: Array, substeps: int, dt_s: float) -> Array:
    """Mean body rate (N, 3) in rad/s over the step that ends at each sample; row 0 is nan.

    R_nb ((N - 1) * substeps + 1, 3, 3): the mean is the sum of the sub-steps' rotation vectors over
    the step, which is what a gyroscope that integrates its signal reports.
    """
    increment = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:])
    angle = increment.reshape(-1, substeps, 3).sum(axis=1)
    return np.vstack([np.full((1, 3), np.nan), angle / dt_s])


def quaternion(R_nb: Array) -> Array:
    """Unit quaternions (N, 4), scalar first, sensor to world, continuous in sign, of (N, 3, 3)."""
    half = so3.log(R_nb) / 2
    t = np.linalg.norm(half, axis=1)
    q = np.column_stack([np.cos(t), half * np.sinc(t / np.pi)[:, None]])
    flips = np.sign(np.sum(q[1:] * q[:-1], axis=1))
    q[1:] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
    return q
