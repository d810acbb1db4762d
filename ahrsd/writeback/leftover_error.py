"""How much of the corrected field's variation a wrong calibration still explains.

y = |C (m - B)| / its mean    u = direction of C (m - B), sensor frame

With right registers y varies by noise and by the places that the vehicle passes, neither of which
knows the attitude. A hard or soft iron that is still in there makes y a function of u:

y = const + d . u + u' S u       d: 3 numbers, S: 5

The samples are cut into stretches in which the vehicle turned; within each, y and its columns are
taken about their means, so that a field that differs from place to place explains nothing.

b, the eight numbers of d and S, is fitted twice, to every other stretch. With A the Gram matrix of
the columns and n the samples, Q = b1' (A / n) b2 is the mean square that is explained: the noise of
b1 knows nothing of that of b2, so with right registers Q is zero on average at any level of noise.
What each stretch leaves over of the other half's fit, g_k - A_k b, says how uncertain b is,
whatever colour the noise has within a stretch:

Cov b = A^-1 (sum r_k r_k') A^-1    var Q = 4 b' (A/n) Cov (A/n) b + 2 tr((A/n) Cov (A/n) Cov)
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from ahrsd.samples import Array

SHORTEST_S, LONGEST_S = 5.0, 20.0  # of a stretch
STRETCHES = 60  # the newest ones, that are remembered
FEWEST = 6  # from which something is said
TURNED = 0.02  # variance of u over a stretch that says something; 0.02 is some 8 deg each way
_WELL_TURNED = 0.15  # and that need not become longer
_FEWEST_ROWS = 20
_BELIEF = 0.05  # size of d and S before anything is known, in parts of the field
_LEAST_SIGMA = 1e-7  # of Q: rounding, where there is no noise at all
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True)
class Leftover:
    """What is explained, rms in parts of the field, and by how many of its own sigmas its square is
    beyond that of a limit: negative where right registers are likelier. nan: too few stretches.
    """

    share: float = float("nan")
    sigmas: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    rows: int
    A: Array
    g: Array
    yy: float


class LeftoverError:
    """Corrected fields in, `Leftover` out. Bounded memory."""

    def __init__(self) -> None:
        self._fields: list[Array] = []
        self._begun_s = 0.0
        self._done: deque[_Stretch] = deque(maxlen=STRETCHES)

    def add(self, time_s: float, corrected: Array) -> None:
        """One corrected field (3,), some ten a second."""
        if not self._fields:
            self._begun_s = time_s
        self._fields.append(corrected)
        length_s = time_s - self._begun_s
        if not 0.0 <= length_s <= 2.0 * LONGEST_S:  # a gap, or the clock fell
            self._fields = [corrected]
            self._begun_s = time_s
        elif length_s >= SHORTEST_S:
            self._close(last=length_s >= LONGEST_S)

    def leftover(self, limit: float) -> Leftover:
        """What is explained, and how clearly it is more than `limit` (parts of the field)."""
        count = len(self._done)
        if count < FEWEST:
            return Leftover()
        halves = [list(self._done)[half::2] for half in (0, 1)]
        (first, _), (second, _) = (_fit(half) for half in halves)
        both, A = _fit([one for half in halves for one in half])
        left = [one.g - one.A @ second for one in halves[0]]
        left += [one.g - one.A @ first for one in halves[1]]
        solved = np.linalg.solve(A, np.array(left).T)
        per_row = A / sum(one.rows for one in self._done)
        spread = per_row @ (solved @ solved.T)
        square = float(first @ per_row @ second)
        variance = 4.0 * both @ spread @ per_row @ both + 2.0 * np.trace(spread @ spread)
        sigma = max(float(np.sqrt(max(variance, 0.0))), _LEAST_SIGMA)
        return Leftover(float(np.sqrt(max(square, 0.0))), (square - limit**2) / sigma)

    def _close(self, *, last: bool) -> None:
        """End the stretch where the vehicle turned in it; where it did not, it says nothing."""
        field = np.array(self._fields)
        size = np.linalg.norm(field, axis=1)
        u = field / np.maximum(size, 1e-9)[:, None]
        turned = float(u.var(axis=0).sum())
        if turned < _WELL_TURNED and not last:
            return
        self._fields = []
        if turned > TURNED and len(field) >= _FEWEST_ROWS and np.isfinite(field).all():
            square = (u[:, :, None] * u[:, None, :])[:, _UPPER[0], _UPPER[1]][:, :5]
            X = np.column_stack([u, square])
            X = X - X.mean(axis=0)
            y = size / size.mean()
            y = y - y.mean()
            self._done.append(_Stretch(len(y), X.T @ X, X.T @ y, float(y @ y)))


def _fit(stretches: list[_Stretch]) -> tuple[Array, Array]:
    """b (8,) by least squares, held towards zero by what is believed before; its matrix (8, 8)."""
    A, g = sum(one.A for one in stretches), sum(one.g for one in stretches)
    noise = sum(one.yy for one in stretches) / sum(one.rows for one in stretches)
    held = np.asarray(A) + np.eye(8) * (noise / _BELIEF**2 + 1e-9)
    return np.asarray(np.linalg.solve(held, np.asarray(g))), held
