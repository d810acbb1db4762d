"""Deviations of groups of random effects by marginal likelihood.

    y = Z u + white of variance 1,   u_j ~ N(0, e^(2 t_k)) for the columns j of group k

With D = diag(e^t), G = Z^T Z, s = Z^T y, A = I + D G D and m = A^-1 D s the log likelihood over
that without effects, and its slope in the t_k, are

    L   = 1/2 m^T D s - 1/2 log |A|
    dL  = a_k - g_k,   a_k = sum of m_j^2,   g_k = sum of 1 - (A^-1)_jj   over j in group k

by differentiating L (held against differences in `tests/diagnosis/rules/test_variances.py`), so
that a_k = g_k at the maximum.  Where the data decide, a_k / g_k goes with e^(-2 t_k):
g_k log(a_k / g_k) is nearly linear in t, and its slope is nearly what dL's would be if a_k were
g_k,

    2 m_k^T (I - A^-1)_kl m_l,   with m_k scaled by the root of g_k / a_k.

Half a dozen steps of that do what fifty of a method without second derivatives do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ahrsd.samples import Array

#: logarithms of the deviations: no step is longer, and one that promises fewer nats is the last
LONGEST, ENOUGH_NATS = 3.0, 1e-3
STEPS, SHORTENED, SHORTER = 40, 6, 3.0
_TINY = 1e-300


@dataclass(frozen=True, slots=True, eq=False)
class _At:
    """What is known at `sizes`: nats, slope (K,), `pull` g log(a / g) (K,), information (K, K)."""

    sizes: Array
    nats: float
    slope: Array
    pull: Array
    information: Array


def fitted(
    G: Array, s: Array, group: NDArray[np.intp], start: Array, low: Array, high: Array
) -> tuple[float, Array]:
    """Largest log marginal likelihood, nats, and the logarithms of the deviations there (K,).

    G (q, q), s (q,): products in noise of variance 1;  group (q,): number of a column's deviation;
    start, low, high (K,): logarithms, where to begin and between which to stay
    """
    at = _at(G, s, group, np.clip(start, low, high))
    for _ in range(STEPS):
        step = _step(at, low, high)
        whole = np.clip(at.sizes + step, low, high) - at.sizes
        if float(at.slope @ whole) < ENOUGH_NATS:
            break
        new = _further(G, s, group, at, whole)
        if new is None:
            break
        gained, at = new.nats - at.nats, new
        if gained < ENOUGH_NATS:
            break
    return at.nats, at.sizes


def _further(G: Array, s: Array, group: NDArray[np.intp], at: _At, step: Array) -> _At | None:
    """The longest of some parts of the step that is likelier; None where none is."""
    for shorter in range(SHORTENED):
        new = _at(G, s, group, at.sizes + step / SHORTER**shorter)
        if new.nats > at.nats:
            return new
    return None


def _step(at: _At, low: Array, high: Array) -> Array:
    """(K,) the step of those deviations that no bound holds; uphill."""
    held = (at.sizes <= low) & (at.slope <= 0.0) | (at.sizes >= high) & (at.slope >= 0.0)
    own = np.maximum(np.diag(at.information), 1e-12)
    alone = np.where(held, 0.0, at.pull / own)
    if held.all():
        return alone
    free = ~held
    step = np.zeros(len(held))
    H = at.information[np.ix_(free, free)] + np.diag(1e-6 * own[free])
    step[free] = np.linalg.solve(H, at.pull[free])
    step = np.clip(step, -LONGEST, LONGEST)
    return step if float(at.slope @ step) > 0.0 else np.clip(alone, -LONGEST, LONGEST)


def _at(G: Array, s: Array, group: NDArray[np.intp], sizes: Array) -> _At:
    count, deviation = len(sizes), np.exp(sizes)[group]
    A = G * deviation
    A *= deviation[:, None]
    A[np.diag_indices_from(A)] += 1.0
    # of the inverse only the diagonal is asked for: sums of squares down the columns of L^-1
    L = linalg.cholesky(A.T, lower=True, overwrite_a=True, check_finite=False)
    root, _ = linalg.lapack.dtrtri(L, lower=1, overwrite_c=1)
    seen = root @ (deviation * s)
    mean = seen @ root
    nats = 0.5 * float(seen @ seen) + float(np.sum(np.log(np.diag(root))))
    explained = np.asarray(np.bincount(group, mean**2, count), np.float64)
    unsure = np.einsum("ij,ij->j", root, root)
    taken = np.asarray(np.bincount(group, 1.0 - unsure, count), np.float64)
    ratio = np.maximum(explained, _TINY) / np.maximum(taken, _TINY)
    each = np.zeros((len(s), count))
    each[np.arange(len(s)), group] = mean / np.sqrt(ratio)[group]
    moved = root @ each
    information = 2.0 * (each.T @ each - moved.T @ moved)
    return _At(sizes, nats, explained - taken, np.maximum(taken, 0.0) * np.log(ratio), information)
