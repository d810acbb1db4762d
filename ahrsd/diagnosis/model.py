"""The values that the parts of the diagnosis exchange.

Model of the readings, with all effects (terms):

    mag_k  = A h_k + b + sum_terms D_k theta + white noise (sigma_mag)
    gyro_k = w_k + w_b + sum_terms W_k theta + white noise (sigma_gyro)
    h_k    = Exp(-w_k dt_k) h_{k-1}                       field in body axes, |h| constant

A is symmetric with trace 3.  The field strength is thereby defined, and is part of h.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the sensors, standard deviations per sample.

    gyro_walk_rad_s_sqrt_s: random walk of the gyro's bias
    colour:  autoregression of the magnetometer's noise, e_k = sum_j colour_j e_(k-j) + white;
             empty: white.  mag_gauss is the standard deviation of e, whatever its colour
    freedom: of the Student-t that the magnetometer's white noise follows; inf: normal
    level:   (N,) standard deviation of the magnetometer's noise row by row, relative to mag_gauss;
             None: 1
    """

    mag_gauss: float
    gyro_rad_s: float
    gyro_walk_rad_s_sqrt_s: float = 0.0
    colour: tuple[float, ...] = ()
    freedom: float = float("inf")
    level: Array | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Raises ValueError for a negative standard deviation or an unstable autoregression."""
        if min(self.mag_gauss, self.gyro_rad_s, self.gyro_walk_rad_s_sqrt_s) < 0:
            raise ValueError("noise: a deviation is negative")
        if len(self.colour) and np.abs(np.roots([1.0, *(-c for c in self.colour)])).max() >= 1:
            raise ValueError("noise: the colour's autoregression is not stable")


@dataclass(frozen=True, slots=True, eq=False)
class NullModel:
    """Calibration and noise of a recording: the null model.

    soft_iron (3, 3), hard_iron_gauss (3,), gyro_bias_rad_s (3,); sigmas are per sample.
    gyro_walk_rad_s_sqrt_s: random walk of the gyro's bias, 0 for a constant bias; otherwise
    gyro_bias_rad_s is the bias at the first sample
    """

    soft_iron: Array
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array
    sigma_mag_gauss: float
    sigma_gyro_rad_s: float
    gyro_walk_rad_s_sqrt_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Derivatives of the readings by an effect's parameters, (N, 3, p); None where they are zero.

    mag:  d mag_b_gauss / d theta, at constant field in body axes
    gyro: d gyro_b_rad_s / d theta, at constant true rate
    """

    mag: Array | None = None
    gyro: Array | None = None

    @property
    def width(self) -> int:
        """Number of parameters, p."""
        side = self.gyro if self.mag is None else self.mag
        return 0 if side is None else int(side.shape[2])

    @property
    def on_mag(self) -> bool:
        """Whether the effect acts on the magnetometer."""
        return self.mag is not None

    @property
    def on_gyro(self) -> bool:
        """Whether the effect acts on the gyro."""
        return self.gyro is not None


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """The recording under the present model: all that an effect may build its columns from.

    model:        calibration and noise at which everything is linearised
    field_b:      (N, 3) gauss, true field in body axes, predicted from earlier readings
                  (A field_b + b ~ mag).  Columns made of it row by row share no noise with the
                  innovation; otherwise the innovation would partly explain itself
    smooth_b:     (N, 3) the same smoothed forwards and backwards: for columns of its differences
    rate_b_rad_s: (N, 3) true rate: gyro minus bias and effects, smoothed with zero phase; it shares
                  next to no noise with a single innovation
    others_rate_b_rad_s: (N, 3) the same without each row's own part: for columns that are the
                  rate row by row, which must share no noise with the innovation; None: rate_b_rad_s
    field_dot_b:  (N, 3) gauss/s, smooth_b x rate_b_rad_s
    R_nb:         (N, 3, 3) body to a world-fixed frame.  Where there is an accelerometer it is
                  level, with down along +z (`world_levelled`); else its orientation is unknown
    force_b_m_s2: (N, 3) specific force without the accelerometer's noise, None without one
    """

    track: Track
    model: NullModel
    field_b: Array
    smooth_b: Array
    rate_b_rad_s: Array
    field_dot_b: Array
    R_nb: Array
    world_levelled: bool
    force_b_m_s2: Array | None = None
    others_rate_b_rad_s: Array | None = None

    @property
    def rowwise_rate_b_rad_s(self) -> Array:
        """(N, 3) rates for columns that are the rate, row by row."""
        others = self.others_rate_b_rad_s
        return self.rate_b_rad_s if others is None else others

    @property
    def heading_rad(self) -> Array:
        """(N,) direction of the body's x axis in R_nb's level plane, from its x to its y."""
        return np.asarray(np.arctan2(self.R_nb[:, 1, 0], self.R_nb[:, 0, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One effect in a fitted model.

    setting: the effect's non-linear choices (onset, time constant, covariate, ...), JSON-able
    value, deviation: (p,) parameters and standard deviations, units of the effect's parameters
    """

    identifier: str
    value: Array
    deviation: Array
    setting: dict[str, Any] = field(default_factory=dict)


def unit_vectors(vectors: Array) -> Array:
    """(N, 3) unit vectors; zeros where a vector is zero or not finite."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    known = (size > 0.0) & np.isfinite(size)
    return np.asarray(np.where(known, vectors, 0.0) / np.where(known, size, 1.0))
