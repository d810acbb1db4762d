"""What register 23 and register 84 apply, what an estimate says, and how the two compose.

Register 23 (VN-100 manual, magnetometer compensation):   out = C (in - B)
Register 84 (gyro compensation), the same form:           out = C (in - B)

Undoing:     in = C^-1 out + B;   with the reference frame rotation R of register 26 behind it,
             u = R C (m - B)  =>  m = C^-1 R^T u + B.
Composition: a fit (C2, B2) on data that already passed (C1, B1) gives C' = C2 C1 and
             B' = B1 + C1^-1 B2, because C2 (C1 (m - B1) - B2) = C2 C1 (m - (B1 + C1^-1 B2)).
Checked by tests/vocabulary/test_calibration.py.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field

import numpy as np

from ahrsd.samples import Array


def _frozen(value: Array, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"expected shape {shape}, got {array.shape}")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """One compensation register: out = matrix @ (in - offset).  matrix (3, 3), offset (3,)."""

    matrix: Array
    offset: Array
    _inverse: Array | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _frozen(self.matrix, (3, 3)))
        object.__setattr__(self, "offset", _frozen(self.offset, (3,)))
        with contextlib.suppress(np.linalg.LinAlgError):  # `undo` raises it where it matters
            object.__setattr__(self, "_inverse", np.linalg.inv(self.matrix))

    @staticmethod
    def identity() -> Affine:
        """The register's factory value."""
        return Affine(np.eye(3), np.zeros(3))

    @staticmethod
    def from_register(values: tuple[float, ...]) -> Affine:
        """From the register's 12 numbers: C row by row, then B."""
        numbers = np.array(values, dtype=np.float64)
        return Affine(numbers[:9].reshape(3, 3), numbers[9:12])

    def to_register(self) -> tuple[float, ...]:
        """The register's 12 numbers: C row by row, then B."""
        return (*self.matrix.ravel().tolist(), *self.offset.tolist())

    def apply(self, vectors: Array) -> Array:
        """C (v - B) for (..., 3) vectors."""
        return np.asarray((vectors - self.offset) @ self.matrix.T)

    def undo(self, vectors: Array) -> Array:
        """C^-1 v + B for (..., 3) vectors.  LinAlgError where C is singular."""
        inverse = np.linalg.inv(self.matrix) if self._inverse is None else self._inverse
        return np.asarray(vectors @ inverse.T + self.offset)

    def after(self, first: Affine) -> Affine:
        """The single register that equals `first` and then `self`: C' = C C1, B' = B1 + C1^-1 B."""
        return Affine(
            self.matrix @ first.matrix, first.offset + np.linalg.solve(first.matrix, self.offset)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Which directions of (soft iron 6, hard iron 3, gyro bias 3) the motion determined.

    prior_ratio:  (12,) posterior sigma over prior sigma in the eigenbasis, ascending; near 1 means
                  that the data said nothing in that direction
    unobservable: words for the directions held at the prior ("hard iron z", "soft iron xx", ...)
    score:        smallest information eigenvalue scaled so that 1.0 is the gate's floor
    """

    prior_ratio: Array
    unobservable: tuple[str, ...]
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A calibration of the raw sensor with its uncertainty, as the estimator sees it now.

    soft_iron:       A (3, 3), symmetric positive definite; det A = 1 unless field_known
    hard_iron_gauss: b (3,)
    gyro_bias_rad_s: w_b (3,), of the newest epoch
    field_gauss:     |h| in the units that the correction produces
    covariance:      (12, 12) of [a00 a01 a02 a11 a12 a22, b (3), w_b (3)], inflated by the measured
                     misfit of the data; singular along det A where the scale is a gauge
    noise_mag_gauss, noise_gyro_rad_s: per-sample standard deviations found in the data
    misfit:          residual mean square over its expectation, 1 where the model explains the data
    heading_sigma_deg: worst 1-sigma heading error over the headings and tilts that were driven
    mag_lag_s:       how late the field's readings are against the gyro's, taken into account;
                     0 where the data do not ask for it
    gyro_misscaled:  share of themselves by which the gyro's angles are too small against the turns
                     of the field; 0 where they may be right
    contradicted_s:  since when the newest motion contradicts the answer, as if the iron were
                     another; None where it agrees
    widened_by:      what makes the most of the heading's sigma and what motion would shrink it;
                     empty where the sigma is small or nothing makes more than half of it
    place_gauss:     by how much the field differs with the heading, as it does where it differs
                     from place to place: rms of what is expected; it is in `covariance`. nan where
                     nobody can tell
    place_deg:       what that and all that the model leaves over make of the calibration's heading,
                     worst of the headings at the tilts that were driven, 1 sigma; it is in
                     `heading_sigma_deg`. nan as above
    gyro_correction: (3, 3) by which the gyro's reading less its bias is multiplied to turn as the
                     field does; 1 where the data do not ask for another
    gyro_covariance: (21, 21) of `covariance`'s numbers and of what else that matrix may be: turn
                     (3), scale, shape (5), as `estimator.epoch` has them. None: it is known
    """

    soft_iron: Array
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array
    field_gauss: float
    field_known: bool
    covariance: Array
    noise_mag_gauss: float
    noise_gyro_rad_s: float
    misfit: float
    heading_sigma_deg: float
    observability: Observability
    samples: int
    duration_s: float
    converged: bool
    warnings: tuple[str, ...] = field(default=())
    mag_lag_s: float = 0.0
    gyro_misscaled: float = 0.0
    contradicted_s: float | None = None
    widened_by: str = ""
    place_gauss: float = math.nan
    place_deg: float = math.nan
    gyro_correction: Array = field(default_factory=lambda: np.eye(3))
    gyro_covariance: Array | None = None

    @property
    def correction(self) -> Affine:
        """C = A^-1 and b: what turns the raw sensor's reading into the field."""
        return Affine(np.asarray(np.linalg.inv(self.soft_iron), float), self.hard_iron_gauss)

    @property
    def sigma(self) -> Array:
        """Standard deviations (12,), in the order of `covariance`."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
