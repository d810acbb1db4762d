"""One epoch: n field directions linked by the gyroscope, eliminated onto the shared variables.

Model of an epoch (frame b, sensor; u_k unit vectors, M = A |h|):

    field    m_k = M u_k + b + noise,                   noise_mag per axis
    motion   u_k = Exp(-(phi_k - w_b dt_k)) u_(k-1) + tangential noise of noise_gyro * dt_k

The field's magnitude is constant along the chain, because u_k stays on the sphere. So the norm
information of TWOSTEP and the rotation information of MAGYC form one likelihood, and nothing is
differentiated. Gyro noise about u_k itself has no effect and needs no state. A row may stand for
several steps (`Averaging`): then m_k = M P_k u_k + b, with less noise.

Each u_k moves in its tangent plane, u_k + T_k d_k. Gauss-Newton then gives a block tridiagonal
system in the d_k, bordered by the shared variables: x = [M (6), b (3)], the gyro bias of the epoch
(3) and the two border directions (2 + 2), which the neighbouring epochs share. A banded Cholesky
factorisation eliminates the interior; the result is one quadratic in 16 numbers, whatever n is.

Residuals and their derivatives (checked numerically in tests/estimator/test_chain.py):

    r_k = (m_k - M u_k - b) / s_m        d/dd_k = -M T_k / s_m,  d/db = -I / s_m
    q_k = T_k^T R_k u_(k-1) / (s_g dt_k) d/dd_k = -I, d/dd_(k-1) = T_k^T R_k T_(k-1),
                                         d/dw_b = -T_k^T [R_k u_(k-1)]x Jl dt_k  (all / (s_g dt_k))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.linalg.lapack import dpbtrf, dtbtrs

from ahrsd import so3
from ahrsd.samples import Array

# -- Epochs in a row, and the residuals of field and motion ----------------------------------------
#
# Epochs as rows: their measurements, and the residuals of field and motion with derivatives.
#
# Several epochs, each with its own linearisation point, are concatenated and handled together: a
# few operations on long arrays instead of many on short ones.

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
    """Rows whose field is a mean over several steps (`epoch_data.group_steps`).

    count (n,): steps in a row; turn (n, 3, 3): mean rotation P from the row's direction u to those
    of its steps, so that the row measured M P u + b with the noise of one step / sqrt(count);
    spread_s (n,): root of the sum of squared time steps since the row before, which scales the
    gyro's noise; rate_b_rad_s (n, 3): mean over its steps.
    """

    count: Array
    turn: Array
    spread_s: Array
    rate_b_rad_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class EpochData:
    """Measurements of an epoch. Row 0 is the border shared with the previous epoch, or a fresh
    start (then `measures_first`); angle and dt of row 0 are not used.

    field_b_gauss (n, 3), angle_b_rad (n, 3), dt_s (n,), down_b (n, 3) unit or nan, time_s (n,).
    linked (n,): 0 for rows that the gyro does not link to the row before, else 1; None: all are
    linked.
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
        """Number of steps averaged in each row's field."""
        return 1.0 if self.averaging is None else self.averaging.count

    @property
    def steps(self) -> int:
        """Total number of steps."""
        return len(self) if self.averaging is None else int(self.averaging.count.sum())

    def field_directions(self, directions: Array) -> Array:
        """Directions (n, 3) or tangents (n, 3, 2) after averaging, so that M times them predicts
        the field of each row.
        """
        if self.averaging is None:
            return directions
        if directions.ndim == 3:
            return np.asarray(self.averaging.turn @ directions)
        return matrix_vector(self.averaging.turn, directions)

    def field_error(self, u: Array, x: Array) -> Array:
        """Field less its prediction at directions u (n, 3) and x = [M6, b]; gauss."""
        return np.asarray(self.field_b_gauss - self.field_directions(u) @ symmetric(x[:6]) - x[6:9])


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """An epoch and its linearisation point: directions u (n, 3), gyro bias (3,) in rad/s.

    weights (n,) are those of the field residuals, None for 1.
    """

    data: EpochData
    u: Array
    bias: Array
    noise: Noise
    weights: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Concatenated chains, N rows in all; no motion links the first row of each.

    Arrays of vectors and matrices have the row as their last axis, so that `linearise_all` runs
    over long axes. first, last (E,): first and last row of each chain. Per row: field_b_gauss,
    angle_b_rad, u, bias (3, N), dt_s (N,); stiff (N,): 1 / (standard deviation of the gyro's
    noise), 0 without a link; count (N,) and turn (3, 3, N) or None, as in `Averaging`; mag_gauss
    (N,): noise of a step; weights (N,) of the field; measured (N,): 0 if the epoch before counts
    the field.
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
        """Concatenate epochs."""
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
            turn = np.ascontiguousarray(turn.transpose(1, 2, 0))
        gyro = np.repeat([c.noise.gyro_rad_s for c in chains], sizes)
        measured = np.ones(len(dt))
        measured[first] = [d.measures_first for d in data]
        weights = np.concatenate(
            [np.ones(len(c.data)) if c.weights is None else c.weights for c in chains]
        )
        return Rows(
            first,
            first + sizes - 1,
            _row_last([d.field_b_gauss for d in data]),
            _row_last([d.angle_b_rad for d in data]),
            dt,
            _row_last([c.u for c in chains]),
            np.repeat(np.array([c.bias for c in chains]).T, sizes, axis=1),
            linked / (gyro * spread),
            count,
            turn,
            np.repeat([c.noise.mag_gauss for c in chains], sizes),
            weights,
            measured,
        )


def _row_last(pieces: Sequence[Array]) -> Array:
    return np.ascontiguousarray(np.concatenate(pieces).T)


def robust_weights(residual: Array, limit_gauss: Array | float) -> Array:
    """1 for residuals (3, N) within the limit, (limit / size)^2 beyond: outliers lose weight."""
    size2 = np.maximum(np.sum(residual * residual, axis=0), 1e-24)
    return np.asarray(np.minimum(1.0, limit_gauss**2 / size2))


def matrix_vector(J: Array, v: Array) -> Array:
    """J_k v_k for stacks of matrices (n, i, j) and vectors (n, j)."""
    return np.asarray((J @ v[:, :, None])[:, :, 0])


@dataclass(frozen=True, slots=True, eq=False)
class FieldPart:
    """Whitened field residuals with their derivatives: (3, 12, N), d r/d d_k (2), x (9), r (1)."""

    J: Array
    tangents: Array
    weights: Array
    column_squares: Array  # (2, N) of M P_k T_k

    @property
    def r(self) -> Array:
        """Residuals (3, N)."""
        return self.J[:, 11]

    @property
    def by_direction(self) -> Array:
        """d r/d d_k (3, 2, N)."""
        return self.J[:, :2]

    @property
    def by_x(self) -> Array:
        """d r/d x (3, 9, N)."""
        return self.J[:, 2:11]


@dataclass(frozen=True, slots=True, eq=False)
class MotionPart:
    """Whitened motion residuals, (2, 6, N): d q/d d_(k-1) (2), d q/d w_b (3), q (1).

    Row k is the motion from row k - 1 to row k; row 0 is zero. -d q/d d_k = scale I.
    """

    J: Array
    scale: Array

    @property
    def q(self) -> Array:
        """Residuals (2, N)."""
        return self.J[:, 5]

    @property
    def by_previous(self) -> Array:
        """d q/d d_(k-1) (2, 2, N)."""
        return self.J[:, :2]

    @property
    def by_bias(self) -> Array:
        """d q/d w_b (2, 3, N)."""
        return self.J[:, 2:5]


def field_and_motion(
    rows: Rows, x: Array, outlier_sigma: float | None = None
) -> tuple[FieldPart, MotionPart]:
    """Residuals of field and motion with their derivatives; see `linearise_all`."""
    frame = so3.frames(rows.u)
    return _field_part(rows, frame, x, outlier_sigma), _motion_part(rows, frame)


def _field_part(rows: Rows, frame: Array, x: Array, outlier_sigma: float | None) -> FieldPart:
    seen = frame if rows.turn is None else np.einsum("ijn,jkn->ikn", rows.turn, frame)
    image = (symmetric(x[:6]) @ seen.reshape(3, -1)).reshape(seen.shape)
    error = rows.field_b_gauss - image[:, 2] - x[6:9, None]
    weights = rows.weights
    if outlier_sigma is not None:
        limit = outlier_sigma * rows.mag_gauss / np.sqrt(rows.count)
        weights = robust_weights(error, limit)
    scale = np.sqrt(weights * rows.count * rows.measured) / rows.mag_gauss
    J = np.zeros((3, 12, error.shape[1]))
    np.multiply(image[:, :2], -scale, out=J[:, :2])
    direction = seen[:, 2] * -scale
    for j, (r, c) in enumerate(zip(_ROWS, _COLS, strict=True)):
        J[r, 2 + j], J[c, 2 + j] = direction[c], direction[r]
    for r in range(3):
        J[r, 8 + r] = -scale
    np.multiply(error, scale, out=J[:, 11])
    own = image[:, :2]
    return FieldPart(J, frame[:, :2], weights, np.sum(own * own, axis=0))


def _motion_part(rows: Rows, frame: Array) -> MotionPart:
    dt = rows.dt_s
    R, Jl = so3.columns_exp_and_left_jacobian(rows.bias * dt - rows.angle_b_rad)
    turned = np.einsum("ijn,jkn->ikn", R[:, :, 1:], frame[:, :, :-1])
    across = frame[:, :2, 1:] * rows.stiff[1:]
    derivatives = np.einsum("jin,jkn->ikn", across, turned)
    J = np.zeros((2, 6, frame.shape[2]))
    J[:, :2, 1:], J[:, 5, 1:] = derivatives[:, :2], derivatives[:, 2]
    (x, y, z), (p, q, r) = turned[:, 2] * dt[1:], across
    by_bias = np.array([y * r - z * q, z * p - x * r, x * q - y * p])  # - across^T [R u dt]x
    np.einsum("jin,jkn->ikn", by_bias, Jl[:, :, 1:], out=J[:, 2:5, 1:])
    return MotionPart(J, rows.stiff)


def interior_blocks(field: FieldPart, motion: MotionPart) -> tuple[Array, Array, Array]:
    """Diagonal blocks (2, 2, N), blocks above them (2, 2, N - 1), and the border columns
    (2, 13, N): x (9), bias (3), gradient.
    """
    scale = motion.scale
    own = np.einsum("rin,rjn->ijn", field.by_direction, field.J)
    prev = np.einsum("rin,rjn->ijn", motion.by_previous[:, :, 1:], motion.J[:, :, 1:])
    diag = own[:, :2].copy()
    for i in range(2):
        diag[i, i] += scale**2
    diag[:, :, :-1] += prev[:, :2]
    border = np.empty((2, 13, len(scale)))
    border[:, :9] = own[:, 2:11]
    np.multiply(motion.J[:, 2:], -scale, out=border[:, 9:])
    border[:, 12] += own[:, 11]
    border[:, 9:, :-1] += prev[:, 2:]
    return diag, -scale[1:] * motion.by_previous[:, :, 1:].transpose(1, 0, 2), border


# -- The interior eliminated -----------------------------------------------------------------------
#
# Elimination of the interior of block tridiagonal chains of 2x2 blocks onto the shared variables.
#
# Several chains are handled as one with zero couplings between them. Each keeps its first and its
# last block. The Hessian of the interior is factored as L L^T (banded). With Y = L^-1 B, where B
# holds the coupling of the interior to the other variables and its gradient, the Schur complement
# subtracts Y^T Y. A step of the interior costs one more triangular solution, for one column.

Index = NDArray[np.intp]
_SHARED = 12  # columns of the shared variables; the first and the last block follow
_GRADIENT = 16


@dataclass(frozen=True, slots=True, eq=False)
class Interior:
    """L (4, 2 n) in LAPACK's lower banded storage and Y (2 n, 17), without the border blocks."""

    factor: Array
    half: Array

    def step(self, z: Array) -> Array:
        """Moves (n, 2) of the interior if the 16 numbers to which it couples move by z."""
        right = self.half[:, :_GRADIENT] @ z + self.half[:, _GRADIENT]
        solved, _ = dtbtrs(self.factor, -right[:, None], uplo="L", trans="T", overwrite_b=1)
        return np.asarray(solved.reshape(-1, 2))

    def part(self, first: int, last: int) -> Interior:
        """A copy of the rows between two border blocks, given their positions."""
        rows = slice(2 * first + 2, 2 * last)
        return Interior(self.factor[:, rows].copy(order="F"), self.half[rows].copy(order="F"))


def eliminate_interior(
    diag: Array, upper: Array, border: Array, first: Index, last: Index
) -> Interior:
    """Eliminate concatenated chains: blocks (2, 2, N), those above them (2, 2, N - 1), border (2,
    13, N).

    border: coupling to the 12 shared numbers, and the gradient; first, last: rows of each chain's
    border blocks. Those rows of the result have no meaning. LinAlgError if a direction is not
    determined.
    """
    n = diag.shape[2]
    right = np.zeros((_GRADIENT + 1, n, 2))
    right[:_SHARED] = border[:, :_SHARED].transpose(1, 2, 0)
    right[_GRADIENT] = border[:, _SHARED].T
    right[:, first], right[:, last] = 0.0, 0.0
    right[_SHARED : _SHARED + 2, first + 1] = upper[:, :, first].transpose(0, 2, 1)
    right[_SHARED + 2 : _GRADIENT, last - 1] = upper[:, :, last - 1].transpose(1, 2, 0)
    diag, upper = diag.copy(), upper.copy()
    diag[:, :, first] = diag[:, :, last] = np.eye(2)[:, :, None]
    upper[:, :, first] = upper[:, :, last - 1] = 0.0
    return Interior(*factor_and_solve_lower(diag, upper, right))


def factor_and_solve_lower(diag: Array, upper: Array, right: Array) -> tuple[Array, Array]:
    """L, banded, of a symmetric block tridiagonal matrix, and L^-1 times right (columns, N, 2)."""
    factor, info = dpbtrf(banded_storage(diag, upper), lower=1, overwrite_ab=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"directions of an epoch are not determined (dpbtrf {info})")
    half, _ = dtbtrs(factor, right.reshape(len(right), -1).T, uplo="L", overwrite_b=1)
    return factor, half


def banded_storage(diag: Array, upper: Array) -> Array:
    """Lower banded storage (4, 2n) of a symmetric block tridiagonal matrix with 2x2 blocks."""
    out = np.zeros((4, 2 * diag.shape[2]), order="F")
    out[0, 0::2], out[0, 1::2] = diag[0, 0], diag[1, 1]
    out[1, 0::2] = diag[1, 0]
    out[1, 1:-1:2] = upper[1, 0]
    out[2, 0:-2:2], out[2, 1:-2:2] = upper[0, 0], upper[1, 1]
    out[3, 0:-2:2] = upper[0, 1]
    return out


# -- An epoch's quadratic --------------------------------------------------------------------------

FIRST = slice(12, 14)
LAST = slice(14, 16)
WIDTH = 16
_COUPLED = np.r_[0:12, 16]  # of the 17 numbers, gradient last: those coupled to all directions
_FIELD = np.ix_(np.r_[0:9, 16], np.r_[0:9, 16])
_MOTION = np.ix_(np.r_[9:12, 16], np.r_[9:12, 16])


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """An epoch's cost around its linearisation point: c + g^T z + z^T H z / 2, z of WIDTH numbers.

    `cost` and the sums of squares of the whitened residuals are minimised over the interior
    directions for z = 0; tangents (3, 2, n); weights (n,) of the field residuals; column_squares
    (2, n): squared norms of the columns of M P_k T_k.
    """

    H: Array
    g: Array
    cost: float
    interior: Interior
    tangents: Array
    weights: Array
    column_squares: Array
    sum_mag: float
    sum_gyro: float
    count_mag: float
    count_gyro: float


def start_directions(M: Array, b: Array, field: Array) -> Array:
    """Directions from the field alone, normalised M^-1 (m - b), (n, 3)."""
    v = np.linalg.solve(M, (field - b).T).T
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12))


def linearise(
    data: EpochData,
    u: Array,
    x: Array,
    bias: Array,
    noise: Noise,
    *,
    weights: Array | None = None,
) -> Quadratic:
    """Quadratic of one epoch at directions u (n, 3), x = [M6, b], bias (3,) in rad/s."""
    return linearise_all([Chain(data, u, bias, noise, weights)], x)[0]


def linearise_all(
    chains: Sequence[Chain], x: Array, *, outlier_sigma: float | None = None
) -> list[Quadratic]:
    """Quadratics of several epochs at the same x = [M6, b], as concatenated chains.

    With `outlier_sigma` the weights follow the present residuals (`robust_weights`). LinAlgError if
    the directions of an epoch are not determined.
    """
    rows = Rows.of(chains)
    field, motion = field_and_motion(rows, x, outlier_sigma)
    blocks = interior_blocks(field, motion)
    interior = eliminate_interior(*blocks, rows.first, rows.last)
    ends = list(zip(rows.first.tolist(), rows.last.tolist(), strict=True))
    interiors = [interior.part(a, b) for a, b in ends]
    sums = _epoch_sums(field, motion, blocks, rows)
    sums -= np.array([part.half.T @ part.half for part in interiors])
    best = field.r + np.einsum("rin,ni->rn", field.by_direction, interior.step(np.zeros(WIDTH)))
    sum_mag = np.add.reduceat(np.sum(best**2, axis=0), rows.first)
    count_mag = 3.0 * np.add.reduceat(field.weights * rows.measured, rows.first)
    count_gyro = 2.0 * np.add.reduceat((rows.stiff > 0.0).astype(np.float64), rows.first)
    return [
        Quadratic(
            H=sums[k, :WIDTH, :WIDTH].copy(),  # a view would keep all epochs' arrays alive
            g=sums[k, :WIDTH, WIDTH].copy(),
            cost=0.5 * float(sums[k, WIDTH, WIDTH]),
            interior=interiors[k],
            tangents=field.tangents[:, :, a : b + 1].copy(),
            weights=field.weights[a : b + 1].copy(),
            column_squares=field.column_squares[:, a : b + 1].copy(),
            sum_mag=float(sum_mag[k]),
            sum_gyro=max(float(sums[k, WIDTH, WIDTH] - sum_mag[k]), 0.0),
            count_mag=float(count_mag[k]),
            count_gyro=float(count_gyro[k]),
        )
        for k, (a, b) in enumerate(ends)
    ]


def _epoch_sums(
    field: FieldPart, motion: MotionPart, blocks: tuple[Array, Array, Array], rows: Rows
) -> Array:
    """Hessian, gradient and sum of squares (E, 17, 17) of each epoch, before the elimination."""
    diag, _, border = blocks
    sums = np.zeros((len(rows.first), WIDTH + 1, WIDTH + 1))
    for k, (a, b) in enumerate(zip(rows.first, rows.last + 1, strict=True)):
        sums[k][_FIELD] = outer_sum(field.J[:, 2:, a:b])
        sums[k][_MOTION] += outer_sum(motion.J[:, 2:, a:b])
    for where, ends in ((FIRST, rows.first), (LAST, rows.last)):
        sums[:, where, where] = diag[:, :, ends].transpose(2, 0, 1)
        sums[:, where, _COUPLED] = border[:, :, ends].transpose(2, 0, 1)
        sums[:, _COUPLED, where] = border[:, :, ends].transpose(2, 1, 0)
    return sums


def outer_sum(J: Array) -> Array:
    """Sum of J_rn J_rn^T over residuals r and rows n, (i, i), of J (r, i, n)."""
    return np.asarray((J @ J.transpose(0, 2, 1)).sum(axis=0))


def move_directions(u: Array, quadratic: Quadratic, z: Array) -> Array:
    """Directions after a move z (WIDTH,) of the shared variables and borders: back-substitution."""
    step = np.empty((len(u), 2))
    step[0], step[-1] = z[FIRST], z[LAST]
    step[1:-1] = quadratic.interior.step(z)
    moved = u + np.einsum("cin,ni->nc", quadratic.tangents, step)
    return np.asarray(moved / np.sqrt(np.sum(moved * moved, axis=1, keepdims=True)))


# -- The first linearisation point -----------------------------------------------------------------
#
# A linear problem: no starting value, no iteration.
#
# Over a lag of L rows with the gyro's rotation R the corrected field must turn with the sensor:
#
#     C m_(k+L) - R C m_k - (I - R) d = 0,    d = C b
#
# linear and homogeneous in the symmetric C (6) and d (3). The noise of the field enters the
# regressors of C and adds (its variance) * D with D = 2 diag(1,2,2,1,2,1) per row triple to their
# Gram matrix, so ordinary least squares would shrink C where motion is small. The minimum of v^T G
# v / v^T D v is the errors-in-variables solution: the smallest generalised eigenvector. Sign and
# scale of C follow from det C > 0 and |C (m - b)| = 1.

_LAGS_S = (0.6, 1.8, 4.5)  # from quick turns to slow ones
_NOISE_GRAM = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])


def linear_start(epochs: Sequence[EpochData]) -> Array | None:
    """c = [M (6), b (3)] in gauss, or None if the linear problem has no valid solution."""
    gram = np.zeros((9, 9))
    rows = 0
    for data in epochs:
        orientations = _orientations_from_first(data)
        columns = symmetric_columns(data.field_b_gauss)
        piece_index = np.zeros(len(data)) if data.linked is None else np.cumsum(data.linked == 0)
        for lag_s in _LAGS_S:
            lag = max(1, round(lag_s / float(np.median(data.dt_s[1:]))))
            same = piece_index[lag:] == piece_index[:-lag]
            R = np.swapaxes(orientations[lag:], 1, 2) @ orientations[:-lag]
            regressors = np.concatenate([columns[lag:] - R @ columns[:-lag], R - np.eye(3)], axis=2)
            flat = regressors[same].reshape(-1, 9)
            gram += flat.T @ flat
            rows += int(np.count_nonzero(same))
    if rows == 0:
        return None
    return _linear_solution(gram, rows, np.vstack([d.field_b_gauss for d in epochs]))


def sphere_start(field: Array) -> Array | None:
    """c of the sphere |m - b| = r fitted linearly to (N, 3): |m|^2 = 2 m.b + (r^2 - |b|^2)."""
    centre = field.mean(axis=0)
    m = field - centre
    design = np.column_stack([2 * m, np.ones(len(m))])
    solution, _, rank, _ = np.linalg.lstsq(design, np.sum(m * m, axis=1), rcond=1e-9)
    r2 = solution[3] + solution[:3] @ solution[:3]
    if rank < 4 or r2 <= 0:
        return None
    return np.concatenate([upper_triangle(np.eye(3) * np.sqrt(r2)), solution[:3] + centre])


def mirror_hard_iron(c: Array, field: Array) -> Array:
    """c with its hard iron mirrored at the plane that best fits the fields (N, 3)."""
    centre = field.mean(axis=0)
    away = field - centre
    normal = np.linalg.eigh(away.T @ away)[1][:, 0]
    out = c.copy()
    out[6:9] += 2.0 * normal * (normal @ (centre - c[6:9]))
    return out


def _orientations_from_first(data: EpochData) -> Array:
    """R_0k of every step relative to the first of the epoch, (n, 3, 3)."""
    return so3.products(so3.exp(np.vstack([np.zeros((1, 3)), data.angle_b_rad[1:]])))


def _linear_solution(gram: Array, rows: int, field: Array) -> Array | None:
    G11, G12, G22 = gram[:6, :6], gram[:6, 6:], gram[6:, 6:]
    ridge = 1e-9 * np.trace(G22) / 3 + 1e-12
    eliminate_d = np.linalg.solve(G22 + ridge * np.eye(3), G12.T)
    reduced = G11 - G12 @ eliminate_d
    _, vectors = eigh((reduced + reduced.T) / 2, np.diag(2.0 * rows * _NOISE_GRAM))
    c6 = vectors[:, 0]
    C = symmetric(c6)
    d = -eliminate_d @ c6
    if np.trace(C) < 0:
        C, d = -C, -d
    eigenvalues = np.linalg.eigvalsh(C)
    if eigenvalues[0] <= 0.05 * eigenvalues[-1]:
        return None
    b = np.linalg.solve(C, d)
    scale = float(np.median(np.linalg.norm((field - b) @ C, axis=1)))
    if not np.isfinite(scale) or scale <= 0:
        return None
    M = np.asarray(np.linalg.inv(C / scale), dtype=np.float64)
    return np.concatenate([upper_triangle(M), b])
