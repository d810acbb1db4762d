"""Settings of the estimator; every number with its unit, effect and default."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from ahrsd.samples import Array

MIN_EPOCH_STEPS = 64  # a shorter piece before a gap is not worth a factor


@dataclass(frozen=True, slots=True)
class Imperfections:
    """Imperfections of a kind of instrument besides iron and bias, 1 sigma each.

    turn_rad: the magnetometer's axes against the gyro's, about each axis [rad]
    lag_s: the field's reading against the gyro's [s]
    scale: the gyro's angles, common to all axes, relative [1]
    shape: each of the five numbers for differences of the gyro's scales and angles between its axes
        [1]
    bias_rad_s: change of the gyro bias over the window, each axis [rad/s]
    iron_gauss: change of the magnetometer's offset over the window, each axis [gauss]
    """

    turn_rad: float
    lag_s: float
    scale: float
    shape: float
    bias_rad_s: float
    iron_gauss: float


#: as calibrated by its maker. Chosen, and not checked against a data sheet: axes within some .05
#: deg, half a sample at 800 Hz, the remainder of a scale; a bias that changes less than any bias
#: walks
AS_SPECIFIED = Imperfections(
    turn_rad=8e-4, lag_s=6e-4, scale=3e-4, shape=3e-4, bias_rad_s=1e-5, iron_gauss=1e-4
)
#: assembled from parts, and just switched on. Chosen: a degree between two boards, filters and
#: buses, a gyro's 1 %, offsets that follow the temperature: a tenth of a degree per second, 3 mG
ASSEMBLED = Imperfections(
    turn_rad=0.02, lag_s=0.015, scale=0.01, shape=0.01, bias_rad_s=2e-3, iron_gauss=3e-3
)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Disturbances on every recording that are not due to the instrument, 1 sigma each.

    Both are time series with an independent value every `knot_s` seconds, linear in between. The
    estimator does not use these sizes: it finds them, as misfit.

    place_gauss: deviation of the field in the world from its mean, each axis: it differs by place
        [gauss]
    coloured: coloured noise of the magnetometer, each axis, over the white noise [1]
    knot_s: time between independent values [s]
    """

    place_gauss: float
    coloured: float
    knot_s: float


#: driven through a yard or the middle of a hall; coloured noise as large as the white noise. Chosen
ORDINARY = Surroundings(place_gauss=2e-3, coloured=1.0, knot_s=10.0)


#: gauss, 1 sigma of each of six numbers: dependence of the field on the heading, because position
#: goes with heading. Zero in the open; where real recordings were made, the field that differs by
#: place is 8 mG in the median and above 0.6 mG in 19 of 20 (`diagnosis/priors.py: ORDINARY`). So no
#: visible effect is no proof of a uniform field
PLACES = (1e-6, 1e-3, 5e-3, 2e-2)

Kinds = tuple[tuple[Imperfections, ...], tuple[float, ...]]
"""Kinds of instruments, and sizes of places (`PLACES`)."""


#: prior odds, against each of the others, of a gyro whose scales and axes are both of the worst
#: kind. Chosen on known motions: a handful of partly determined numbers determines their own size
#: badly, and chance must not make a better kind probable. If the motion determines nothing, the
#: mean variance is that of the worst kind, within a twentieth
_WORST_GYRO = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class Instruments:
    """Possible instruments, each at each of the places.

    sigmas (K, 19): of turn (3), lag, scale, shape (5), place (6), bias (3)
    log_prior (K,): log prior probability, up to a constant
    """

    sigmas: Array
    log_prior: Array


@lru_cache
def possible_instruments(
    kinds: tuple[Imperfections, ...], places: tuple[float, ...]
) -> Instruments:
    """All possible instruments.

    The kinds of its axes, of its lag, of its gyro's scales and of its gyro's bias are independent:
    a sensor that was mounted askew need not be late. So is the size of the place. The angles
    between the gyro's axes are of the kind of its scales or of a better one (`_gyro_kinds`).
    """
    every, prior = [], []
    for (axes, late, bias), gyro, place in product(
        product(kinds, repeat=3), _gyro_kinds(kinds), places
    ):
        (scale, apart, askew), odds = gyro
        every.append(
            (
                *[axes.turn_rad] * 3,
                late.lag_s,
                *[scale, apart, apart],
                *[askew] * 3,
                *[place] * 6,
                *[bias.bias_rad_s] * 3,
            )
        )
        prior.append(math.log(odds))
    found = Instruments(np.array(every), np.array(prior))
    for each in (found.sigmas, found.log_prior):
        each.flags.writeable = False
    return found


def _gyro_kinds(kinds: tuple[Imperfections, ...]) -> list[tuple[tuple[float, float, float], float]]:
    """Sigmas of a gyro's scale, of the differences of its scales and of the angles between its
    axes, with prior odds.

    A gyro with orthogonal axes may have wrong scales; one that was calibrated, so that its scales
    are right, has orthogonal axes.
    """
    worst = max((kind.scale for kind in kinds), default=0.0)
    return [
        (
            (scales.scale, scales.shape, angles.shape),
            _WORST_GYRO if scales is angles and scales.scale == worst else 1.0,
        )
        for scales, angles in product(kinds, repeat=2)
        if angles.scale <= scales.scale
    ]


@dataclass(frozen=True, slots=True)
class EstimatorParameters:
    """Settings of the estimator (VQF's discipline: what it does, which way it pushes, unit).

    step_rate_hz:      streams faster than this are averaged down to it; higher follows faster
                       motion and costs more [33 Hz]
    epoch_steps:       steps per epoch, one GTSAM factor each; larger loses less at the borders of
                       epochs and answers later [512]
    window_steps:      steps that are kept to be linearised again; older ones are folded into one
                       Gaussian factor. Larger is nearer to the batch answer [16384]
    bias_walk_rad_s_sqrt_s: random walk of the gyro bias; larger follows temperature faster and
                       averages less [2e-6 rad/s/sqrt(s)]
    prior_soft_iron:   1-sigma of the soft iron's entries around the device's present value, its
                       scale left free; what iron and scale factors do to a magnetometer [0.1]
    prior_hard_iron_gauss: the same for the hard iron [0.5 G]
    prior_gyro_bias_rad_s: the same for the gyro bias [0.05 rad/s]
    outlier_sigma:     field residuals beyond this many sigmas lose weight quadratically [4.6, which
                       Gaussian noise exceeds once in 10^4 samples]
    mag_noise_floor_gauss, gyro_noise_floor_rad_s: lower limits of the noise levels
    imperfections:     kinds that each imperfection of the instrument may be of; their posterior
                       widens the answer. Empty: a perfect instrument, such as a simulated one
    places:            possible sizes of a field that depends on the heading by place;
                       used only if there are imperfections [gauss]
    """

    step_rate_hz: float = 33.0
    epoch_steps: int = 512
    window_steps: int = 16384
    bias_walk_rad_s_sqrt_s: float = 2e-6
    prior_soft_iron: float = 0.1
    prior_hard_iron_gauss: float = 0.5
    prior_gyro_bias_rad_s: float = 0.05
    outlier_sigma: float = 4.6
    mag_noise_floor_gauss: float = 1e-5
    gyro_noise_floor_rad_s: float = 1e-6
    imperfections: tuple[Imperfections, ...] = (AS_SPECIFIED, ASSEMBLED)
    places: tuple[float, ...] = PLACES

    @property
    def kinds(self) -> Kinds:
        """Possible kinds of the instrument and sizes of the place."""
        return self.imperfections, self.places

    def __post_init__(self) -> None:
        """Raises ValueError naming the setting that is out of range."""
        for name in self.__slots__:
            value = getattr(self, name)
            if name in ("imperfections", "places"):
                continue
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be a positive number")
        if self.epoch_steps < MIN_EPOCH_STEPS:
            raise ValueError(f"epoch_steps is {self.epoch_steps}: at least {MIN_EPOCH_STEPS}")
        if self.window_steps < self.epoch_steps:
            raise ValueError(
                f"window_steps is {self.window_steps}: at least epoch_steps, {self.epoch_steps}"
            )
