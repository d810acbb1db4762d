"""The noise: a power per octave, a level per time, and Student's law of the readings.

    e_n = a_n s_n,     s stationary, its power per octave v_b;  a_n known in each pass

The octaves consist of cosines over the whole recording, of readings divided by a_n.  v is a smooth
spectrum: its logarithm changes from octave to octave by a step with a normal prior.  So the lowest
octave, which has few cosines, cannot absorb an effect at no cost.  a_n is computed from the
residual of the richest model, never from that of the null model: it must not contain the mismatch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import gammaln

from ahrsd.diagnosis import priors
from ahrsd.samples import Array

#: median of the sum of squares of three standard normal numbers;  iterations for a scale
_MEDIAN_OF_3, _SCALE_ROUNDS = 2.366, 12


def octave_edges(count: int) -> NDArray[np.intp]:
    """(B + 1,) edges of the bands among `count` cosines, lowest first."""
    edges = [count]
    while len(edges) < priors.BANDS and edges[-1] > 32:
        edges.append(edges[-1] // 2)
    return np.array([0, *edges[::-1]], dtype=np.intp)


def insert_narrow_bands(
    edges: NDArray[np.intp], low: int, high: int, width: int
) -> tuple[NDArray[np.intp], slice]:
    """Edges with narrow bands inserted from cosine `low` to `high`, and their indices.

    width: of one band, cosines: a narrow-band source has more power in the middle than at its sides
    """
    margin = (high - low) // 2
    outside = [e for e in edges.tolist()[1:-1] if e < low - margin or e > high + margin]
    inside = np.linspace(low, high, max(1, round((high - low) / width)) + 1).round().astype(int)
    found = sorted({0, *outside, *inside.tolist(), int(edges[-1])})
    return np.array(found, dtype=np.intp), slice(found.index(low), found.index(high))


def _step_deviations(count: int, deviation: float, alone: slice | None) -> Array:
    """(B - 1,) prior deviations of the spectrum's steps; wide at the bands that are not tied."""
    out = np.full(count - 1, deviation)
    if alone is not None:
        out[max(0, alone.start - 1) : alone.stop] = priors.NOISE_TOP
    return out


def log_prior(
    log_noise: Array, deviation: float, alone: slice | None = None
) -> tuple[float, Array]:
    """Log density of the bands' log powers (B,), and its gradient.

    deviation: from octave to octave;  alone: indices of bands that may have any power
    """
    deviations = _step_deviations(len(log_noise), deviation, alone)
    step = np.diff(log_noise) / deviations
    top = log_noise[-1] / priors.NOISE_TOP
    gradient = np.zeros(len(log_noise))
    gradient[:-1] += step / deviations
    gradient[1:] -= step / deviations
    gradient[-1] -= top / priors.NOISE_TOP
    return -0.5 * float(step @ step + top**2) - float(np.sum(np.log(deviations))), gradient


def prior_curvature(count: int, deviation: float, alone: slice | None = None) -> Array:
    """(B, B) curvature of minus that log density."""
    difference = np.diff(np.eye(count), axis=0) / _step_deviations(count, deviation, alone)[:, None]
    found = difference.T @ difference
    found[-1, -1] += 1.0 / priors.NOISE_TOP**2
    return np.asarray(found)


def bounds(count: int) -> tuple[Array, Array]:
    """Lowest and highest log power of each band."""
    return np.full(count, priors.NOISE_RANGE[0]), np.full(count, priors.NOISE_RANGE[1])


@dataclass(frozen=True, slots=True, eq=False)
class NoiseLevels:
    """Noise level of each row.

    amplitude (N,): of its noise;  tails: log likelihood of the rows under Student's law, less that
    under the normal laws of these amplitudes, near the residual from which they were computed
    """

    amplitude: Array
    tails: float


def uniform_levels(rows: int) -> NoiseLevels:
    """The same level in all rows."""
    return NoiseLevels(np.ones(rows), 0.0)


def fit_noise_levels(residual: Array, used: NDArray[np.bool], rate_hz: float) -> NoiseLevels:
    """Noise levels from a residual (N, 3) that is white in time.

    The level is the moving median of the quick part alone.  A step, a current or a Gaussian process
    is slow or short, and a level that followed it would leave no evidence of it.  Relative to the
    level a row has Student's law: an outlier counts for little, and what is strong there loses most
    of its evidence but never all.
    """
    second_difference = np.diff(residual, n=2, axis=0, prepend=residual[:1], append=residual[-1:])
    rows = 2 * round(priors.LEVEL_S * rate_hz / 2) + 1
    level = median_filter(
        _mean_squares(second_difference, used), size=min(rows, len(used)), mode="nearest"
    )
    level = np.clip(level / max(float(np.median(level)), 1e-300), *priors.LEVELS)
    square = 3.0 * _mean_squares(residual, used) / level
    laws = [_fit_student(square[used], freedom) for freedom in priors.FREEDOMS]
    normal = _fit_student(square[used], np.inf)
    best = max([normal, *laws], key=lambda one: one.nats)
    weight, rows = best.weight(square), int(np.count_nonzero(used))
    normal_nats = 1.5 * (np.sum(np.log(weight[used])) - rows * np.log(2 * np.pi * best.scale))
    normal_nats -= 0.5 * np.sum(weight[used] * square[used]) / best.scale
    return NoiseLevels(np.sqrt(level * best.scale / weight), float(best.nats - normal_nats))


@dataclass(frozen=True, slots=True)
class _Student:
    """Student's law of three numbers with `freedom`, of squares in units of `scale`."""

    freedom: float
    scale: float
    nats: float

    def weight(self, square: Array) -> Array:
        """Weights of rows with these squares, 1 where the law is normal."""
        if np.isinf(self.freedom):
            return np.ones(len(square))
        return np.asarray((self.freedom + 3.0) / (self.freedom + square / self.scale))


def _fit_student(square: Array, freedom: float) -> _Student:
    """The law with its maximum-likelihood scale, of rows' squares (n,)."""
    law = _Student(freedom, max(float(np.mean(square)) / 3.0, 1e-300), 0.0)
    if np.isinf(freedom):
        nats = -1.5 * len(square) * (np.log(2 * np.pi * law.scale) + 1.0)
        return replace(law, nats=float(nats))
    law = replace(law, scale=max(float(np.median(square)) / _MEDIAN_OF_3, 1e-300))
    for _ in range(_SCALE_ROUNDS):
        law = replace(law, scale=max(float(np.mean(law.weight(square) * square)) / 3.0, 1e-300))
    constant = gammaln((freedom + 3) / 2) - gammaln(freedom / 2)
    constant -= 1.5 * np.log(freedom * np.pi * law.scale)
    log_terms = np.log1p(square / (freedom * law.scale))
    return replace(law, nats=float(len(square) * constant - (freedom + 3) / 2 * np.sum(log_terms)))


def _mean_squares(values: Array, used: NDArray[np.bool]) -> Array:
    """(N,) mean squares of rows; the median where there is no reading."""
    square = np.sum(values**2, axis=1) / 3.0
    return np.where(used, square, np.median(square[used]) if np.any(used) else 1.0)
