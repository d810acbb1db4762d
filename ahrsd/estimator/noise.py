"""Noise levels from the data: a first guess from differences, then from the residuals of the chain.

Second differences of white noise have the variance 6 s^2 and remove everything that is linear over
three steps; the median of their size is robust against outliers.

In the steady chain a tangent direction with field information a and motion information b per step
has the hat value h = 1 / sqrt(1 + 4 b / a) on its field residual and 1 - h on its motion residual
(inverse of the tridiagonal matrix -b, a + 2 b, -b). So the field residuals of an epoch have 3 n -
sum h degrees of freedom and the motion residuals sum h (1 less in a chain on its own: half a mode
per tangent direction is free at its ends). Both noise levels follow by iteration (restricted
maximum likelihood at fixed calibration; tests/estimator/test_noise.py). If another gyro level was
assumed, the level found lies only part of the way to the true one: over the modes of the chain,
whose gains have the mean h and the mean square h (1 + h^2) / 2, the variance found follows the
assumed one with the exponent (1 - h^2) / 2. So the step of the logarithm is multiplied by 2 / (1 +
h^2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.estimator import chain
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.samples import Array

_MAD = 1.4826
_GYRO_LIMIT = 1.5
# ratio of the gyro's variance to the assumed one, beyond which that step is not extended
_FAR_RATIO = 1.7
_LEAST_FREEDOM = 0.2  # least share of the degrees of freedom that fitting leaves
# Degrees of freedom of the prior that shrinks an epoch's noise towards the usual one. The gyro has
# so few per epoch that its level per epoch would be mostly chance, and weighting by chance is
# biased.
_STRENGTH_MAG, _STRENGTH_GYRO = 100.0, 3000.0


@dataclass(frozen=True, slots=True)
class Residuals:
    """Sums of squares of an epoch's residuals in units of the sensors, and their degrees of
    freedom.

    The gyro's sum is extrapolated to the level at which assumed and found level agree.
    """

    mag_gauss2: float
    mag_freedom: float
    gyro_rad2_s2: float
    gyro_freedom: float


def noise_of_differences(values: Array) -> float:
    """Standard deviation of white noise on (N, 3) rows, by the median of second differences."""
    second = values[2:] - 2 * values[1:-1] + values[:-2]
    return float(_MAD * np.median(np.abs(second)) / np.sqrt(6.0))


def first_guess(data: chain.EpochData, parameters: EstimatorParameters) -> chain.Noise:
    """Noise of an epoch before its calibration is known."""
    rate = data.angle_b_rad[1:] / data.dt_s[1:, None]
    return _with_floors(
        noise_of_differences(data.field_b_gauss), noise_of_differences(rate), parameters
    )


@dataclass(frozen=True, slots=True)
class Typical:
    """Medians over the rows of an epoch: steps per state, and spread_s of `chain.Averaging`."""

    count: float
    spread_s: float

    @staticmethod
    def of(data: chain.EpochData) -> Typical:
        """The medians."""
        if data.averaging is None:
            return Typical(1.0, float(np.median(data.dt_s[1:])))
        own = data.averaging
        return Typical(float(np.median(own.count)), float(np.median(own.spread_s[1:])))


def residual_sums(
    q: chain.Quadratic, data: chain.EpochData, used: chain.Noise, typical: Typical
) -> Residuals:
    """Sums of squares of an epoch that was linearised with the noise levels `used`."""
    a = typical.count * q.column_squares / used.mag_gauss**2
    b = 1.0 / (used.gyro_rad_s * typical.spread_s) ** 2
    hat = float(np.sum(1.0 / np.sqrt(1.0 + 4.0 * b / np.maximum(a, 1e-12))))
    hat -= float(data.measures_first)
    if data.linked is not None:
        hat -= float(np.count_nonzero(data.linked[1:] == 0))
    hat = max(hat, 1.0)
    exponent = 2.0 / (1.0 + min(hat / max(q.count_gyro, 1.0), 1.0) ** 2)
    found = q.sum_gyro / hat  # over the assumed variance
    if 1.0 / _FAR_RATIO < found < _FAR_RATIO:
        found **= exponent
    return Residuals(
        q.sum_mag * used.mag_gauss**2,
        max(q.count_mag - hat, 1.0),
        found * hat * used.gyro_rad_s**2,
        hat,
    )


def pool_noise(
    found: Sequence[Residuals],
    guess: chain.Noise,
    parameters: EstimatorParameters,
    fitted: float = 0.0,
) -> chain.Noise:
    """The usual noise: all epochs pooled, without those with more than three times the median
    noise.

    fitted: degrees of freedom of the gyro's residuals that corrections of the gyro used.

    The gyro's level is limited to 1.5 times its first guess: motion between samples makes that
    guess too large already, and residuals by a wrong calibration must not count as noise of the
    gyro.
    """
    mag = np.array([(r.mag_gauss2, r.mag_freedom) for r in found])
    gyro = np.array([(r.gyro_rad2_s2, r.gyro_freedom) for r in found])
    freedom = float(gyro[:, 1].sum())
    gyro[:, 1] *= max(1.0 - fitted / freedom, _LEAST_FREEDOM)
    limit = _GYRO_LIMIT * guess.gyro_rad_s
    return _with_floors(_pooled_sigma(mag), min(_pooled_sigma(gyro), limit), parameters)


def with_gyro_floor(usual: chain.Noise, gyro_rad_s: float) -> chain.Noise:
    """The usual noise with a lower limit on the gyro's level.

    In steady motion an epoch has so little information on the gyro's noise (a few degrees of
    freedom) that the pooled level can shrink from pass to pass until the gyro counts as perfect.
    """
    return chain.Noise(usual.mag_gauss, max(usual.gyro_rad_s, gyro_rad_s))


def median_noise(guesses: Sequence[chain.Noise]) -> chain.Noise:
    """Medians of several first guesses."""
    return chain.Noise(
        float(np.median([g.mag_gauss for g in guesses])),
        float(np.median([g.gyro_rad_s for g in guesses])),
    )


def shrink_noise(
    found: Residuals, usual: chain.Noise, parameters: EstimatorParameters
) -> chain.Noise:
    """An epoch's own noise, shrunk towards the usual one: so a disturbed epoch has less weight."""
    mag = found.mag_gauss2 + _STRENGTH_MAG * usual.mag_gauss**2
    gyro = found.gyro_rad2_s2 + _STRENGTH_GYRO * usual.gyro_rad_s**2
    return _with_floors(
        float(np.sqrt(mag / (found.mag_freedom + _STRENGTH_MAG))),
        min(
            float(np.sqrt(gyro / (found.gyro_freedom + _STRENGTH_GYRO))),
            _GYRO_LIMIT * usual.gyro_rad_s,
        ),
        parameters,
    )


def _pooled_sigma(table: Array) -> float:
    variance = table[:, 0] / table[:, 1]
    usual = variance <= 9 * np.median(variance)
    return float(np.sqrt(table[usual, 0].sum() / table[usual, 1].sum()))


def _with_floors(mag: float, gyro: float, parameters: EstimatorParameters) -> chain.Noise:
    return chain.Noise(
        max(mag, parameters.mag_noise_floor_gauss), max(gyro, parameters.gyro_noise_floor_rad_s)
    )


# -- Errors that repeat with the attitude ----------------------------------------------------------
#
# Errors of the model that repeat with the attitude: averaging does not reduce them.
#
# If the field differs from place to place, an arm always moves the same way, or the sensor is
# nonlinear, the residuals depend on the sensor's direction, and a thousand samples of one attitude
# are worth one. White noise is estimated from the differences of successive fields; the excess of
# the residuals is attributed to errors of this kind. They are one unknown per visited cell of the
# sphere of directions, so the information of n samples with noise s, of which s_r repeats, shrinks
# by n s_r^2 / (cells s^2).

_BANDS, _SECTORS = 8, 12  # cells of equal area of about 22 deg
_WHITE_RATIO = 1.5  # residual variance over that of the differences, below which nothing repeats
_LEAST_SHARE = 0.005  # least share of the samples in a visited cell


class DirectionCells:
    """Number of steps in each cell of the sphere of directions."""

    def __init__(self, count: Array | None = None) -> None:
        self._count: Array = np.zeros(_BANDS * _SECTORS) if count is None else count

    @staticmethod
    def of(directions: Array, each: Array | float) -> DirectionCells:
        """From unit vectors (n, 3), each with that number of steps."""
        weights = np.broadcast_to(each, len(directions))
        cells = DirectionCells.cell_indices(directions)
        count = np.bincount(cells, weights, minlength=_BANDS * _SECTORS)
        return DirectionCells(count.astype(np.float64))

    @staticmethod
    def cell_indices(directions: Array) -> NDArray[np.intp]:
        """Cell indices (n,) of unit vectors (n, 3)."""
        band = np.minimum((directions[:, 2] + 1) / 2 * _BANDS, _BANDS - 1).astype(np.intp)
        angle = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) % 1.0
        sector = np.minimum(angle * _SECTORS, _SECTORS - 1).astype(np.intp)
        return np.asarray(band * _SECTORS + sector)

    def __add__(self, other: DirectionCells) -> DirectionCells:
        return DirectionCells(self._count + other._count)

    @property
    def steps(self) -> float:
        """Total number of steps."""
        return float(self._count.sum())

    @property
    def visited(self) -> int:
        """Number of cells with more than the least share of steps."""
        return self._above(self._count)

    @property
    def regions(self) -> int:
        """Number of visited regions of four cells, of about 45 deg."""
        grid = self._count.reshape(_BANDS // 2, 2, _SECTORS // 2, 2)
        return self._above(grid.sum(axis=(1, 3)))

    def _above(self, count: Array) -> int:
        return int(np.count_nonzero(count > _LEAST_SHARE * count.sum()))


def variance_inflation(
    cells: DirectionCells, residual_gauss: float, white_gauss: float, *, smooth: bool = False
) -> float:
    """Factor, at least 1, by which the information shrinks.

    smooth: the repeating errors are one unknown per region of 45 deg of directions, not per cell.
    """
    repeats = max(0.0, 1.0 - _WHITE_RATIO * (white_gauss / residual_gauss) ** 2)
    unknowns = cells.regions if smooth else cells.visited
    return max(1.0, repeats * cells.steps / max(unknowns, 1))


# -- Misfit that does not average out --------------------------------------------------------------
#
# Effect of misfit on an answer from many epochs: it does not average out.
#
# Disagreement of epochs beyond their noise comes from a field that differs by place, a drift, or
# the instrument. These errors may have a part that is common to all epochs, which biases the answer
# and does not show in the disagreement. The least assumption is that the common part is as large as
# the part that shows.
#
# The gradient of an epoch with information S has a covariance (misfit - 1) S beyond its noise: it
# is S^1/2 e. If e is independent in each epoch, the covariances add up to sum S; if it is common,
# to (sum S^1/2)^2. Along a direction that n epochs determine equally, the latter is n times as
# large; along one that a single epoch determines it is the same.


def covariance_with_common_errors(
    covariance: Array, epochs: Array, *, misfit: float, temper: float, folded: tuple[Array, float]
) -> Array:
    """The covariance (n, n) if the disagreement of the epochs is due to errors common to all.

    covariance: of the answer, with the information of each epoch divided by `temper`; epochs (N, n,
    n): information of each; misfit: mean square of their gradients over that of noise; folded:
    information (n, n) of the epochs that left the window, and their number, taken as alike.
    """
    if not misfit > 1.0:
        return covariance
    root = _square_root(covariance)
    folded_information, count = folded
    pieces = np.concatenate([epochs, folded_information[None] / max(count, 1.0)])
    weights = np.r_[np.ones(len(epochs)), count]
    whitened = root.T @ pieces @ root / temper
    values, vectors = np.linalg.eigh((whitened + np.swapaxes(whitened, 1, 2)) / 2)
    values = np.clip(values, 0.0, None)
    information = np.einsum("k,kij,kj,klj->il", weights, vectors, values, vectors)
    coherent = np.einsum("k,kij,kj,klj->il", weights, vectors, np.sqrt(values), vectors)
    additional = ((misfit - 1.0) * coherent @ coherent + information) / temper - information
    more_values, more_vectors = np.linalg.eigh((additional + additional.T) / 2)
    wider = more_vectors * np.clip(more_values, 0.0, None) @ more_vectors.T
    found = covariance + root @ wider @ root.T
    return np.asarray((found + found.T) / 2)


def _square_root(covariance: Array) -> Array:
    """R with R R^T = covariance, a positive definite matrix whose rows may have any units."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * (vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T)


# -- Slow residuals: by attitude, or by time -------------------------------------------------------
#
# Slow noise of the magnetometer, a field that differs with place or attitude, and a changing iron
# all leave residuals that are correlated in time. The norm of the field separates some of them
# without the gyro. An error that follows the attitude is the same whenever the sensor returns to a
# direction; noise is then independent. Noise decorrelates faster than a motion passes through
# directions, and continues while the sensor is at rest, where the place does not change.

_DECAYED = float(np.exp(-1.0))  # of the correlation, at which it counts as decayed
_APART, _APART_S = 4.0, 2.0  # correlation times, and seconds, between independent visits
_FEWEST_VISITS = 12  # repeated visits of directions, in total
_NOT_REPEATING = 0.3  # correlation of visits below which errors do not repeat
_SLOW_SHARE = 0.2  # least slow share of the residuals' variance
_LEAST_REST = 10.0  # correlation times at rest that are needed for a decision
_GOES_ON, _STOPS = 0.5, 0.1  # share of its variance at rest


@dataclass(frozen=True, slots=True)
class SlowResidual:
    """Norm of the field beyond calibration and white noise.

    size_gauss: standard deviation of its slow part
    forgets_s: its correlation time
    repeats: correlation of visits of the same directions, None if there are too few
    goes_on: whether it continues at rest, None if unknown
    """

    size_gauss: float
    forgets_s: float
    repeats: float | None
    goes_on: bool | None

    @property
    def words(self) -> str:
        """What it is and what reduces its effect; empty if it cannot be told from other causes."""
        if self.repeats is None or self.repeats > _NOT_REPEATING or self.goes_on is False:
            return ""
        slow = (
            f"the residual varies slowly ({1e3 * self.size_gauss:.1f} mG, correlation time "
            f"{self.forgets_s:.2g} s) and differs when an attitude is repeated"
        )
        if self.goes_on:
            return (
                f"the magnetometer's noise is not white: {slow}, and it continues at rest: record "
                "longer; another place does not help"
            )
        return (
            f"{slow}: either the magnetometer's noise is not white, which a longer recording "
            "averages, or the field differs along the way; a minute at rest shows which, because "
            "noise continues there"
        )


def slow_residual(c: Array, epochs: Sequence[tuple[chain.EpochData, bool]]) -> SlowResidual | None:
    """From a calibration c (9,) = [M, b] and epochs, each with whether it has motion. None if
    nothing is slow, or if it lasts as long as an epoch.
    """
    M = chain.symmetric(c[:6])
    size = float(np.cbrt(np.linalg.det(M)))
    parts = []
    for data, has_motion in epochs:
        h = np.linalg.solve(M, (data.field_b_gauss - c[6:9]).T).T
        length = np.linalg.norm(h, axis=1)
        parts.append((data, has_motion, size * (length - 1.0), h / length[:, None]))
    moving = [part for part in parts if part[1]]
    if not moving:
        return None
    step_s = float(np.median(np.concatenate([part[0].dt_s[1:] for part in moving])))
    slow_variance, lag = _slow_variance_and_time([part[2] for part in moving])
    total = float(np.mean(np.concatenate([part[2] for part in moving]) ** 2))
    if lag is None or slow_variance < _SLOW_SHARE * total:
        return None
    forgets_s = lag * step_s
    rests = [part[2] for part in parts if not part[1]]
    rested_s = sum(float(np.sum(part[0].dt_s[1:])) for part in parts if not part[1])
    goes_on = None
    if rested_s > _LEAST_REST * forgets_s:
        share = _rest_variance(rests) / slow_variance
        goes_on = True if share > _GOES_ON else False if share < _STOPS else None
    repeats = _revisit_correlation(moving, max(_APART * forgets_s, _APART_S))
    return SlowResidual(float(np.sqrt(slow_variance)), forgets_s, repeats, goes_on)


def _slow_variance_and_time(residuals_gauss: Sequence[Array]) -> tuple[float, int | None]:
    """Variance of the slow part, and its correlation time in rows; None if longer than half an
    epoch.
    """
    longest = max(len(part) for part in residuals_gauss) // 2
    slow = _lagged_covariance(residuals_gauss, 1)
    for lag in range(2, longest):
        if _lagged_covariance(residuals_gauss, lag) < _DECAYED * slow:
            return slow, lag
    return slow, None


def _lagged_covariance(parts: Sequence[Array], lag: int) -> float:
    long = [part for part in parts if len(part) > 2 * lag]
    products = [float(part[lag:] @ part[:-lag]) for part in long]
    return sum(products) / max(sum(len(part) - lag for part in long), 1)


def _rest_variance(parts: Sequence[Array]) -> float:
    """Variance of the slow part at rest, without the mean of each rest."""
    return _lagged_covariance([part - part.mean() for part in parts if len(part) > 2], 1)


def _revisit_correlation(
    parts: Sequence[tuple[chain.EpochData, bool, Array, Array]], apart_s: float
) -> float | None:
    """Correlation of the residuals at visits of the same directions, at least apart_s apart."""
    time_s = np.concatenate([data.time_s for data, *_ in parts])
    residual = np.concatenate([part[2] for part in parts])
    cell = DirectionCells.cell_indices(np.concatenate([part[3] for part in parts]))
    edges = np.flatnonzero(np.diff(cell) != 0) + 1
    begins = np.r_[0, edges]
    count = np.diff(np.r_[begins, len(cell)])
    mean = np.add.reduceat(residual, begins) / count
    when, where = time_s[begins], cell[begins]
    product = square = 0.0
    revisits = 0
    for one in np.unique(where):
        visits = np.flatnonzero(where == one)
        kept = [visits[0]]
        for k in visits[1:]:
            if when[k] - when[kept[-1]] > apart_s:
                kept.append(k)
        values = mean[kept]
        if len(values) > 1:
            revisits += len(values) - 1
            product += float((values.sum() ** 2 - values @ values) / (len(values) - 1))
            square += float(values @ values)
    return product / square if revisits >= _FEWEST_VISITS and square > 0.0 else None
