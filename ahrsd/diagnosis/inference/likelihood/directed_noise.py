"""Noise along one direction: a source that is quicker than any course, or never comes twice alike.

A sensor's own noise is independent from axis to axis, whatever its colour, and its axes differ by a
level that is the same in every octave.  A current, or iron that moves, acts along one direction of
the sensor, in some octaves and not in others:

    covariance in octave b:  v_b (D + p_b a a^T),   D diagonal, |D| = 1, p_b >= 0
                          =  v_b L (I + q_b w w^T) L,   L = D^(1/2), w a unit vector

L and w are the likeliest; each q_b is averaged over none and a grid of sizes.  What a loud gyro
leaves is across the field, along two directions: its evidence is taken off.
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
from ahrsd.diagnosis.inference.likelihood.noise_model import octaves
from ahrsd.diagnosis.model import unit_vectors
from ahrsd.samples import Array

#: directions to begin with, of each axis and of each octave's loudest, the likeliest of them
_CLIMBS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Directed:
    """What is louder along one direction.

    level (3,): of each axis, their product 1;  along (3,): unit vector of the axes in these levels
    share (B,): q of each octave;  square (B,): mean square of the source in the residual there
    edges_hz (B + 1,): ends of the octaves;  nats: by which it is likelier
    """

    level: Array
    along: Array
    share: Array
    square: Array
    edges_hz: Array
    nats: float

    @property
    def direction(self) -> Array:
        """(3,) unit vector of the sensor along which it acts."""
        acts = self.level * self.along
        return np.asarray(acts / np.linalg.norm(acts))

    def whitening(self, band_hz: Array) -> Array:
        """(B, 3, 3) that make bands with these middles (B,) alike on all axes."""
        share = self.share[np.searchsorted(self.edges_hz[1:-1], band_hz)]
        shorter = 1.0 / np.sqrt(1.0 + share) - 1.0
        along = np.eye(3) + shorter[:, None, None] * np.outer(self.along, self.along)
        return np.asarray(along / self.level)

    def power(self, band_hz: Array, variance: Array) -> Array:
        """(B,) mean square of the source in bands with these middles.

        variance (B,): by which the residual was divided there
        """
        square = self.square[np.searchsorted(self.edges_hz[1:-1], band_hz)]
        return np.asarray(square * variance)


def directed(left: Array, field_b: Array, rate_hz: float, used: float) -> Directed:
    """The likeliest source of one direction in a residual (N, 3) of about unit variance.

    field_b: (N, 3), none where it is not known;  used: share of rows that are readings
    nats are of its odds, as those of a course that nothing names.
    """
    count = len(left)
    edges = octaves(count)
    bands = [(max(1, int(a)), int(b)) for a, b in itertools.pairwise(edges)]
    unit = unit_vectors(field_b)
    with_field = np.sum(left * unit, axis=1, keepdims=True) * unit
    whole, along = (np.asarray(dct(one, axis=0, norm="ortho")) for one in (left, with_field))
    rows = np.array([max(b - a, 1) * used for a, b in bands])
    rows[rows < priors.DIRECTED_COSINES] = 0.0
    square = np.array([whole[a:b].T @ whole[a:b] / max(b - a, 1) for a, b in bands])
    square += 1e-12 * np.eye(3)
    level, w, share, nats = _likeliest(square, rows)
    even = square / level / level[:, None]
    noise = (np.trace(even, axis1=1, axis2=2) - np.einsum("i,bij,j->b", w, even, w)) / 2.0
    source = share * noise * float(np.sum((level * w) ** 2))
    nats -= _across_field(whole, along, bands, rows)
    edges_hz = edges.astype(float) * rate_hz / (2.0 * count)
    nats += float(np.log(priors.COURSE) - np.log(priors.DIRECTIONS))
    return Directed(level, w, share, source, edges_hz, nats)


def _likeliest(square: Array, rows: Array) -> tuple[Array, Array, Array, float]:
    """Levels, direction, shares and nats, of covariances (B, 3, 3) of so many rows (B,)."""
    level, none = _climbed(lambda x: _nats(square, rows, x, None)[0], np.zeros(2))

    def worth(x: Array) -> float:
        return _nats(square, rows, x[:2], x[2:])[0]

    loudest = [np.linalg.eigh(one)[1][:, -1] for one, n in zip(square, rows, strict=True) if n]
    starts = [np.concatenate([level, one]) for one in (*np.eye(3), *loudest)]
    found = [_climbed(worth, one) for one in sorted(starts, key=worth)[-_CLIMBS:]]
    best, nats = max(found, key=lambda one: one[1])
    _, share = _nats(square, rows, best[:2], best[2:])
    return _level(best[:2]), best[2:] / np.linalg.norm(best[2:]), share, nats - none


def _climbed(worth: Callable[[Array], float], start: Array) -> tuple[Array, float]:
    """Where a smooth function of few numbers is largest, near a start, and its value there."""

    def cost(x: Array) -> float:
        return -worth(x)

    found = minimize(cost, start, method="L-BFGS-B")
    return np.asarray(found.x), -float(found.fun)


def _level(log_ratio: Array) -> Array:
    """(3,) levels whose product is 1."""
    return np.asarray(np.exp(0.5 * np.append(log_ratio, -np.sum(log_ratio))))


def _nats(square: Array, rows: Array, log_ratio: Array, w: Array | None) -> tuple[float, Array]:
    """Log likelihood and prior of the levels, each octave's power at its likeliest; its shares.

    w: direction, None where there is no source
    """
    level = _level(log_ratio)
    even = square / level / level[:, None]
    whole = np.trace(even, axis1=1, axis2=2)
    spread = np.append(log_ratio, -np.sum(log_ratio)) / priors.AXES_DIFFER
    prior = -0.5 * float(spread @ spread)
    none = -1.5 * rows * np.log(whole / 3.0)
    if w is None:
        return float(np.sum(none)) + prior, np.zeros(len(rows))
    w = w / max(float(np.linalg.norm(w)), 1e-12)
    along = np.einsum("i,bij,j->b", w, even, w)[:, None]
    grid = np.array(priors.DIRECTED_SHARES)
    power = (whole[:, None] - along + along / (1.0 + grid)) / 3.0
    each = -0.5 * rows[:, None] * (3.0 * np.log(power) + np.log1p(grid))
    terms = np.concatenate([none[:, None], each - np.log(len(grid))], axis=1) - np.log(2.0)
    total = np.logaddexp.reduce(terms, axis=1)
    there = 1.0 - np.exp(terms[:, 0] - total)
    likeliest = np.maximum(2.0 * along[:, 0] / (whole - along[:, 0]) - 1.0, 0.0)
    share = there * likeliest
    return float(np.sum(np.where(rows > 0, total, 0.0))) + prior, np.where(rows > 0, share, 0.0)


def _across_field(
    whole: Array, along: Array, bands: list[tuple[int, int]], rows: NDArray[np.float64]
) -> float:
    """Nats by which power along the field and across it differ, octave by octave, 0 at least."""
    out = 0.0
    for (a, b), count in zip(bands, rows, strict=True):
        if count == 0.0:
            continue
        own = max(float(np.sum(along[a:b] ** 2)) / (b - a), 1e-12)
        across = max(float(np.sum((whole - along)[a:b] ** 2)) / (2 * (b - a)), 1e-12)
        if across > own:
            mean = (own + 2.0 * across) / 3.0
            out += 0.5 * count * (3.0 * np.log(mean) - np.log(own) - 2.0 * np.log(across))
    return float(out)
