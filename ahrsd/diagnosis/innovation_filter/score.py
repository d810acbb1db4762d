"""The score of one group of columns, everything else projected out.

In units of one prior deviation per parameter (theta = scale * phi) the projected information is
diagonalised, G = V diag(l) V^T; directions that one prior deviation would not show (l < 1) are left
out, so tests have the degrees of freedom that the motion offers and no others.

    score (LM):  sum_i s_i^2 / l_i ~ chi2_r under white noise
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis.innovation_filter.gram import RANK_SHARE, Gram
from ahrsd.samples import Array


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
