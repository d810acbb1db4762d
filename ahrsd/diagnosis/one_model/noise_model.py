"""The noise: a power per octave, a level per moment, and single readings that are wild.

    e_n = a_n s_n,     s stationary, its power per octave v_b;  a_n a level, known in each pass

The octaves are of cosines over the whole recording, of readings that were divided by a_n.  v is a
smooth spectrum: octave to octave a step of its logarithm, so that the lowest, which has few
cosines, cannot swallow an effect for nothing.  a_n follows the residual of the richest model, never
that of the null: it must not be the mismatch's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ahrsd.diagnosis.one_model import priors
from ahrsd.samples import Array

#: rows round one among which it is wild alone
_AROUND = 9


def octaves(count: int) -> NDArray[np.intp]:
    """(B + 1,) edges of the bands among `count` cosines, lowest first."""
    edges = [count]
    while len(edges) < priors.BANDS and edges[-1] > 32:
        edges.append(edges[-1] // 2)
    return np.array([0, *edges[::-1]], dtype=np.intp)


def log_prior(log_noise: Array, deviation: float) -> tuple[float, Array]:
    """Log density of the bands' log powers (B,), and its gradient; deviation: octave to octave."""
    step = np.diff(log_noise) / deviation
    top = log_noise[-1] / priors.NOISE_TOP
    gradient = np.zeros(len(log_noise))
    gradient[:-1] += step / deviation
    gradient[1:] -= step / deviation
    gradient[-1] -= top / priors.NOISE_TOP
    return -0.5 * float(step @ step + top**2) - len(step) * float(np.log(deviation)), gradient


def stiffness(count: int, deviation: float) -> Array:
    """(B, B) curvature of minus that log density."""
    difference = np.diff(np.eye(count), axis=0) / deviation
    found = difference.T @ difference
    found[-1, -1] += 1.0 / priors.NOISE_TOP**2
    return np.asarray(found)


def bounds(count: int) -> tuple[Array, Array]:
    """Lowest and highest log power of each band."""
    return np.full(count, priors.NOISE_RANGE[0]), np.full(count, priors.NOISE_RANGE[1])


def amplitude(residual: Array, used: NDArray[np.bool], rate_hz: float) -> Array:
    """(N,) how loud each row is, from a residual (N, 3) without colour.

    The level is the moving median of the quick part alone: a step, a current or a course is slow or
    short, and a level that followed it would leave no evidence of it.  A row that is wild alone
    counts as one at the edge of what is not.
    """
    quick = np.diff(residual, n=2, axis=0, prepend=residual[:1], append=residual[-1:])
    rows = 2 * round(priors.LEVEL_S * rate_hz / 2) + 1
    level = median_filter(_square(quick, used), size=min(rows, len(used)), mode="nearest")
    level = np.clip(level / max(float(np.median(level)), 1e-300), *priors.LEVELS)
    square = _square(residual, used) / level
    square = square / max(float(np.median(square[used])) * 3.0 / 2.366, 1e-300)
    edge = priors.WILD**2 / 3.0
    around = median_filter(square, size=_AROUND, mode="nearest")
    alone = used & (square > edge) & (around < edge / 2)
    wild = np.where(alone, np.maximum(square / edge, 1.0), 1.0)
    return np.asarray(np.sqrt(level * wild))


def _square(values: Array, used: NDArray[np.bool]) -> Array:
    """(N,) mean squares of rows; the median where there is no reading."""
    square = np.sum(values**2, axis=1) / 3.0
    return np.where(used, square, np.median(square[used]) if np.any(used) else 1.0)
