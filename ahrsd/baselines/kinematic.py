"""The kinematic residual of MAGICAL and MAGYC, its derivative, and what it is fed with.

A field fixed in the world turns against the sensor: h' = -w x h. With h = C m - b', b' = C b,

    r = [w - w_b]x (C m - b') + C m'        ([R], [M])
    dr/dc = [w - w_b]x S(m) + S(m'),   dr/db' = -[w - w_b]x,   dr/dw_b = [C m - b']x

S(v) c = symmetric(c) v. Checked numerically in tests/baselines/test_methods_jacobians.py.

Field, rate and the field's derivative are found segment by segment. "median" is the seeds' way:
first differences (m_k - m_(k-1)) / dt_k beside m_k and w_k; over a window of theta samples the
median of each. The difference belongs to the middle of the step and m_k to its end: half a sample
apart, as published. "savgol" smooths readings and rates with a Savitzky-Golay filter of order 2
(the authors' notebooks do so), then takes difference, mid-step field and rate, which all belong to
the middle of the step; per window their mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from ahrsd import so3
from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.soft_iron import answer
from ahrsd.estimator.chain import symmetric, symmetric_columns
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


Shape = Callable[[Array], tuple[Array, Array]]


def residual(kin: Kinematics, c6: Array, pseudo: Array, bias: Array) -> tuple[Array, Array]:
    """r (3n,) in gauss/s and its derivative (3n, 12) by [c (6), b' (3), w_b (3)]."""
    K = so3.skew(kin.rate - bias)
    C = symmetric(c6)
    h = kin.field @ C - pseudo
    r = np.einsum("nij,nj->ni", K, h) + kin.derivative @ C
    J = np.empty((len(kin), 3, 12))
    J[:, :, :6] = K @ symmetric_columns(kin.field) + symmetric_columns(kin.derivative)
    J[:, :, 6:9] = -K
    J[:, :, 9:] = so3.skew(h)
    return r.ravel(), J.reshape(-1, 12)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Numbers x = [p of the soft iron, b' (3), w_b (3)] and how p becomes C.

    nodes: lengths of the graph's variables, which together are x
    norm:  whether a factor |C|_F - 1 fixes the scale
    """

    shape: Shape
    start: Array
    nodes: tuple[int, ...]
    norm: bool

    def residual(self, kin: Kinematics, x: Array) -> tuple[Array, Array]:
        """r (3n,) and dr/dx (3n, len(x))."""
        c6, J6 = self.shape(x[:-6])
        r, J = residual(kin, c6, x[-6:-3], x[-3:])
        return r, np.hstack([J[:, :6] @ J6, J[:, 6:]])

    def norm_residual(self, x: Array) -> tuple[Array, Array]:
        """|C|_F - 1 (1,) and its derivative (1, len(x))."""
        c6, J6 = self.shape(x[:-6])
        twice = c6 * _COUNTED
        size = float(np.sqrt(c6 @ twice))
        J = np.zeros((1, len(x)))
        J[0, :-6] = twice @ J6 / size
        return np.array([size - 1.0]), J

    def fit(self, x: Array, iterations: int, note: str = "") -> MethodFit:
        """The answer at x.  MethodError where it is not one."""
        A, b = answer(self.shape(x[:-6])[0], x[-6:-3])
        return MethodFit(A, b, x[-3:].copy(), iterations, note)


_COUNTED = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])  # how often each term stands in the matrix
