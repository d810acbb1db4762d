"""Tests of one group of columns, everything else projected out: score, robust, bootstrap.

In units of one prior deviation per parameter (theta = scale * phi) the projected information is
diagonalised, G = V diag(l) V^T; directions that one prior deviation would not show (l < 1) are left
out, so the tests have the degrees of freedom that the motion offers and no others.

    score (LM):  sum_i s_i^2 / l_i ~ chi2_r under white noise
    robust:      Hotelling's T^2 of the block scores with the group fitted, jackknifed (CR3):
                 u_b = (I - G_b G^-1)^-1 (s_b - G_b phi), V = sum u_b u_b^T, T = s^T V^-1 s.
                 Correlated or heavy-tailed noise changes V and with it T; many blocks that agree
                 do not (with the group not fitted they would look like variance).
    bootstrap:   signs of whole blocks flipped at random, for groups too wide for T^2
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis.gram import RANK_SHARE, Gram
from ahrsd.diagnosis.probabilities import chi2_above, f_above
from ahrsd.samples import Array

#: 1 - leverage of a block is not taken smaller: a block that alone carries an effect proves little.
MINIMUM_FREEDOM = 0.05
#: effective blocks beyond the rank that T^2 needs: with fewer degrees of freedom its tail is so
#: heavy that nothing reaches a family-wise probability
FEW_BLOCKS = 7


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What the data say on one group; r observable directions of its p parameters.

    basis:       (p, r) theta = basis @ z, z in prior deviations
    information: (r,) of z;  score: (r,) sum of the block scores
    block_information:     (B, r, r); block_s: (B, r)
    share:       information left of the unprojected one, 0..1: the rest is absorbed
    """

    basis: Array
    information: Array
    score: Array
    block_information: Array
    block_s: Array
    block_power: Array
    share: float

    @property
    def rank(self) -> int:
        """Observable directions."""
        return len(self.information)

    @property
    def leverage(self) -> Array:
        """(B,) each block's part of the information, the mean of the observable directions."""
        H = np.einsum("bii->bi", self.block_information) / self.information
        return np.asarray(H.mean(axis=1)) if self.rank else np.zeros(len(self.block_s))

    @property
    def effective_blocks(self) -> float:
        """How many blocks carry the information: 1 where a single one does."""
        return 1.0 / max(float(np.sum(self.leverage**2)), 1e-300)

    @property
    def statistic(self) -> float:
        """The score statistic, chi2 of `rank` under white noise."""
        return float(np.sum(self.score**2 / self.information))

    @property
    def value(self) -> Array:
        """(p,) least-squares parameters, zero in unobservable directions."""
        return np.asarray(self.basis @ (self.score / self.information))

    @property
    def covariance(self) -> Array:
        """(p, p) of `value` under white noise of unit variance."""
        return np.asarray((self.basis / self.information) @ self.basis.T)


def score(gram: Gram, name: str, scale: Array, minimum_information: float = 1.0) -> Score:
    """The group's score in a Gram from which all else is projected out; scale (p,)."""
    columns = gram.groups[name]
    blocks = gram.blocks[:, columns, columns] * scale[:, None] * scale
    scores = gram.blocks[:, columns, -1] * scale
    whole = blocks.sum(axis=0)
    before = gram.information[columns] * scale**2
    values, vectors = np.linalg.eigh((whole + whole.T) / 2)
    kept = values > max(minimum_information, RANK_SHARE * float(before.sum()))
    V = vectors[:, kept]
    block_s = scores @ V
    block_information = V.T @ blocks @ V
    z = block_s.sum(axis=0) / values[kept]
    square = gram.blocks[:, -1, -1] - 2 * block_s @ z
    square += np.einsum("i,bij,j->b", z, block_information, z)
    return Score(
        basis=scale[:, None] * V,
        information=values[kept],
        score=block_s.sum(axis=0),
        block_information=block_information,
        block_s=block_s,
        block_power=square / np.maximum(gram.counts, 1.0),
        share=float(np.clip(np.trace(whole) / max(float(before.sum()), 1e-300), 0.0, 1.0)),
    )


def total_score(
    G: Array, s: Array, information: Array, scale: Array, minimum_information: float = 1.0
) -> Score:
    """The score of one group from its projected information (p, p) and score (p,)."""
    whole = np.zeros((1, len(s) + 1, len(s) + 1))
    whole[0, :-1, :-1], whole[0, :-1, -1], whole[0, -1, :-1] = G, s, s
    one = Gram({"x": slice(0, len(s))}, whole, np.ones(1), np.zeros((1, 2)), information)
    return score(one, "x", scale, minimum_information)


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
