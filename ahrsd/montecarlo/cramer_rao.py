"""The Cramer-Rao bound: how well anybody can calibrate from this motion and this noise.

Model (attitude and true rate of every sample are nuisance; frame b, u_k the true directions):

    field    m_k = M u_k + b + n,                  n: sigma_m per axis;  M = A |h|
    motion   u_k = Exp(-phi_k) u_(k-1),            phi_k measured as phi_k + w_b dt_k + n_g dt_k

A small d phi moves the predicted direction u by G d phi, G = T^T [u]x Jl(-phi) (2, 3), T a basis of
the plane normal to u. The turn about u itself is seen by nobody, so the true rate leaves d u_k
given u_(k-1) with information (G G^T)^-1 / (sigma_g dt)^2. That is a block tridiagonal Fisher
matrix in the directions (2 each), bordered by M, b and w_b, and its Schur complement, by a banded
Cholesky factorisation, is the information on M, b and w_b. From there to A with det A = 1, or to
A = M / |h| where |h| is known, is a change of variables.

Nuisances (`nuisances.py`) are further columns of the border, known beforehand to one unit each.

Independent of the estimator on purpose. Tested against a dense Fisher matrix, against two smoothers
over many seeds, and against figures published elsewhere (tests/montecarlo/test_bound.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded

from ahrsd import so3
from ahrsd.samples import Array

TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
FULL = tuple((i, j) for i in range(3) for j in range(3))


class UnobservableError(ValueError):
    """The motion leaves a parameter undetermined: the bound is infinite."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The truth that the bound depends on.

    field_b:      (N, 3) true field in gauss, of constant magnitude
    rate_b_rad_s: (N, 3) true mean rate over the step that ends at the sample; row 0 is not used
    dt_s:         (N,) that step; nan where the gyro does not link the sample to the one before
    """

    field_b: Array
    rate_b_rad_s: Array
    dt_s: Array

    def before(self, count: int) -> Trajectory:
        """The first `count` samples."""
        return Trajectory(self.field_b[:count], self.rate_b_rad_s[:count], self.dt_s[:count])


@dataclass(frozen=True, slots=True, eq=False)
class Nuisances:
    """What the readings hold besides the model, linear in numbers known beforehand to one unit.

    field_gauss: (N, 3, p) what one sigma of each adds to the reading of the field
    rate_rad_s:  (N, 3, q) the same of the gyro's reading; row 0 is not used
    """

    field_gauss: Array
    rate_rad_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """Smallest covariance of an unbiased estimate.

    covariance: of [A, b (3), w_b (3)]; A as its upper triangle by rows (6), or whole (9) where it
                is not symmetric. Gauss and rad/s. Singular along det A where |h| is unknown
    entries:    row and column of each of A's numbers
    """

    covariance: Array
    entries: tuple[tuple[int, int], ...]

    @property
    def hard_iron_gauss(self) -> float:
        """RMS of |b - truth|."""
        return float(np.sqrt(np.trace(self.covariance[-6:-3, -6:-3])))

    @property
    def gyro_bias_rad_s(self) -> float:
        """RMS of |w_b - truth|."""
        return float(np.sqrt(np.trace(self.covariance[-3:, -3:])))

    @property
    def soft_iron(self) -> float:
        """RMS of the Frobenius norm of A - truth."""
        symmetric = len(self.entries) == len(TRIANGLE)
        times = [2.0 if symmetric and i != j else 1.0 for i, j in self.entries]
        return float(np.sqrt(np.diag(self.covariance)[:-6] @ times))


def cramer_rao(
    trajectory: Trajectory,
    soft_iron: Array,
    noise_mag_gauss: float,
    noise_gyro_rad_s: float,
    *,
    field_known: bool = False,
    full_matrix: bool = False,
    believed: Array | None = None,
    nuisances: Nuisances | None = None,
) -> Bound:
    """The bound for A (3, 3) and the gyro bias, det A = 1 and |h| unknown.

    field_known: |h| is given and det A is free; full_matrix: A need not be symmetric, which is the
    misalignment between magnetometer and gyro. `soft_iron` is A in the units of `field_b`.
    believed: information on [M, b, w_b] that is there without data; with it the bound is that of
    the mean square error averaged over what is believed, as it is with `nuisances`, which are what
    the readings hold besides.
    Raises UnobservableError where the motion determines nothing, ValueError for a noise of zero.
    """
    for name, sigma in (("magnetometer", noise_mag_gauss), ("gyro", noise_gyro_rad_s)):
        if not (np.isfinite(sigma) and sigma > 0):
            raise ValueError(f"the bound needs a positive {name} noise, not {sigma}")
    entries = FULL if full_matrix else TRIANGLE
    size = float(np.mean(np.linalg.norm(trajectory.field_b, axis=1)))
    M = soft_iron * size
    information = _information(
        trajectory, M, entries, (noise_mag_gauss, noise_gyro_rad_s), nuisances
    )
    asked = len(entries) + 6
    if believed is not None:
        information[:asked, :asked] += believed
    information[asked:, asked:] += np.eye(len(information) - asked)
    covariance = _inverse(information)[:asked, :asked]
    J = np.eye(len(covariance))
    J[:-6, :-6] = _matrix_jacobian(M, entries, size if field_known else None)
    return Bound(J @ covariance @ J.T, entries)


def _information(
    trajectory: Trajectory,
    M: Array,
    entries: tuple[tuple[int, int], ...],
    noise: tuple[float, float],
    nuisances: Nuisances | None,
) -> Array:
    """Schur complement of the directions on [M (m), b, w_b, nuisances of field and of rate]."""
    (sm, sg), n = noise, len(trajectory.field_b)
    extra = nuisances or Nuisances(np.zeros((n, 3, 0)), np.zeros((n, 3, 0)))
    u = trajectory.field_b / np.linalg.norm(trajectory.field_b, axis=1, keepdims=True)
    T = so3.tangent_basis(u)
    own = M @ T / sm
    columns = [_matrix_columns(u, entries), _tiled(np.eye(3), n), extra.field_gauss]
    shared = np.concatenate(columns, axis=2) / sm
    here, there, by_rate = _motion(trajectory, u, T, sg)
    turned = np.concatenate([by_rate, by_rate @ extra.rate_rad_s[1:]], axis=2)
    m, p = len(entries), extra.field_gauss.shape[2]
    size = m + 6 + p + extra.rate_rad_s.shape[2]
    seen, linked = np.r_[0 : m + 3, m + 6 : m + 6 + p], np.r_[m + 3 : m + 6, m + 6 + p : size]
    diag = np.swapaxes(own, 1, 2) @ own
    diag[1:] += np.swapaxes(here, 1, 2) @ here
    diag[:-1] += np.swapaxes(there, 1, 2) @ there
    border = np.zeros((n, 2, size))
    border[:, :, seen] = np.swapaxes(own, 1, 2) @ shared
    border[1:, :, linked] += np.swapaxes(here, 1, 2) @ turned
    border[:-1, :, linked] += np.swapaxes(there, 1, 2) @ turned
    information = np.zeros((size, size))
    for which, rows in ((seen, shared), (linked, turned)):
        flat = rows.reshape(-1, len(which))
        information[np.ix_(which, which)] = flat.T @ flat
    flat = border.reshape(-1, size)
    off = np.swapaxes(here, 1, 2) @ there
    return np.asarray(information - flat.T @ solveh_banded(_banded(diag, off), flat, lower=True))


def _motion(trajectory: Trajectory, u: Array, T: Array, sg: float) -> tuple[Array, Array, Array]:
    """Whitened Jacobians of the motion residuals in d_k, d_(k-1) (n-1, 2, 2), w_b (n-1, 2, 3).

    Residual: T_k^T (u_k - Exp(-(phi_read - w_b dt)) u_(k-1)); rows that nothing links are zero.
    """
    dt = trajectory.dt_s[1:]
    linked = np.isfinite(dt)
    dt = np.where(linked, dt, 1.0)
    R, Jl = so3.exp_and_left_jacobian(-trajectory.rate_b_rad_s[1:] * dt[:, None])
    Tt = np.swapaxes(T[1:], 1, 2)
    G = Tt @ so3.skew(u[1:]) @ Jl
    whiten = np.linalg.inv(np.linalg.cholesky(G @ np.swapaxes(G, 1, 2))) / (sg * dt)[:, None, None]
    whiten = np.where(linked[:, None, None], whiten, 0.0)
    return whiten, -whiten @ Tt @ R @ T[:-1], whiten @ G * dt[:, None, None]


def _banded(diag: Array, off: Array) -> Array:
    """Lower banded storage (4, 2n); off (n-1, 2, 2) is the block in row k, column k - 1."""
    band = np.zeros((4, 2 * len(diag)))
    band[0, 0::2], band[0, 1::2] = diag[:, 0, 0], diag[:, 1, 1]
    band[1, 0::2], band[1, 1:-1:2] = diag[:, 1, 0], off[:, 0, 1]
    band[2, 0:-2:2], band[2, 1:-2:2] = off[:, 0, 0], off[:, 1, 1]
    band[3, 0:-2:2] = off[:, 1, 0]
    return band


def _matrix_columns(u: Array, entries: tuple[tuple[int, int], ...]) -> Array:
    """d(M u)/d[entries of M] of vectors (N, 3): (N, 3, len(entries))."""
    symmetric = len(entries) == len(TRIANGLE)
    out = np.zeros((len(u), 3, len(entries)))
    for column, (i, j) in enumerate(entries):
        out[:, i, column] = u[:, j]
        if symmetric and i != j:
            out[:, j, column] = u[:, i]
    return out


def _tiled(matrix: Array, count: int) -> Array:
    return np.broadcast_to(matrix, (count, *matrix.shape))


def _matrix_jacobian(M: Array, entries: tuple[tuple[int, int], ...], size: float | None) -> Array:
    """d A / d M in the entries: A = M / size, or A = M / det(M)^(1/3) where size is None."""
    volume = float(np.cbrt(np.linalg.det(M)))
    if size is not None:
        return np.eye(len(entries)) / size
    inverse = np.linalg.inv(M)
    symmetric = len(entries) == len(TRIANGLE)
    J = np.empty((len(entries), len(entries)))
    for column, (i, j) in enumerate(entries):
        dM = np.zeros((3, 3))
        dM[i, j] = 1.0
        if symmetric:
            dM[j, i] = 1.0
        dA = dM / volume - M / volume * np.trace(inverse @ dM) / 3
        J[:, column] = [dA[entry] for entry in entries]
    return J


def _inverse(information: Array) -> Array:
    """Inverse after scaling to a unit diagonal; UnobservableError where there is none."""
    scale = np.sqrt(np.diag(information).clip(min=0.0))
    if not np.all(scale > 0):
        raise UnobservableError("the motion says nothing about one of the parameters")
    scaled = information / np.outer(scale, scale)
    try:
        root = np.linalg.inv(np.linalg.cholesky((scaled + scaled.T) / 2))
    except LinAlgError as error:
        raise UnobservableError("the motion leaves some of the parameters undetermined") from error
    return np.asarray(root.T @ root / np.outer(scale, scale))
