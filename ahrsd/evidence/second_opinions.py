"""Second opinions on an estimate: two independent fits, and the gyro bias as the mean at rest.

Gyro fit (for halves of the data). With R_0k of `segments`, the corrected field of a segment must
be constant: R_0k (C m_k - c) = f_s, c = C b. This is linear in (C, c); f_s is removed by centring.
C = 0 would be a solution, so the trace of C is fixed: C = C0 + sum x_i E_i over the five traceless
symmetric E_i. Noise in the regressor m biases C towards 0 with the weight n sigma^2. Its effect on
the right-hand side is subtracted, which leaves a bias towards C0: harmless with rich motion, wanted
with poor motion. Likewise gyro drift: an error of R_0k by milliradians looks like motion, and is
counted as additional prior weight.

Magnitude fit: |C m - c| = F over symmetric C and c by Levenberg-Marquardt, in distances from the
ellipsoid. It needs no gyro and no gravity, and avoids the problems of a quadric with signs and
shapes (Fang et al. 2011 fit the quadric; its solution need not be an ellipsoid).

In directions that the motion does not determine, a prior keeps both fits at the calibration in
force; it is as wide as anything physical. With planar motion the vertical is kept, and a circle
becomes the 2-D fit by itself.

Rest, the simplest second opinion. Contiguous data are divided into bins of one second, across
segments. At rest the force is steady, the rate is small and steady, and the field is constant (a
slow steady turn has only the first two). No bias is assumed. Runs of at least three such bins
count, without one more bin at each end. The scatter of the bins gives the sigma of the mean; the
Earth's rotation (0.07 mrad/s) and a drifting bias set a floor for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.calibration import Affine
from ahrsd.evidence.segments import Nodes, Segment
from ahrsd.samples import Array

# -- Two fits --------------------------------------------------------------------------------------


_PRIOR_MATRIX = 0.3
_PRIOR_GAUSS = 0.5
_DRIFT_RAD = 2e-3  # error of the gyro's attitude within a segment: 0.1 mrad/s for half a minute
_NODES = 1000
_ITERATIONS = 60
_COST_TOLERANCE = 1e-3  # of the cost, in units of one sigma squared
_PRIOR_SIGMA = np.r_[np.full(6, _PRIOR_MATRIX), np.full(3, _PRIOR_GAUSS)]
_ELEMENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _symmetric_basis() -> Array:
    """(6, 3, 3) the elements xx, xy, xz, yy, yz, zz."""
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(_ELEMENTS):
        basis[k, i, j] = basis[k, j, i] = 1.0
    return basis


_BASIS = _symmetric_basis()
_TRACELESS = np.array(
    [_BASIS[0] - _BASIS[3], _BASIS[3] - _BASIS[5], _BASIS[1], _BASIS[2], _BASIS[4]]
)


def fit_with_gyro(nodes: Nodes, present: Affine, sigma_gauss: float) -> Affine | None:
    """Calibration from the segments of `nodes`; None if the result is no valid calibration.

    `sigma_gauss` is the noise of one node's field per axis.
    """
    C0 = (present.matrix + present.matrix.T) / 2
    E = _TRACELESS
    m, R = nodes.raw_b_gauss, nodes.R_0b
    rows = np.stack([*(m @ e for e in E), -m @ C0], axis=2)
    rows = np.concatenate([R @ rows, -R], axis=2)
    rows = (rows - nodes.mean(rows)[nodes.segment]).reshape(-1, 9)
    design, target = rows[:, [0, 1, 2, 3, 4, 6, 7, 8]], rows[:, 5]
    N, y = design.T @ design, design.T @ target
    y[:5] += len(m) * sigma_gauss**2 * np.einsum("aij,ij->a", E, C0)
    prior = sigma_gauss**2 / np.r_[np.full(5, _PRIOR_MATRIX), np.full(3, _PRIOR_GAUSS)] ** 2
    false_motion = len(m) * _DRIFT_RAD**2
    prior += false_motion * np.r_[np.full(5, np.mean(np.sum(m**2, axis=1))), np.ones(3)]
    c0 = C0 @ present.offset
    solution = _solve(N + np.diag(prior), y + prior * np.r_[np.zeros(5), c0])
    if solution is None:
        return None
    C = C0 + np.einsum("a,aij->ij", solution[:5], E)
    return _to_calibration(C, solution[5:], present)


def fit_magnitude(nodes: Nodes, present: Affine, sigma_gauss: float) -> Affine | None:
    """Ellipsoid fit to all nodes; None if it does not converge to one."""
    m = nodes.raw_b_gauss[:: max(1, len(nodes.raw_b_gauss) // _NODES)]
    middle = m.mean(axis=0)
    C0 = (present.matrix + present.matrix.T) / 2
    start = _sphere_centre(m, present, sigma_gauss)
    F = float(np.mean(np.linalg.norm((m - start) @ C0, axis=1)))
    upper = [C0[i, j] for i, j in _ELEMENTS]
    prior = np.r_[upper, C0 @ (present.offset - middle)]
    x = np.r_[upper, C0 @ (start - middle)]
    cost, N, y = _magnitude_normal_equations(m - middle, x, F, sigma_gauss, prior=prior)
    damping = 1e-3
    for _ in range(_ITERATIONS):
        step = _solve(N + damping * np.diag(np.diag(N)), y)
        if step is None:
            return None
        trial = _magnitude_normal_equations(m - middle, x + step, F, sigma_gauss, prior=prior)
        if not trial[0] <= cost:
            damping *= 10.0
            continue
        converged = cost - trial[0] < _COST_TOLERANCE
        x, (cost, N, y), damping = x + step, trial, damping / 10.0
        if converged:
            C = np.einsum("a,aij->ij", x[:6], _BASIS)
            return _to_calibration(C, x[6:] + C @ middle, present)
    return None


def _magnitude_normal_equations(
    m: Array, x: Array, F: float, sigma_gauss: float, *, prior: Array
) -> tuple[float, Array, Array]:
    """Cost, normal matrix and right-hand side at x = (C, c), with h = C m - c.

    The residual is the distance of m from the ellipsoid to first order, g / |grad g| with
    g = (F^2 - |h|^2) / 2 and grad g = -C h; in field units the fit would shrink C to shrink noise.
    """
    C = np.einsum("a,aij->ij", x[:6], _BASIS)
    h = m @ C - x[6:]
    e = h @ C
    q = np.linalg.norm(e, axis=1)[:, None]
    g = (F**2 - np.sum(h**2, axis=1)[:, None]) / 2
    f = e @ C
    by_C = -_bilinear(h, m) / q - g * (_bilinear(e, h) + _bilinear(f, m)) / q**3
    J = np.concatenate([by_C, h / q + g * f / q**3], axis=1) / sigma_gauss
    r, p = (g / q)[:, 0] / sigma_gauss, (x - prior) / _PRIOR_SIGMA
    N = J.T @ J + np.diag(_PRIOR_SIGMA**-2)
    return float(r @ r + p @ p), N, -(J.T @ r + p / _PRIOR_SIGMA)


def _bilinear(a: Array, b: Array) -> Array:
    """(N, 6) a^T E b for the six symmetric elements E."""
    columns = [a[:, i] * b[:, j] + (a[:, j] * b[:, i] if i != j else 0.0) for i, j in _ELEMENTS]
    return np.stack(columns, axis=1)


def _sphere_centre(m: Array, present: Affine, sigma_gauss: float) -> Array:
    """Centre of the sphere |m - b|^2 = F^2, linear in b, with a prior at the present one."""
    mean = m.mean(axis=0)
    d = m - mean
    square = np.sum(d**2, axis=1)
    design = 2 * d
    scale = 2 * np.sqrt(np.mean(square)) * max(sigma_gauss, 1e-4)
    weight = (scale / _PRIOR_GAUSS) ** 2
    N = design.T @ design + weight * np.eye(3)
    b = np.linalg.solve(N, design.T @ (square - square.mean()) + weight * (present.offset - mean))
    return np.asarray(b + mean)


def _solve(N: Array, y: Array) -> Array | None:
    """N^-1 y for a symmetric positive definite N; None if N is not."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    if values[0] <= 1e-13:
        return None
    return np.asarray(scale * (vectors @ ((vectors.T @ (scale * y)) / values)))


def _to_calibration(C: Array, c: Array, present: Affine) -> Affine | None:
    """Calibration of C and C b, scaled to the present determinant; None unless C is positive."""
    if np.linalg.eigvalsh(C)[0] <= 0.05:
        return None
    scale = np.cbrt(np.linalg.det(present.matrix) / np.linalg.det(C))
    return Affine(scale * C, np.asarray(np.linalg.solve(C, c), dtype=float))


# -- Rest ------------------------------------------------------------------------------------------


STILL_GYRO_RAD_S = 0.01
STILL_ACCEL_M_S2 = 0.05
STILL_BINS = 3
MOST_BIAS_RAD_S = 0.0625  # 3 deg/s of bias plus the threshold of rest
_LONGEST_BINS = 30
_TURN_GAUSS = 0.003  # between the halves of a run: more is a slow turn
_FLOOR_RAD_S = 1e-4
_JOINED_ROWS = 2.5  # averaged rows: a shorter gap is the incomplete row at a cut
_NEWEST_S = 900.0  # older rest says nothing about the present bias


@dataclass(frozen=True, slots=True, eq=False)
class Seconds:
    """One-second bins: time_s (k,), rate (k, 3), force_std (k,), field (k, 3)."""

    time_s: Array
    rate_b_rad_s: Array
    force_std_m_s2: Array
    field_b_gauss: Array


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Mean rate at rest (3,) with the sigma of that mean; nan and 0 s if there was no rest."""

    rate_b_rad_s: Array
    sigma_rad_s: float
    duration_s: float


def one_second_bins(stretch: Sequence[Segment]) -> Seconds:
    """One-second bins of contiguous segments; an incomplete last bin is left out.

    The angle into a segment's first row is not known: the rate of its next row is used for it.
    """
    time_s = np.concatenate([segment.time_s for segment in stretch])
    dt_s = np.diff(time_s)
    size = max(1, round(1.0 / float(np.median(dt_s))))
    rate = np.concatenate([segment.angle_b_rad for segment in stretch])[1:] / dt_s[:, None]
    firsts = np.cumsum([len(segment) for segment in stretch])[:-1] - 1
    rate[firsts] = rate[np.minimum(firsts + 1, len(rate) - 1)]
    whole = len(rate) // size * size
    rows = slice(1, whole + 1)
    force = np.concatenate([segment.accel_b_m_s2 for segment in stretch])[rows]
    field = np.concatenate([segment.raw_b_gauss for segment in stretch])[rows]
    return Seconds(
        time_s=time_s[rows].reshape(-1, size).mean(axis=1),
        rate_b_rad_s=rate[:whole].reshape(-1, size, 3).mean(axis=1),
        force_std_m_s2=np.linalg.norm(force.reshape(-1, size, 3).std(axis=1), axis=1),
        field_b_gauss=field.reshape(-1, size, 3).mean(axis=1),
    )


def contiguous_segments(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Segments of the newest quarter of an hour, grouped where they are contiguous.

    Segments from before a restart of the device's clock are left out.
    """
    found: list[list[Segment]] = []
    for segment in reversed(segments):
        if found and segment.time_s[-1] > found[-1][0].time_s[0]:
            break
        if segment.time_s[-1] < segments[-1].time_s[-1] - _NEWEST_S:
            break
        if found and _are_contiguous(segment, found[-1][0]):
            found[-1].insert(0, segment)
        else:
            found.append([segment])
    return found[::-1]


def _are_contiguous(before: Segment, after: Segment) -> bool:
    """Whether at most an incomplete row is missing between them."""
    usual_s = float(np.median(np.diff(before.time_s)))
    same = before.averaged == after.averaged
    return same and float(after.time_s[0] - before.time_s[-1]) < _JOINED_ROWS * usual_s


def mean_rate_at_rest(segments: Sequence[Segment]) -> Rest:
    """Mean rate at rest within the newest quarter of an hour."""
    bins = [one_second_bins(stretch) for stretch in contiguous_segments(segments)]
    newest_s = max((float(b.time_s[-1]) for b in bins if len(b.time_s)), default=0.0)
    runs = [
        b.rate_b_rad_s[i:j]
        for b in bins
        for i, j in _still_runs(b)
        if newest_s - _NEWEST_S <= b.time_s[i] <= newest_s
    ]
    if not runs:
        return Rest(np.full(3, np.nan), float("nan"), 0.0)
    rates = np.concatenate(runs)
    scatter = np.concatenate([run - run.mean(axis=0) for run in runs])
    degrees_of_freedom = max(1, len(rates) - len(runs))
    sigma = np.sqrt(np.max(np.sum(scatter**2, axis=0)) / degrees_of_freedom / len(rates))
    return Rest(rates.mean(axis=0), float(np.hypot(sigma, _FLOOR_RAD_S)), float(len(rates)))


def _still_runs(bins: Seconds) -> list[tuple[int, int]]:
    """Ranges of bins at rest, of at most half a minute: a field that drifts slowly is no turn.

    Each run has its own median rate: elsewhere the vehicle may turn just as steadily.
    """
    still = bins.force_std_m_s2 < STILL_ACCEL_M_S2
    still &= np.linalg.norm(bins.rate_b_rad_s, axis=1) < MOST_BIAS_RAD_S
    found: list[tuple[int, int]] = []
    for first, last in _runs(still):
        rate = bins.rate_b_rad_s[first:last]
        near = np.linalg.norm(rate - np.median(rate, axis=0), axis=1) < STILL_GYRO_RAD_S
        for i, j in _runs(near):
            inner = np.arange(first + i + 1, first + j - 1)  # the ends may have moved
            pieces = np.array_split(inner, max(1, -(-len(inner) // _LONGEST_BINS)))
            found += [(int(p[0]), int(p[-1]) + 1) for p in pieces if len(p) >= STILL_BINS]
    return [(i, j) for i, j in found if _drift_gauss(bins.field_b_gauss[i:j]) < _TURN_GAUSS]


def _runs(true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(int)))
    return [(int(i), int(j)) for i, j in edges.reshape(-1, 2)]


def _drift_gauss(field: Array) -> float:
    """Difference of the means of both halves: noise averages out, a steady turn does not."""
    middle = len(field) // 2
    return float(np.linalg.norm(field[middle:].mean(axis=0) - field[:middle].mean(axis=0)))
