"""What a model gains on stretches that it was not fitted to, and what leaving it out costs.

Folds are made of stretches of several blocks, dealt in turn, so that each fold sees early and late;
the block on either side of a held-out stretch is left out of the training as well (the filter's
memory).  Coefficients are posterior means: where the training says nothing they stay at zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.innovation_filter.gram import Gram
from ahrsd.samples import Array

FOLDS = 5
STRETCHES = 20
#: deviation of a coefficient before the training speaks, in prior deviations
PRIOR = 3.0


@dataclass(frozen=True, slots=True)
class Gain:
    """Held-out sums of squares per scalar residual, without and with the group.

    scatter: by which the logarithm of the innovations' deviations, summed over the axes, is larger
             without it, where that is another filter
    """

    before: float
    after: float
    scatter: float = 0.0

    @property
    def nats_per_sample(self) -> float:
        """Gain in log-likelihood per sample of three axes."""
        return 1.5 * (self.before - self.after) + self.scatter


Folds = list[tuple[NDArray[np.intp], NDArray[np.intp]]]


def alternating(count: int) -> Folds:
    """Every second block from the others: for a course that nothing predicts but its neighbours."""
    odd = np.arange(count) % 2 == 1
    return [
        (np.flatnonzero(odd), np.flatnonzero(~odd)),
        (np.flatnonzero(~odd), np.flatnonzero(odd)),
    ]


def folds(count: int) -> Folds:
    """(training, held-out) block numbers of each fold over `count` blocks, with guards."""
    stretch = np.minimum(np.arange(count) * STRETCHES // max(count, 1), STRETCHES - 1)
    out: Folds = []
    for fold in range(FOLDS):
        test = stretch % FOLDS == fold
        near = test | np.roll(test, 1) | np.roll(test, -1)
        if test.any() and not near.all():
            out.append((np.flatnonzero(~near), np.flatnonzero(test)))
    return out


def one_by_one(count: int) -> Folds:
    """Every one of a few blocks from all the others, where blocks know nothing of each other."""
    number = np.arange(count)
    return [(number[number != k], number[k : k + 1]) for k in range(count)]


def heldout(
    gram: Gram,
    known: Sequence[str],
    group: str,
    scale: Array,
    dealt: Callable[[int], Folds] = folds,
) -> Gain:
    """Cross-validated gain of one group; `known` groups are fitted in both.  scale: (p,) prior."""
    before = after = count = 0.0
    chosen = gram.select([*known, group])
    for training, test in dealt(len(chosen)):
        total = _held(chosen.blocks[training].sum(axis=0), chosen)
        left = chosen.rows(test).project(list(known), total)
        fit = chosen.rows(training).project(list(known), total).total
        G, s = fit[:-1, :-1], fit[:-1, -1]
        theta = scale * np.linalg.solve(
            G * scale[:, None] * scale + np.eye(len(s)) / PRIOR**2, scale * s
        )
        held = left.total
        e2 = float(held[-1, -1])
        before += e2
        after += e2 - 2 * float(theta @ held[:-1, -1]) + float(theta @ held[:-1, :-1] @ theta)
        count += float(left.counts.sum())
    return Gain(before / max(count, 1.0), after / max(count, 1.0))


def _held(total: Array, gram: Gram) -> Array:
    """The training's matrix with a hundredth of each column's whole information as a prior.

    A step that lies in the held-out stretch is not known from the training: it stays near zero.
    """
    out = total.copy()
    index = np.arange(len(gram.information))
    out[index, index] += 1e-3 * gram.information
    return out
