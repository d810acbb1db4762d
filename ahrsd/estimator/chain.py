"""One epoch: n field directions linked by the gyroscope, eliminated onto what the epochs share.

Model of an epoch (frame b, sensor; u_k unit vectors, M = A |h|):

    field    m_k = M u_k + b + noise,                   noise_mag per axis
    motion   u_k = Exp(-(phi_k - w_b dt_k)) u_(k-1) + tangential noise of noise_gyro * dt_k

The field's magnitude never changes along the chain, because u_k stays on the sphere: the norm
information of TWOSTEP and the rotation information of MAGYC are one likelihood, and nothing is
differentiated. Gyro noise about u_k itself moves nothing and needs no state. A row may stand for
several steps (`Averaging`): then m_k = M P_k u_k + b, with less noise.

Each u_k moves in its tangent plane, u_k + T_k d_k. Gauss-Newton then gives a block tridiagonal
system in the d_k, bordered by what is shared: x = [M (6), b (3)], the epoch's gyro bias (3) and the
two border directions (2 + 2), which the neighbouring epochs see too. The interior is eliminated by
a banded Cholesky factorisation; what remains is one quadratic in 16 numbers, whatever n is.

Residuals and their derivatives (checked numerically in tests/test_estimator_chain.py):

    r_k = (m_k - M u_k - b) / s_m        d/dd_k = -M T_k / s_m,  d/db = -I / s_m
    q_k = T_k^T R_k u_(k-1) / (s_g dt_k) d/dd_k = -I, d/dd_(k-1) = T_k^T R_k T_(k-1),
                                         d/dw_b = -T_k^T [R_k u_(k-1)]x Jl dt_k  (all / (s_g dt_k))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpbsv

from ahrsd import so3
from ahrsd.samples import Array

SHARED = 9  # M (6) and b (3)
BIAS = slice(9, 12)
FIRST = slice(12, 14)
LAST = slice(14, 16)
WIDTH = 16

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
        return _times(self.averaging.turn, directions)

    def field_error(self, u: Array, x: Array) -> Array:
        """Field less its prediction at directions u (n, 3) and x = [M6, b]; gauss."""
        return np.asarray(self.field_b_gauss - self.seen(u) @ symmetric(x[:6]) - x[6:9])


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """An epoch's cost around its linearisation point: c + g^T z + z^T H z / 2, z of WIDTH numbers.

    `cost` and the sums of squares of the whitened residuals are those with the interior directions
    at their best for z = 0. The rest is what back-substitution needs.
    """

    H: Array
    g: Array
    cost: float
    response: Array  # interior moves for unit moves of z, and (last column) for z = 0
    tangents: Array
    sum_mag: float
    sum_gyro: float
    count_mag: float
    count_gyro: float


def start_directions(M: Array, b: Array, field: Array) -> Array:
    """Directions from the field alone, normalised M^-1 (m - b), (n, 3)."""
    v = np.linalg.solve(M, (field - b).T).T
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12))


def robust_weights(residual: Array, limit_gauss: Array | float) -> Array:
    """1 for residuals (n, 3) within the limit, (limit / size)^2 beyond: outliers lose weight."""
    size = np.linalg.norm(residual, axis=1)
    return np.asarray(np.minimum(1.0, (limit_gauss / np.maximum(size, 1e-12)) ** 2))


def linearise(
    data: Data, u: Array, x: Array, bias: Array, noise: Noise, *, weights: Array | None = None
) -> Quadratic:
    """Quadratic of one epoch at directions u (n, 3), x = [M6, b], bias (3,) in rad/s."""
    T = so3.tangent_basis(u)
    w = _weights(data, weights)
    field, motion = parts(data, u, x, bias, noise, weights)
    H, g, response = _eliminate(*interior(field, motion), *_shared_part(field, motion))
    d = np.zeros((len(u), 2))
    d[1:-1] = response[:, :, WIDTH]
    r_best = field.r + _times(field.J_own, d)
    q_best = motion.q + _times(motion.J_prev, d[:-1]) - motion.scale[:, None] * d[1:]
    sum_mag, sum_gyro = float(np.sum(r_best**2)), float(np.sum(q_best**2))
    return Quadratic(
        H=H,
        g=g,
        cost=0.5 * (sum_mag + sum_gyro),
        response=response,
        tangents=T,
        sum_mag=sum_mag,
        sum_gyro=sum_gyro,
        count_mag=3.0 * float(np.sum(w)),
        count_gyro=2.0 * float(np.count_nonzero(motion.scale)),
    )


def _weights(data: Data, weights: Array | None) -> Array:
    w = np.ones(len(data)) if weights is None else weights.copy()
    if not data.measures_first:
        w[0] = 0.0
    return w


def parts(
    data: Data, u: Array, x: Array, bias: Array, noise: Noise, weights: Array | None
) -> tuple[FieldPart, MotionPart]:
    """Whitened residuals of field and motion with their derivatives, at directions u."""
    T = so3.tangent_basis(u)
    root = np.sqrt(_weights(data, weights) * data.count) / noise.mag_gauss
    return _field(data, u, T, x, root), _motion(data, u, T, bias, noise)


@dataclass(frozen=True, slots=True, eq=False)
class FieldPart:
    """Whitened field residuals r (n, 3), d r/d d_k (n, 3, 2) and d r/d x (n, 3, 9)."""

    r: Array
    J_own: Array
    J_x: Array


@dataclass(frozen=True, slots=True, eq=False)
class MotionPart:
    """Whitened motion residuals q (n-1, 2), d q/d d_(k-1), d q/d w_b, and -d q/d d_k = scale I."""

    q: Array
    J_prev: Array
    J_bias: Array
    scale: Array


def _field(data: Data, u: Array, T: Array, x: Array, root: Array) -> FieldPart:
    M = symmetric(x[:6])
    J_x = np.zeros((len(u), 3, SHARED))
    J_x[:, :, :6] = symmetric_columns(data.seen(u))
    J_x[:, [0, 1, 2], [6, 7, 8]] = 1.0
    J_x *= -root[:, None, None]
    r = data.field_error(u, x) * root[:, None]
    return FieldPart(r, -(M @ data.seen(T)) * root[:, None, None], J_x)


def _motion(data: Data, u: Array, T: Array, bias: Array, noise: Noise) -> MotionPart:
    dt = data.dt_s[1:]
    R, Jl = so3.exp_and_left_jacobian(-(data.angle_b_rad[1:] - bias * dt[:, None]))
    turned = _times(R, u[:-1])
    spread = dt if data.averaging is None else data.averaging.spread_s[1:]
    scale = 1.0 / (noise.gyro_rad_s * spread)
    if data.linked is not None:
        scale *= data.linked[1:]
    Tt = np.swapaxes(T[1:], 1, 2) * scale[:, None, None]
    J_bias = -Tt @ so3.skew(turned) @ Jl * dt[:, None, None]
    return MotionPart(_times(Tt, turned), Tt @ R @ T[:-1], J_bias, scale)


def interior(field: FieldPart, motion: MotionPart) -> tuple[Array, Array, Array]:
    """Diagonal blocks, blocks above them, and the border columns x (9), bias (3), gradient."""
    n, scale = len(field.r), motion.scale[:, None]
    own, prev = np.swapaxes(field.J_own, 1, 2), np.swapaxes(motion.J_prev, 1, 2)
    diag = own @ field.J_own
    diag[1:] += np.eye(2) * (scale**2)[:, :, None]
    diag[:-1] += prev @ motion.J_prev
    border = np.zeros((n, 2, 13))
    border[:, :, :9] = own @ field.J_x
    border[1:, :, 9:12] -= scale[:, :, None] * motion.J_bias
    border[:-1, :, 9:12] += prev @ motion.J_bias
    border[:, :, 12] = _times(own, field.r)
    border[1:, :, 12] -= scale * motion.q
    border[:-1, :, 12] += _times(prev, motion.q)
    return diag, -scale[:, :, None] * prev, border


def _times(J: Array, v: Array) -> Array:
    """J_k v_k for stacks of matrices (n, i, j) and vectors (n, j)."""
    return np.asarray((J @ v[:, :, None])[:, :, 0])


def _shared_part(field: FieldPart, motion: MotionPart) -> tuple[Array, Array]:
    H, g = np.zeros((WIDTH, WIDTH)), np.zeros(WIDTH)
    Jx = field.J_x.reshape(-1, SHARED)
    Jb = motion.J_bias.reshape(-1, 3)
    H[:9, :9] = Jx.T @ Jx
    H[BIAS, BIAS] = Jb.T @ Jb
    g[:9] = Jx.T @ field.r.ravel()
    g[BIAS] = Jb.T @ motion.q.ravel()
    return H, g


def _eliminate(
    diag: Array, upper: Array, border: Array, H: Array, g: Array
) -> tuple[Array, Array, Array]:
    """Schur complement of the interior directions; borders FIRST and LAST stay."""
    n = len(diag)
    H[FIRST, FIRST] += diag[0]
    H[LAST, LAST] += diag[-1]
    for where, k in ((FIRST, 0), (LAST, n - 1)):
        H[where, :12] += border[k, :, :12]
        H[:12, where] += border[k, :, :12].T
        g[where] += border[k, :, 12]
    banded = band(diag[1:-1], upper[1:-1])
    right = np.zeros((n - 2, 2, WIDTH + 1))
    right[:, :, :12] = border[1:-1, :, :12]
    right[0, :, FIRST] = upper[0].T
    right[-1, :, LAST] = upper[-1]
    right[:, :, WIDTH] = border[1:-1, :, 12]
    flat = right.reshape(-1, WIDTH + 1)
    _, solved, info = dpbsv(banded, np.asfortranarray(flat), lower=1, overwrite_b=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"directions of an epoch are not determined (dpbsv {info})")
    S = flat.T @ solved
    H -= S[:WIDTH, :WIDTH]
    g -= S[:WIDTH, WIDTH]
    return H, g, -solved.reshape(n - 2, 2, WIDTH + 1)


def band(diag: Array, upper: Array) -> Array:
    """Lower banded storage (4, 2n) of a symmetric block tridiagonal matrix with 2x2 blocks."""
    n = len(diag)
    out = np.zeros((4, 2 * n))
    out[0, 0::2], out[0, 1::2] = diag[:, 0, 0], diag[:, 1, 1]
    out[1, 0::2] = diag[:, 1, 0]
    out[1, 1:-1:2] = upper[:, 1, 0]
    out[2, 0:-2:2], out[2, 1:-2:2] = upper[:, 0, 0], upper[:, 1, 1]
    out[3, 0:-2:2] = upper[:, 0, 1]
    return out


def move(u: Array, quadratic: Quadratic, z: Array) -> Array:
    """Directions after the shared quantities and borders moved by z (WIDTH,): back-substitution."""
    step = np.empty((len(u), 2))
    step[0], step[-1] = z[FIRST], z[LAST]
    step[1:-1] = quadratic.response[:, :, :WIDTH] @ z + quadratic.response[:, :, WIDTH]
    moved = u + _times(quadratic.tangents, step)
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))
