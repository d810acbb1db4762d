"""Evidence of one effect in many settings at once: what `total_score` says of each, in stacks.

A survey tries hundreds of settings whose matrices are 3 x 3; one by one they cost more than the
filter that their columns pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.innovation_filter.evidence import SIZES
from ahrsd.diagnosis.innovation_filter.gram import RANK_SHARE
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Choices:
    """S settings of p parameters in the directions of each one's information, as of `Score`.

    basis: (S, p, p) theta = basis @ z;  seen: (S, p) the observable directions
    information, score: (S, p) of z; 1 and 0 in the others
    """

    basis: Array
    seen: NDArray[np.bool]
    information: Array
    score: Array

    def log_bayes(self, colour: float, sizes: Sequence[float] = SIZES) -> Array:
        """(S,) log Bayes factors against the effect's absence, nats."""
        l, s = self.information / colour, self.score / colour  # noqa: E741
        k2 = np.square(np.asarray(sizes, float))[:, None, None]
        price = np.where(self.seen, np.log1p(k2 * l), 0.0)
        terms = 0.5 * np.sum(s**2 / (l + 1.0 / k2) - price, axis=2)
        return np.asarray(np.logaddexp.reduce(terms, axis=0) - np.log(len(sizes)))

    def below_zero(self, deviations: float) -> NDArray[np.bool]:
        """(S,) whether a parameter is so many of its own deviations below zero."""
        value = np.einsum("kij,kj->ki", self.basis, self.score / self.information)
        variance = np.einsum("kij,kj->ki", self.basis**2, self.seen / self.information)
        below = (value <= -deviations * np.sqrt(variance)) & (variance > 0.0)
        return np.asarray(below.any(axis=1))


def choices(G: Array, s: Array, power: Array, scale: Array, least: float) -> Choices:
    """Of projected information G (S, p, p), projected score s (S, p) and sums of squares (S, p).

    scale (p,): prior deviations;  least: information of a direction that counts as observable
    """
    scaled = G * scale[:, None] * scale
    before = np.sum(power * scale**2, axis=1)
    values, vectors = np.linalg.eigh((scaled + np.swapaxes(scaled, 1, 2)) / 2)
    seen = values > np.maximum(least, RANK_SHARE * before)[:, None]
    score = np.einsum("kij,ki->kj", vectors, s * scale)
    return Choices(
        basis=scale[:, None] * vectors,
        seen=seen,
        information=np.where(seen, values, 1.0),
        score=np.where(seen, score, 0.0),
    )
