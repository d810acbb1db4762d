"""Noise along one direction: a source quicker than the Gaussian processes, or never repeating.

A sensor's own noise is independent from axis to axis, whatever its colour, and its axes differ by
levels that are the same in every octave.  A current, or iron that moves, acts along one direction
of the sensor, in some octaves and not in others:

    covariance in octave b:  v_b (D + p_b a a^T),   D diagonal, |D| = 1, p_b >= 0
                          =  v_b L (I + q_b w w^T) L,   L = D^(1/2), w a unit vector

L and w maximise the posterior; each q_b is averaged over zero and a grid of sizes.  The error of a
noisy gyro is perpendicular to the field, along two directions: its evidence is subtracted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.optimize import minimize

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.likelihood.noise_model import octave_edges
from ahrsd.diagnosis.model import unit_vectors
from ahrsd.samples import Array

#: number of starts of the maximisation: the most probable of the three axes and each octave's
#: direction of largest power
_STARTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class DirectedNoise:
    """Noise with more power along one direction.

    level (3,): of each axis, their product 1;  along (3,): unit vector of the axes in these levels
    share (B,): q of each octave;  square (B,): mean square of the source in the residual there
    edges_hz (B + 1,): edges of the octaves;  nats: log odds of the source
    """

    level: Array
    along: Array
    share: Array
    square: Array
    edges_hz: Array
    nats: float

    @property
    def direction(self) -> Array:
        """(3,) unit vector of the sensor along which the source acts."""
        acts = self.level * self.along
        return np.asarray(acts / np.linalg.norm(acts))

    def whitening(self, band_hz: Array) -> Array:
        """(B, 3, 3) matrices that equalise the noise of all axes in bands with middles band_hz."""
        share = self.share[np.searchsorted(self.edges_hz[1:-1], band_hz)]
        shrinkage = 1.0 / np.sqrt(1.0 + share) - 1.0
        along = np.eye(3) + shrinkage[:, None, None] * np.outer(self.along, self.along)
        return np.asarray(along / self.level)

    def power(self, band_hz: Array, variance: Array) -> Array:
        """(B,) mean square of the source in bands with middles band_hz.

        variance (B,): by which the residual was divided there
        """
        square = self.square[np.searchsorted(self.edges_hz[1:-1], band_hz)]
        return np.asarray(square * variance)


def fit_directed_noise(
    residual: Array, field_b: Array, rate_hz: float, used_share: float
) -> DirectedNoise:
    """The most probable source of one direction in a residual (N, 3) of about unit variance.

    field_b: (N, 3), zero where it is not known;  used_share: share of rows that are readings
    nats are its log odds, with the prior of an unexplained Gaussian process.
    """
    count = len(residual)
    edges = octave_edges(count)
    bands = [(max(1, int(a)), int(b)) for a, b in itertools.pairwise(edges)]
    unit = unit_vectors(field_b)
    along_field = np.sum(residual * unit, axis=1, keepdims=True) * unit
    cosines, along_cosines = (
        np.asarray(dct(one, axis=0, norm="ortho")) for one in (residual, along_field)
    )
    rows = np.array([max(b - a, 1) * used_share for a, b in bands])
    rows[rows < priors.DIRECTED_COSINES] = 0.0
    square = np.array([cosines[a:b].T @ cosines[a:b] / max(b - a, 1) for a, b in bands])
    square += 1e-12 * np.eye(3)
    level, w, share, nats = _fit(square, rows)
    scaled = square / level / level[:, None]
    noise = (np.trace(scaled, axis1=1, axis2=2) - np.einsum("i,bij,j->b", w, scaled, w)) / 2.0
    source = share * noise * float(np.sum((level * w) ** 2))
    nats -= _across_field_nats(cosines, along_cosines, bands, rows)
    edges_hz = edges.astype(float) * rate_hz / (2.0 * count)
    nats += float(np.log(priors.COURSE) - np.log(priors.DIRECTIONS))
    return DirectedNoise(level, w, share, source, edges_hz, nats)


def _fit(square: Array, rows: Array) -> tuple[Array, Array, Array, float]:
    """Levels, direction, shares and nats gained over no source.

    square: (B, 3, 3) covariances;  rows: (B,) their numbers of rows
    """
    log_ratio, log_null = _maximise(lambda x: _log_posterior(square, rows, x, None)[0], np.zeros(2))

    def log_posterior(x: Array) -> float:
        return _log_posterior(square, rows, x[:2], x[2:])[0]

    principal = [np.linalg.eigh(one)[1][:, -1] for one, n in zip(square, rows, strict=True) if n]
    starts = [np.concatenate([log_ratio, one]) for one in (*np.eye(3), *principal)]
    found = [_maximise(log_posterior, one) for one in sorted(starts, key=log_posterior)[-_STARTS:]]
    best, nats = max(found, key=lambda one: one[1])
    _, share = _log_posterior(square, rows, best[:2], best[2:])
    return _levels(best[:2]), best[2:] / np.linalg.norm(best[2:]), share, nats - log_null


def _maximise(objective: Callable[[Array], float], start: Array) -> tuple[Array, float]:
    """Maximum of a smooth function of few variables near a start, and its value there."""

    def cost(x: Array) -> float:
        return -objective(x)

    found = minimize(cost, start, method="L-BFGS-B")
    return np.asarray(found.x), -float(found.fun)


def _levels(log_ratio: Array) -> Array:
    """(3,) levels whose product is 1."""
    return np.asarray(np.exp(0.5 * np.append(log_ratio, -np.sum(log_ratio))))


def _log_posterior(
    square: Array, rows: Array, log_ratio: Array, w: Array | None
) -> tuple[float, Array]:
    """Log likelihood plus log prior of the levels, and the expected shares.

    Each octave's power is at its maximum.  w: direction, None for no source
    """
    level = _levels(log_ratio)
    scaled = square / level / level[:, None]
    total_power = np.trace(scaled, axis1=1, axis2=2)
    spread = np.append(log_ratio, -np.sum(log_ratio)) / priors.AXES_DIFFER
    prior = -0.5 * float(spread @ spread)
    log_null = -1.5 * rows * np.log(total_power / 3.0)
    if w is None:
        return float(np.sum(log_null)) + prior, np.zeros(len(rows))
    w = w / max(float(np.linalg.norm(w)), 1e-12)
    along = np.einsum("i,bij,j->b", w, scaled, w)[:, None]
    grid = np.array(priors.DIRECTED_SHARES)
    power = (total_power[:, None] - along + along / (1.0 + grid)) / 3.0
    source = -0.5 * rows[:, None] * (3.0 * np.log(power) + np.log1p(grid))
    terms = np.concatenate([log_null[:, None], source - np.log(len(grid))], axis=1) - np.log(2.0)
    nats = np.logaddexp.reduce(terms, axis=1)
    source_probability = 1.0 - np.exp(terms[:, 0] - nats)
    most_probable = np.maximum(2.0 * along[:, 0] / (total_power - along[:, 0]) - 1.0, 0.0)
    share = source_probability * most_probable
    return float(np.sum(np.where(rows > 0, nats, 0.0))) + prior, np.where(rows > 0, share, 0.0)


def _across_field_nats(
    cosines: Array, along_cosines: Array, bands: list[tuple[int, int]], rows: NDArray[np.float64]
) -> float:
    """Log likelihood gained by separate powers along and across the field, summed over octaves.

    An octave counts only where the power across the field is the larger one.
    """
    out = 0.0
    for (a, b), count in zip(bands, rows, strict=True):
        if count == 0.0:
            continue
        along = max(float(np.sum(along_cosines[a:b] ** 2)) / (b - a), 1e-12)
        across = max(float(np.sum((cosines - along_cosines)[a:b] ** 2)) / (2 * (b - a)), 1e-12)
        if across > along:
            mean = (along + 2.0 * across) / 3.0
            out += 0.5 * count * (3.0 * np.log(mean) - np.log(along) - 2.0 * np.log(across))
    return float(out)
