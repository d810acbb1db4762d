"""Averaging of fast streams into steps, exactly where it can be.

A step's field is the mean of an odd number n of consecutive samples and belongs to the middle one;
the rotation between two steps is the product of all sample rotations between their middle samples.
Averaging shortens the field by (w T)^2 / 24 for a rate w over the averaging time T: 0.04 % at
4 rad/s and 25 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """N consecutive steps; the rotation of row k leads from step k-1 to step k.

    time_s (N,), field_b_gauss (N, 3), angle_b_rad (N, 3) rotation vector of the step,
    dt_s (N,), accel_b_m_s2 (N, 3), linked (N,): 0 for a step that nothing leads to, the first of a
    piece, whose rotation and time are nan, else 1.
    """

    time_s: Array
    field_b_gauss: Array
    angle_b_rad: Array
    dt_s: Array
    accel_b_m_s2: Array
    linked: Array

    def __len__(self) -> int:
        return len(self.time_s)


def samples_per_step(rate_hz: float, step_rate_hz: float) -> int:
    """The largest odd number of samples whose rate stays at or above `step_rate_hz`, at least 1."""
    n = int(rate_hz / step_rate_hz)
    return max(1, n - 1 + n % 2)


class StepAverager:
    """Samples in, steps out. The state is at most n samples, so any split gives the same steps."""

    def __init__(self, averaged: int) -> None:
        self.averaged = averaged
        self._rows: list[Array] = []
        self._linked = False

    def add(self, rows: Array) -> Steps:
        """Take samples (N, 11) without a gap, return completed steps.

        Columns: time_s, dt_s, field (3), gyro (3), accel (3).
        """
        if self._rows:
            rows = np.vstack([*self._rows, rows])
        n, half = self.averaged, self.averaged // 2
        # The second half of the last step's samples is kept: its rotations lead to the next step.
        lead = half if self._linked else 0
        count = max(0, (len(rows) - lead) // n)
        used = lead + count * n
        if count == 0:
            self._rows = [rows]
            return _empty()
        steps = _average(rows[:used], lead, n, count, self._linked)
        self._rows = [rows[used - half :]]
        self._linked = True
        return steps


def _average(rows: Array, lead: int, n: int, count: int, linked: bool) -> Steps:
    half = n // 2
    body = rows[lead:].reshape(count, n, -1)
    dt = rows[:, 1]
    phi = rows[:, 5:8] * dt[:, None]
    # rotation of step k: samples (middle of k-1, middle of k]; the first has them only if linked
    middles = lead + half + n * np.arange(count)
    angle = np.full((count, 3), np.nan)
    length = np.full(count, np.nan)
    first = 0 if linked else 1
    if count > first:
        index = middles[first:, None] - np.arange(n - 1, -1, -1)[None, :]
        angle[first:] = compose(phi[index])
        length[first:] = dt[index].sum(axis=1)
    return Steps(
        time_s=body[:, half, 0],
        field_b_gauss=body[:, :, 2:5].mean(axis=1),
        angle_b_rad=angle,
        dt_s=length,
        accel_b_m_s2=body[:, :, 8:11].mean(axis=1),
        linked=np.isfinite(length).astype(np.float64),
    )


def compose(phi: Array) -> Array:
    """Rotation vector of Exp(phi_1) Exp(phi_2) ... (body increments), for (N, n, 3)."""
    if phi.shape[1] == 1:
        return np.asarray(phi[:, 0])
    R = so3.exp(phi[:, 0])
    for j in range(1, phi.shape[1]):
        R = R @ so3.exp(phi[:, j])
    return so3.log(R)


def join(parts: Sequence[Steps]) -> Steps:
    """Consecutive steps in one record."""
    if len(parts) == 1:
        return parts[0]
    return Steps(
        np.concatenate([p.time_s for p in parts]),
        np.concatenate([p.field_b_gauss for p in parts]),
        np.concatenate([p.angle_b_rad for p in parts]),
        np.concatenate([p.dt_s for p in parts]),
        np.concatenate([p.accel_b_m_s2 for p in parts]),
        np.concatenate([p.linked for p in parts]),
    )


def split(steps: Steps, at: int) -> tuple[Steps, Steps]:
    """The first `at` steps and the rest."""
    return _part(steps, slice(0, at)), _part(steps, slice(at, None))


def _part(s: Steps, rows: slice) -> Steps:
    return Steps(
        s.time_s[rows],
        s.field_b_gauss[rows],
        s.angle_b_rad[rows],
        s.dt_s[rows],
        s.accel_b_m_s2[rows],
        s.linked[rows],
    )


def _empty() -> Steps:
    z3 = np.zeros((0, 3))
    return Steps(np.zeros(0), z3, z3, np.zeros(0), z3, np.zeros(0))
