"""Tests of one group of columns by its score (`innovation_filter/score.py`): robust, bootstrap.

score (LM):  sum_i s_i^2 / l_i ~ chi2_r under white noise
robust:      Hotelling's T^2 of the block scores with the group fitted, jackknifed (CR3):
             u_b = (I - G_b G^-1)^-1 (s_b - G_b phi), V = sum u_b u_b^T, T = s^T V^-1 s.
             Correlated or heavy-tailed noise changes V and with it T; many blocks that agree
             do not (with the group not fitted they would look like variance).
bootstrap:   the innovations shifted in time, for groups too wide for T^2
"""

from __future__ import annotations

import numpy as np
from scipy import special

from ahrsd.diagnosis.innovation_filter.gram import RANK_SHARE
from ahrsd.diagnosis.innovation_filter.probabilities import chi2_above
from ahrsd.diagnosis.innovation_filter.score import Score
from ahrsd.samples import Array

#: 1 - leverage of a block is not taken smaller: a block that alone carries an effect proves little.
MINIMUM_FREEDOM = 0.05
#: effective blocks beyond the rank that T^2 needs: with fewer degrees of freedom its tail is so
#: heavy that nothing reaches a family-wise probability
FEW_BLOCKS = 7


def f_above(value: float, above: float, below: float) -> float:
    """Probability that an F of so many degrees of freedom above and below is larger."""
    return float(special.fdtrc(above, below, value))


def chi2_p(what: Score, colour: float = 1.0) -> float:
    """Probability of a larger score statistic under noise whose power is `colour` times white."""
    return chi2_above(what.statistic / colour, what.rank) if what.rank else 1.0


def robust_p(what: Score, colour: float = 1.0) -> float:
    """Probability of a larger T^2.

    Where fewer blocks than FEW_BLOCKS more than the rank carry the information (a lag that only one
    brisk turn shows), blocks cannot vouch for each other; then every block's share of the variance
    is its information times the power of its own residuals and the colour of the noise.
    """
    r = what.rank
    if r == 0:
        return 1.0
    root = 1.0 / np.sqrt(what.information)
    H = what.block_information * root[:, None] * root
    s = what.block_s * root
    blocks = min(float(len(s)), what.effective_blocks)
    whole = s.sum(axis=0)
    if blocks <= r + FEW_BLOCKS:
        power = np.maximum(what.block_power, 1.0)
        usual = max(1.0, float(np.mean(power)))
        V = np.einsum("b,bij->ij", power, H) * max(1.0, colour / usual)
        return chi2_above(float(whole @ np.linalg.pinv(V, hermitian=True) @ whole), r)
    u = _jackknifed(H, s)
    T = float(whole @ np.linalg.pinv(u.T @ u, hermitian=True) @ whole)
    return f_above(T * (blocks - r) / (r * blocks), r, blocks - r)


def _jackknifed(H: Array, s: Array) -> Array:
    """(B, r) block scores with the group fitted, each as if its own block had been left out."""
    residual = s - np.einsum("bij,j->bi", H, s.sum(axis=0))
    values, vectors = np.linalg.eigh(H)
    freedom = np.maximum(1.0 - values, MINIMUM_FREEDOM)
    turned = np.einsum("bji,bj->bi", vectors, residual) / freedom
    return np.asarray(np.einsum("bij,bj->bi", vectors, turned))


def shift_statistics(columns: Array, innovation: Array, minimum_shift: int) -> tuple[float, Array]:
    """Score statistic, and those with the innovations shifted in time around the circle.

    columns (N, 3, p) and innovation (N, 3) with everything else projected out.  Shifts shorter
    than `minimum_shift` samples are left out: an effect resembles itself a moment later.
    """
    count, _, width = columns.shape
    flat = columns.reshape(-1, width)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = values > RANK_SHARE * max(float(values[-1]), 1e-300)
    X = columns @ (vectors[:, kept] / np.sqrt(values[kept]))
    spectrum = np.fft.rfft(X, axis=0)
    other = np.fft.rfft(innovation, axis=0)[:, :, None]
    s = np.fft.irfft(np.sum(np.conj(spectrum) * other, axis=1), n=count, axis=0)
    power = np.sum(s**2, axis=1)
    inside = slice(minimum_shift, max(minimum_shift, count - minimum_shift))
    return float(power[0]), np.asarray(power[inside])
