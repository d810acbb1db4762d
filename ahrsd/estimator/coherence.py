"""What misfit does to an answer that has many epochs: it does not average out.

What epochs disagree about beyond their noise comes from a field that differs by place, a drift, an
instrument. Each epoch is bent by it, and nothing says that the next is bent another way: the part
that is the same in all of them is an error of the answer, and is not seen in their disagreement.
The least that may be assumed of it is that it is as large as the part that is seen.

An epoch with information S asks for a gradient of covariance (misfit - 1) S beyond its noise,
S^1/2 e. With another e for each epoch these add up as sum S, with the same one for all as
(sum S^1/2)^2: along a direction that n epochs tell alike n times as much, along one that a single
epoch tells as much as before.
"""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array


def unaveraged(
    covariance: Array, epochs: Array, *, misfit: float, temper: float, folded: tuple[Array, float]
) -> Array:
    """covariance (n, n) where what epochs disagree about is the same in all of them.

    covariance: of the answer, every epoch's information divided by `temper`; epochs (N, n, n):
    information of each; misfit: mean square of what they ask for over what noise makes; folded:
    information (n, n) of epochs that are no more there, and how many they were, alike
    """
    if not misfit > 1.0:
        return covariance
    root = _root(covariance)
    old, count = folded
    pieces = np.concatenate([epochs, old[None] / max(count, 1.0)])
    weights = np.r_[np.ones(len(epochs)), count]
    whitened = root.T @ pieces @ root / temper
    values, vectors = np.linalg.eigh((whitened + np.swapaxes(whitened, 1, 2)) / 2)
    values = np.clip(values, 0.0, None)
    told = np.einsum("k,kij,kj,klj->il", weights, vectors, values, vectors)
    alike = np.einsum("k,kij,kj,klj->il", weights, vectors, np.sqrt(values), vectors)
    more = ((misfit - 1.0) * alike @ alike + told) / temper - told
    more_values, more_vectors = np.linalg.eigh((more + more.T) / 2)
    wider = more_vectors * np.clip(more_values, 0.0, None) @ more_vectors.T
    found = covariance + root @ wider @ root.T
    return np.asarray((found + found.T) / 2)


def _root(covariance: Array) -> Array:
    """R with R R^T = covariance, a positive definite matrix whose rows may have any units."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * (vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T)
