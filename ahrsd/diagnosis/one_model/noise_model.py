"""The noise: a power per octave, a level per moment, and readings that are wild.

    e_n = a_n s_n,     s stationary, its power per octave v_b;  a_n known in each pass

The octaves are of cosines over the whole recording, of readings that were divided by a_n.  v is a
smooth spectrum: octave to octave a step of its logarithm, so that the lowest, which has few
cosines, cannot swallow an effect for nothing.  a_n follows the residual of the richest model, never
that of the null: it must not be the mismatch's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.one_model import priors
from ahrsd.samples import Array

_ROUNDS = 4


def octaves(count: int) -> NDArray[np.intp]:
    """(B + 1,) edges of the bands among `count` cosines, lowest first."""
    edges = [count]
    while len(edges) < priors.BANDS and edges[-1] > 32:
        edges.append(edges[-1] // 2)
    return np.array([0, *edges[::-1]], dtype=np.intp)


def log_prior(log_noise: Array) -> tuple[float, Array]:
    """Log density of the bands' log powers (B,), and its gradient."""
    step = np.diff(log_noise) / priors.NOISE_STEP
    top = log_noise[-1] / priors.NOISE_TOP
    gradient = np.zeros(len(log_noise))
    gradient[:-1] += step / priors.NOISE_STEP
    gradient[1:] -= step / priors.NOISE_STEP
    gradient[-1] -= top / priors.NOISE_TOP
    return -0.5 * float(step @ step + top**2), gradient


def bounds(count: int) -> tuple[Array, Array]:
    """Lowest and highest log power of each band."""
    return np.full(count, priors.NOISE_RANGE[0]), np.full(count, priors.NOISE_RANGE[1])


def amplitude(residual: Array, used: NDArray[np.bool], rate_hz: float) -> Array:
    """(N,) how much louder than usual each row is, from a residual (N, 3) without colour.

    A level per moment, drawn to the usual one; a row that is wild besides counts as one at the
    edge of what is not.
    """
    square = np.sum(residual**2, axis=1) / 3.0
    square = square / max(_usual(square, used), 1e-300)
    edge = priors.WILD**2 / 3.0
    rows = max(1, round(priors.LEVEL_S * rate_hz))
    moment = np.arange(len(square)) // rows
    level = np.ones(int(moment[-1]) + 1)
    for _ in range(_ROUNDS):  # what is wild is so beside its own moment
        kept = np.minimum(square, edge * level[moment])
        power = np.bincount(moment, np.where(used, kept, 0.0))
        known = np.bincount(moment, used)
        level = (power + priors.LEVEL_ROWS) / (known + priors.LEVEL_ROWS)
    wild = np.maximum(square / (edge * level[moment]), 1.0)
    return np.where(used, np.sqrt(level[moment] * wild), 1.0)


def _usual(square: Array, used: NDArray[np.bool]) -> float:
    """Mean of the squares, from their median (chi-square of three)."""
    return float(np.median(square[used])) * 3.0 / 2.366 if np.any(used) else 1.0
