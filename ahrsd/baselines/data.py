"""What every published method takes and what it gives back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from ahrsd.samples import Array

Derivative = Literal["median", "savgol"]
Constraint = Literal["trace", "fang"]


class MethodError(ValueError):
    """A method has no answer for these data; the text says why in one line."""


@dataclass(frozen=True, slots=True, eq=False)
class MethodData:
    """N samples in the sensor frame, raw, in segments that no gap interrupts.

    time_s (N,), dt_s (N,)    instants, and the step that ends at each; dt_s is not used at a start
    raw_b_gauss (N, 3)        m = A h + b + noise
    gyro_b_rad_s (N, 3)       mean rate over the step that ends at the sample, with its bias
    starts                    row of each segment's first sample, ascending, beginning with 0
    accel_b_m_s2 (N, 3)       specific force, or None
    R_nb (N, 3, 3)            attitude, or None
    field_n_gauss (3,)        the local field in north, east, down, or None
    field_norm_gauss          its magnitude, one number or (N,); None where nobody knows
    """

    time_s: Array
    dt_s: Array
    raw_b_gauss: Array
    gyro_b_rad_s: Array
    starts: tuple[int, ...] = (0,)
    accel_b_m_s2: Array | None = None
    R_nb: Array | None = None
    field_n_gauss: Array | None = None
    field_norm_gauss: float | Array | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def segments(self) -> Iterator[slice]:
        """The rows of each segment."""
        for first, last in zip(self.starts, (*self.starts[1:], len(self)), strict=True):
            yield slice(first, last)

    def field_norms(self) -> Array:
        """|H_k| of every sample, (N,).  MethodError where it is not known."""
        known = self.field_norm_gauss
        if known is None and self.field_n_gauss is not None:
            known = float(np.linalg.norm(self.field_n_gauss))
        if known is None:
            raise MethodError("needs the field's magnitude: give position and date, or the field")
        norms = np.asarray(known, dtype=np.float64)
        if norms.shape not in ((), (len(self),)):
            raise MethodError(f"the field's magnitude has {norms.shape}: one or {len(self)}")
        if not np.all(norms > 0) or not np.isfinite(norms).all():
            raise MethodError("the field's magnitude must be a positive number of gauss")
        return np.asarray(np.broadcast_to(norms, (len(self),)))


def _zero() -> Array:
    return np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class MethodSettings:
    """What the publications leave to the user; the defaults are theirs.

    sigma_mag_gauss:   noise of one reading per axis; None: measured on the data [None]
    sigma_field_gauss: noise of the given |H_k|, one number or (N,), for np-uncertain-field [1.5e-3,
                       about the world magnetic model's error of the total intensity]
    known_gyro_bias_rad_s: for magical-ls, which does not estimate it [0]
    derivative:        "median" as in the seeds: first differences, their median per window.
                       "savgol": readings smoothed by a Savitzky-Golay filter first
    ellipsoid_constraint: "trace": a + b + c = -3, as [R]. "fang": 4 a b - (2 h)^2 = 1, as Fang et
                       al.; far better where z varies little ["trace"]
    window:            theta, samples per factor [25]
    update_every:      Gamma, factors per optimisation of the incremental methods [10]
    savgol_window:     samples of the Savitzky-Golay filter, of order 2 [51]
    relinearize:       iSAM2's threshold of movement for linearising again; 0 for never, None for
                       the method's own: never in magical-ifg, 0.1 (GTSAM's) in magyc-ifg [None]
    """

    sigma_mag_gauss: float | None = None
    sigma_field_gauss: float | Array = 1.5e-3
    known_gyro_bias_rad_s: Array = field(default_factory=_zero)
    derivative: Derivative = "median"
    ellipsoid_constraint: Constraint = "trace"
    window: int = 25
    update_every: int = 10
    savgol_window: int = 51
    relinearize: float | None = None

    def __post_init__(self) -> None:
        """MethodError naming the setting that cannot be."""
        positive = {
            "sigma_mag_gauss": self.sigma_mag_gauss,
            "sigma_field_gauss": self.sigma_field_gauss,
        }
        for name, value in positive.items():
            if value is not None and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
                raise MethodError(f"{name} is {value}: it must be a positive number of gauss")
        least = {"window": 2, "update_every": 1, "savgol_window": 5}
        for name, minimum in least.items():
            if getattr(self, name) < minimum:
                raise MethodError(f"{name} is {getattr(self, name)}: at least {minimum}")
        words = {"derivative": get_args(Derivative), "ellipsoid_constraint": get_args(Constraint)}
        for name, known in words.items():
            if getattr(self, name) not in known:
                raise MethodError(f"{name} is {getattr(self, name)}: one of {', '.join(known)}")


@dataclass(frozen=True, slots=True, eq=False)
class MethodFit:
    """An answer: A (3, 3), b (3,) in gauss, w_b (3,) in rad/s; None what is not estimated."""

    soft_iron: Array | None
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array | None
    iterations: int
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """What a method said. Without convergence there are no numbers and `reason` says why.

    soft_iron A is symmetric positive definite; det A = 1 unless the method knows |h|. `reason` of a
    converged result is empty or a remark. seconds is nan where no clock was given.
    """

    method: str
    soft_iron: Array | None
    hard_iron_gauss: Array | None
    gyro_bias_rad_s: Array | None
    converged: bool
    reason: str
    iterations: int
    seconds: float


def field_spread(corrected: Array) -> float:
    """Standard deviation of |h| over its mean, of corrected fields (N, 3); 0 is perfect."""
    size = np.linalg.norm(corrected, axis=1)
    return float(np.std(size) / np.mean(size))


def corrected(raw_b_gauss: Array, soft_iron: Array | None, hard_iron_gauss: Array) -> Array:
    """A^-1 (m - b) of readings (N, 3); without a soft iron m - b."""
    centred = raw_b_gauss - hard_iron_gauss
    if soft_iron is None:
        return centred
    return np.asarray(np.linalg.solve(soft_iron, centred.T).T, dtype=np.float64)
