"""Field, rate and the field's derivative as the kinematic methods see them, segment by segment.

"median" is the seeds' way: first differences (m_k - m_(k-1)) / dt_k beside m_k and w_k; over a
window of theta samples the median of each. The difference belongs to the middle of the step and m_k
to its end: half a sample apart, as published. "savgol" smooths readings and rates with a
Savitzky-Golay filter of order 2 (the authors' notebooks do so), then takes difference, mid-step
field and rate, which all belong to the middle of the step; per window their mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from ahrsd.baselines.data import MethodData, MethodError, MethodSettings
from ahrsd.samples import Array

MINIMUM_WINDOWS = 12  # three equations each, twelve unknowns, and something left to judge by


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """Rows of field (n, 3) gauss, its derivative in the body (n, 3) gauss/s, rate (n, 3) rad/s."""

    field: Array
    derivative: Array
    rate: Array

    def __len__(self) -> int:
        return len(self.field)

    def __getitem__(self, rows: slice) -> Kinematics:
        return Kinematics(self.field[rows], self.derivative[rows], self.rate[rows])


def _join(parts: list[Kinematics]) -> Kinematics:
    return Kinematics(
        np.vstack([p.field for p in parts]),
        np.vstack([p.derivative for p in parts]),
        np.vstack([p.rate for p in parts]),
    )


def _segment(data: MethodData, rows: slice, settings: MethodSettings) -> Kinematics | None:
    m, w, dt = data.raw_b_gauss[rows], data.gyro_b_rad_s[rows], data.dt_s[rows][1:, None]
    if settings.derivative == "savgol":
        length = settings.savgol_window
        if len(m) < length:
            return None
        m, w = savgol_filter(m, length, 2, axis=0), savgol_filter(w, length, 2, axis=0)
        return Kinematics((m[1:] + m[:-1]) / 2, np.diff(m, axis=0) / dt, w[1:])
    if len(m) < 2:
        return None
    return Kinematics(m[1:], np.diff(m, axis=0) / dt, w[1:])


def _segments(data: MethodData, settings: MethodSettings) -> list[Kinematics]:
    found = [_segment(data, rows, settings) for rows in data.segments()]
    return [part for part in found if part is not None]


def per_sample(data: MethodData, settings: MethodSettings) -> Kinematics:
    """One row a step.  MethodError where no segment is long enough."""
    parts = _segments(data, settings)
    if sum(len(part) for part in parts) < MINIMUM_WINDOWS:
        raise MethodError("no stretch without a gap is long enough to differentiate the field")
    return _join(parts)


def windowed(data: MethodData, settings: MethodSettings) -> Kinematics:
    """One row a window of `settings.window` steps; what is left of a segment is not used."""
    average = np.median if settings.derivative == "median" else np.mean
    theta = settings.window
    parts = []
    for part in _segments(data, settings):
        whole = len(part) // theta * theta
        if whole:
            shape = (-1, theta, 3)
            parts.append(
                Kinematics(
                    *(
                        np.asarray(average(values[:whole].reshape(shape), axis=1))
                        for values in (part.field, part.derivative, part.rate)
                    )
                )
            )
    count = sum(len(part) for part in parts)
    if count < MINIMUM_WINDOWS:
        raise MethodError(
            f"{count} whole windows of {theta} samples without a gap: "
            f"at least {MINIMUM_WINDOWS} are needed"
        )
    return _join(parts)
