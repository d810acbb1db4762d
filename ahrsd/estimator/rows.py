"""Epochs as rows: what they measured, and the residuals of field and motion with derivatives.

Several epochs, each where it is to be linearised, are put in one row and handled together: a few
operations on long arrays instead of many on short ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.estimator.elimination import Index
from ahrsd.samples import Array

_ROWS = np.array([0, 0, 0, 1, 1, 2])
_COLS = np.array([0, 1, 2, 1, 2, 2])


def symmetric(m6: Array) -> Array:
    """3x3 matrix of its upper triangle row by row, [00 01 02 11 12 22]."""
    M = np.empty((3, 3))
    M[_ROWS, _COLS] = m6
    M[_COLS, _ROWS] = m6
    return M


def upper_triangle(M: Array) -> Array:
    """The inverse of `symmetric`; the lower triangle is ignored."""
    return np.asarray(M[_ROWS, _COLS])


def symmetric_columns(u: Array) -> Array:
    """d(M u)/d[M (6)] of vectors u (N, 3): (N, 3, 6)."""
    out = np.zeros((len(u), 3, 6))
    for j, (r, c) in enumerate(zip(_ROWS, _COLS, strict=True)):
        out[:, r, j] = u[:, c]
        if r != c:
            out[:, c, j] = u[:, r]
    return out


@dataclass(frozen=True, slots=True)
class Noise:
    """Per-step standard deviations: field in gauss, mean rate in rad/s."""

    mag_gauss: float
    gyro_rad_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Averaging:
    """Rows whose field is a mean over several steps (`grouping.py`).

    count (n,) steps in a row, turn (n, 3, 3) mean rotation P from the row's direction u to those of
    its steps: the row measured M P u + b with the noise of one step / sqrt(count); spread_s (n,)
    root of the sum of squared steps of time on the way from the row before: the gyro's noise;
    rate_b_rad_s (n, 3) mean of its steps.
    """

    count: Array
    turn: Array
    spread_s: Array
    rate_b_rad_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class Data:
    """What an epoch measured. Row 0 is the border shared with the previous epoch (or a fresh start,
    then `measures_first`); angle and dt of row 0 are not used.

    field_b_gauss (n, 3), angle_b_rad (n, 3), dt_s (n,), down_b (n, 3) unit or nan, time_s (n,)
    linked (n,) is 0 for rows that the gyro does not link to the row before, else 1; None: all are.
    """

    field_b_gauss: Array
    angle_b_rad: Array
    dt_s: Array
    down_b: Array
    time_s: Array
    measures_first: bool
    linked: Array | None = None
    averaging: Averaging | None = None

    def __len__(self) -> int:
        return len(self.dt_s)

    @property
    def count(self) -> Array | float:
        """Steps that a row's field is the mean of."""
        return 1.0 if self.averaging is None else self.averaging.count

    @property
    def steps(self) -> int:
        """How many steps it holds."""
        return len(self) if self.averaging is None else int(self.averaging.count.sum())

    def seen(self, directions: Array) -> Array:
        """What the field of each row is the image of: directions (n, 3) or tangents (n, 3, 2)."""
        if self.averaging is None:
            return directions
        if directions.ndim == 3:
            return np.asarray(self.averaging.turn @ directions)
        return times(self.averaging.turn, directions)

    def field_error(self, u: Array, x: Array) -> Array:
        """Field less its prediction at directions u (n, 3) and x = [M6, b]; gauss."""
        return np.asarray(self.field_b_gauss - self.seen(u) @ symmetric(x[:6]) - x[6:9])


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """An epoch and where it is to be linearised: directions u (n, 3), gyro bias (3,) in rad/s.

    weights (n,) are those of the field residuals, None for 1.
    """

    data: Data
    u: Array
    bias: Array
    noise: Noise
    weights: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Chains in one row, N rows in all; the motion into the first row of each links nothing.

    first, last (E,): where each begins and ends; per row: field_b_gauss, angle_b_rad, bias (N, 3),
    dt_s; stiff (N,) 1 / (spread of the gyro's noise), 0 where nothing links; count (N,), turn
    (N, 3, 3) or None as in `Averaging`; mag_gauss (N,) noise of a step; weights (N,) of the field;
    measured (N,) 0 where the field was counted by the epoch before.
    """

    first: Index
    last: Index
    field_b_gauss: Array
    angle_b_rad: Array
    dt_s: Array
    u: Array
    bias: Array
    stiff: Array
    count: Array
    turn: Array | None
    mag_gauss: Array
    weights: Array
    measured: Array

    @staticmethod
    def of(chains: Sequence[Chain]) -> Rows:
        """Epochs one after the other."""
        data = [c.data for c in chains]
        sizes = np.array([len(d) for d in data])
        first = np.cumsum(sizes) - sizes
        linked = np.concatenate([np.ones(len(d)) if d.linked is None else d.linked for d in data])
        linked[first] = 0.0
        own = [d.averaging for d in data]
        dt = np.concatenate([d.dt_s for d in data])
        spread, count, turn = dt, np.ones(len(dt)), None
        if any(o is not None for o in own):
            each = [
                (np.ones(n), np.broadcast_to(np.eye(3), (n, 3, 3)), d.dt_s)
                if o is None
                else (o.count, o.turn, o.spread_s)
                for d, o, n in zip(data, own, sizes, strict=True)
            ]
            count, turn, spread = (np.concatenate(own) for own in zip(*each, strict=True))
        gyro = np.repeat([c.noise.gyro_rad_s for c in chains], sizes)
        measured = np.ones(len(dt))
        measured[first] = [d.measures_first for d in data]
        weights = np.concatenate(
            [np.ones(len(c.data)) if c.weights is None else c.weights for c in chains]
        )
        return Rows(
            first,
            first + sizes - 1,
            np.concatenate([d.field_b_gauss for d in data]),
            np.concatenate([d.angle_b_rad for d in data]),
            dt,
            np.concatenate([c.u for c in chains]),
            np.repeat([c.bias for c in chains], sizes, axis=0),
            linked / (gyro * spread),
            count,
            turn,
            np.repeat([c.noise.mag_gauss for c in chains], sizes),
            weights,
            measured,
        )


def robust_weights(residual: Array, limit_gauss: Array | float) -> Array:
    """1 for residuals (n, 3) within the limit, (limit / size)^2 beyond: outliers lose weight."""
    size2 = np.maximum(np.sum(residual * residual, axis=1), 1e-24)
    return np.asarray(np.minimum(1.0, limit_gauss**2 / size2))


def times(J: Array, v: Array) -> Array:
    """J_k v_k for stacks of matrices (n, i, j) and vectors (n, j)."""
    return np.asarray((J @ v[:, :, None])[:, :, 0])


@dataclass(frozen=True, slots=True, eq=False)
class FieldPart:
    """Whitened field residuals with their derivatives: (N, 3, 12), d r/d d_k (2), x (9), r (1)."""

    J: Array
    tangents: Array
    weights: Array
    seen: Array  # (N, 2) squared sizes of the columns of M P_k T_k

    @property
    def r(self) -> Array:
        """Residuals (N, 3)."""
        return self.J[:, :, 11]

    @property
    def own(self) -> Array:
        """d r/d d_k (N, 3, 2)."""
        return self.J[:, :, :2]

    @property
    def by_x(self) -> Array:
        """d r/d x (N, 3, 9)."""
        return self.J[:, :, 2:11]


@dataclass(frozen=True, slots=True, eq=False)
class MotionPart:
    """Whitened motion residuals, (N, 2, 6): d q/d d_(k-1) (2), d q/d w_b (3), q (1).

    Row k is the motion from row k - 1 to row k; row 0 is zero. -d q/d d_k = scale I.
    """

    J: Array
    scale: Array

    @property
    def q(self) -> Array:
        """Residuals (N, 2)."""
        return self.J[:, :, 5]

    @property
    def prev(self) -> Array:
        """d q/d d_(k-1) (N, 2, 2)."""
        return self.J[:, :, :2]

    @property
    def by_bias(self) -> Array:
        """d q/d w_b (N, 2, 3)."""
        return self.J[:, :, 2:5]


def parts(rows: Rows, x: Array, outlier_sigma: float | None = None) -> tuple[FieldPart, MotionPart]:
    """Residuals of field and motion with their derivatives; see `linearise_all`."""
    frame = np.empty((len(rows.u), 3, 3))  # tangents, and the direction itself
    frame[:, :, :2], frame[:, :, 2] = so3.tangent_basis(rows.u), rows.u
    return _field(rows, frame, x, outlier_sigma), _motion(rows, frame)


def _field(rows: Rows, frame: Array, x: Array, outlier_sigma: float | None) -> FieldPart:
    seen = frame if rows.turn is None else rows.turn @ frame
    image = symmetric(x[:6]) @ seen
    error = rows.field_b_gauss - image[:, :, 2] - x[6:9]
    weights = rows.weights
    if outlier_sigma is not None:
        limit = outlier_sigma * rows.mag_gauss / np.sqrt(rows.count)
        weights = robust_weights(error, limit)
    J = np.empty((len(error), 3, 12))
    J[:, :, :2] = -image[:, :, :2]
    J[:, :, 2:8] = -symmetric_columns(seen[:, :, 2])
    J[:, :, 8:11] = -np.eye(3)
    J[:, :, 11] = error
    J *= (np.sqrt(weights * rows.count * rows.measured) / rows.mag_gauss)[:, None, None]
    own = image[:, :, :2]
    return FieldPart(J, frame[:, :, :2], weights, np.sum(own * own, axis=1))


def _motion(rows: Rows, frame: Array) -> MotionPart:
    dt = rows.dt_s[:, None]
    R, Jl = so3.exp_and_left_jacobian(rows.bias * dt - rows.angle_b_rad)
    turned = R[1:] @ frame[:-1]
    across = np.swapaxes(frame[1:, :, :2], 1, 2) * rows.stiff[1:, None, None]
    moved = across @ turned
    J = np.zeros((len(frame), 2, 6))
    J[1:, :, :2], J[1:, :, 5] = moved[:, :, :2], moved[:, :, 2]
    J[1:, :, 2:5] = -across @ so3.skew(turned[:, :, 2] * dt[1:]) @ Jl[1:]
    return MotionPart(J, rows.stiff)


def interior(field: FieldPart, motion: MotionPart) -> tuple[Array, Array, Array]:
    """Diagonal blocks, blocks above them, and the border columns x (9), bias (3), gradient."""
    scale = motion.scale[:, None, None]
    own = np.swapaxes(field.own, 1, 2) @ field.J
    prev = np.swapaxes(motion.prev[1:], 1, 2) @ motion.J[1:]
    diag = own[:, :, :2] + np.eye(2) * scale**2
    diag[:-1] += prev[:, :, :2]
    border = np.empty((len(own), 2, 13))
    border[:, :, :9] = own[:, :, 2:11]
    border[:, :, 9:] = -scale * motion.J[:, :, 2:]
    border[:, :, 12] += own[:, :, 11]
    border[:-1, :, 9:] += prev[:, :, 2:]
    return diag, -scale[1:] * np.swapaxes(motion.prev[1:], 1, 2), border
