"""How far a calibration is from the truth, in the figures of the theses.

hard iron, gyro bias: norm of the error ([R] Table 5.1); soft iron: Frobenius norm, and the
affine-invariant distance | log eig(A^-1 B) | (the geodesic of positive definite matrices); heading:
RMS over the trajectory ([R] Table 5.2); field spread: standard deviation of the corrected field's
magnitude over its mean ([R] 4.4); constraint: RMS of that magnitude less |h| ([L]'s constraint
error); NEES: e^T P^-1 e, whose mean is its degrees of freedom
where the covariance P is honest. Every soft iron is taken to det A = 1 first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ahrsd.calibration import Affine, Estimate
from ahrsd.heading import tilt_compensated_heading, wrapped
from ahrsd.samples import Array
from ahrsd.simulation import Experiment, Truth

_STEEPEST_SIN = float(np.sin(np.radians(80.0)))  # beyond this pitch nobody asks for a heading
_TABLE_5_2_NOISE_GAUSS = 0.010
_DIFFERENCE = 1e-6  # of A's entries and, in gauss, of b
_EVERY_FOR_BOUND = 25
_EVERY = 5  # samples: neighbours say nothing new about a heading


@dataclass(frozen=True, slots=True, eq=False)
class MethodAnswer:
    """What a method says; None where it does not estimate that part.

    soft_iron: A (3, 3), any volume; covariance: (12, 12) as `Estimate.covariance`
    """

    soft_iron: Array | None
    hard_iron_gauss: Array | None
    gyro_bias_rad_s: Array | None
    covariance: Array | None = None
    converged: bool = True

    @staticmethod
    def of(estimate: Estimate) -> MethodAnswer:
        """The estimator's answer."""
        return MethodAnswer(
            estimate.soft_iron,
            estimate.hard_iron_gauss,
            estimate.gyro_bias_rad_s,
            estimate.covariance,
            estimate.converged,
        )


def unit_volume(soft_iron: Array) -> Array:
    """A / det(A)^(1/3).  ValueError where A (3, 3) is not finite or det A <= 0."""
    if not np.isfinite(soft_iron).all():
        raise ValueError("the soft iron is not finite")
    volume = float(np.linalg.det(soft_iron))
    if volume <= 0:
        raise ValueError(f"a soft iron of determinant {volume:.3g} cannot be one")
    return np.asarray(soft_iron / np.cbrt(volume))


def geodesic(A: Array, B: Array) -> float:
    """Affine-invariant distance of two symmetric positive definite matrices.

    Raises ValueError where one is not positive definite.
    """
    ratios = eigh((A + A.T) / 2, (B + B.T) / 2, eigvals_only=True)
    if ratios[0] <= 0:
        raise ValueError("the soft iron is not positive definite")
    return float(np.linalg.norm(np.log(ratios)))


def nees(error: Array, covariance: Array, soft_iron: Array) -> float:
    """e^T P^+ e over its 11 degrees of freedom: (12,), (12, 12), A with det A = 1.

    det A = 1 takes one direction away, the gradient of det in A's upper triangle: what the
    covariance is there, is rounding. Off-diagonal entries count twice in that gradient.
    """
    gradient = np.zeros(12)
    inverse = np.linalg.inv(soft_iron)
    gradient[:6] = (inverse * (2.0 - np.eye(3)))[np.triu_indices(3)]
    scale = np.sqrt(np.diag(covariance))
    normal = gradient * scale  # in units of each parameter's sigma, which are wide apart
    _, _, Vt = np.linalg.svd(normal[None, :])
    Q = Vt[1:]
    P = Q @ (covariance / np.outer(scale, scale)) @ Q.T
    z = Q @ (error / scale)
    return float(z @ np.linalg.solve(P, z)) / len(z)


def heading_rms_deg(
    experiment: Experiment, soft_iron: Array, hard_iron_gauss: Array, noise_gauss: float = 0.0
) -> float:
    """RMS heading error over the trajectory, up to 80 deg of pitch, with level attitude known.

    The field is free of noise unless asked; the noise is the experiment's own, the same draw for
    every method.
    """
    error = _heading_errors(experiment, soft_iron, hard_iron_gauss, noise_gauss)
    return float(np.degrees(np.sqrt(np.mean(np.square(error)))))


def _heading_errors(
    experiment: Experiment,
    soft_iron: Array,
    hard_iron_gauss: Array,
    noise_gauss: float,
    every: int = _EVERY,
) -> Array:
    """In rad, of every fifth sample that is not too steep."""
    rows = slice(None, None, every)
    R_nb, field_b, truth = experiment.R_nb[rows], experiment.field_b[rows], experiment.truth
    usable = np.abs(R_nb[:, 2, 0]) < _STEEPEST_SIN
    up = -R_nb[usable, 2, :]
    field_b = field_b[usable]
    read = field_b @ truth.soft_iron.T + truth.hard_iron_gauss
    if noise_gauss > 0:
        own = experiment.samples.raw_b_gauss[0].view(np.uint64)
        read += noise_gauss * np.random.default_rng(own).standard_normal(read.shape)
    corrected = Affine(np.asarray(np.linalg.inv(soft_iron), float), hard_iron_gauss).apply(read)
    return wrapped(tilt_compensated_heading(corrected, up) - tilt_compensated_heading(field_b, up))


def expected_heading_deg(experiment: Experiment, covariance: Array, noise_gauss: float) -> float:
    """What `heading_rms_deg` is to be expected to be, of answers with this covariance (12, 12).

    To first order: the error of the exact answer, which is the reading's noise alone, and J P J^T
    over the trajectory, J by central differences in A's upper triangle and b.
    """
    truth = experiment.truth
    floor = _heading_errors(experiment, truth.soft_iron, truth.hard_iron_gauss, noise_gauss)
    columns = []
    for step in np.eye(9) * _DIFFERENCE:
        A = np.zeros((3, 3))
        A[np.triu_indices(3)] = step[:6]
        A += np.triu(A, 1).T
        b = step[6:]
        there, back = (
            _heading_errors(
                experiment,
                truth.soft_iron + s * A,
                truth.hard_iron_gauss + s * b,
                0.0,
                _EVERY_FOR_BOUND,
            )
            for s in (1.0, -1.0)
        )
        columns.append(wrapped(there - back) / (2 * _DIFFERENCE))
    J = np.column_stack(columns)
    variance = np.einsum("ni,ij,nj->n", J, covariance[:9, :9], J)
    return float(np.degrees(np.sqrt(np.mean(np.square(floor)) + np.mean(variance))))


def field_errors(
    experiment: Experiment, soft_iron: Array, hard_iron_gauss: Array
) -> tuple[float, float]:
    """Spread of the corrected field's magnitude over its mean, and RMS of magnitude less |h|."""
    truth = experiment.truth
    read = experiment.field_b[::_EVERY] @ truth.soft_iron.T + truth.hard_iron_gauss
    corrected = Affine(np.asarray(np.linalg.inv(soft_iron), float), hard_iron_gauss).apply(read)
    size = np.linalg.norm(corrected, axis=1)
    rms = float(np.sqrt(np.mean(np.square(size - truth.field_gauss))))
    return float(np.std(size) / np.mean(size)), rms


def figures(answer: MethodAnswer, experiment: Experiment) -> dict[str, float | None]:
    """All errors of an answer by name; None where the answer does not say that part.

    Raises ValueError (LinAlgError is one) where what it says is no calibration.
    """
    truth = experiment.truth
    out: dict[str, float | None] = dict.fromkeys(FIGURES)
    A, b, bias = answer.soft_iron, answer.hard_iron_gauss, answer.gyro_bias_rad_s
    for name, value, true in (
        ("hard_iron_gauss", b, truth.hard_iron_gauss),
        ("gyro_bias_rad_s", bias, truth.gyro_bias_rad_s),
    ):
        if value is not None:
            out[name] = _finite(name, float(np.linalg.norm(value - true)))
    if A is not None:
        A = unit_volume(A)
        out["soft_iron"] = float(np.linalg.norm(A - truth.soft_iron))
        out["soft_iron_geodesic"] = geodesic(A, truth.soft_iron)
    if b is not None:
        applied = np.eye(3) if A is None else A  # what would be written to the register
        for name, noise_gauss in HEADINGS.items():
            out[name] = heading_rms_deg(experiment, applied, b, noise_gauss)
        out["field_spread"], out["constraint_gauss"] = field_errors(experiment, applied, b)
    if A is not None and b is not None and bias is not None and answer.covariance is not None:
        found = Truth(A, b, bias, truth.field_gauss, 0.0, 0.0).parameters
        out["nees"] = nees(found - truth.parameters, answer.covariance, A)
    return out


def _finite(name: str, value: float) -> float:
    if not np.isfinite(value):
        raise ValueError(f"{name} is not finite")
    return value


#: name -> noise of the readings that are turned into headings, gauss
HEADINGS: Mapping[str, float] = {"heading_deg": 0.0, "heading_10mg_deg": _TABLE_5_2_NOISE_GAUSS}
#: name -> words and unit for a table, and the factor from the SI value to that unit
FIGURES: Mapping[str, tuple[str, float]] = {
    "hard_iron_gauss": ("hard iron mG", 1e3),
    "soft_iron": ("soft iron F", 1.0),
    "soft_iron_geodesic": ("geodesic", 1.0),
    "gyro_bias_rad_s": ("gyro mrad/s", 1e3),
    "heading_deg": ("heading deg", 1.0),
    "heading_10mg_deg": ("at 10 mG deg", 1.0),
    "field_spread": ("field spread", 1.0),
    "constraint_gauss": ("constraint mG", 1e3),
    "nees": ("NEES/dof", 1.0),
}
