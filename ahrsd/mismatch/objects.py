"""The place of a magnetic object in the world: Gauss-Newton on the whitened innovation.

Its moment is linear for a given place, and so is the calibration, which takes a part of what it
does; only the place and the turn of the frame of the positions are not.  The size of the field
alone, from which the search begins, does not know what the calibration has taken: metres away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np

from ahrsd.mismatch.gram import solve
from ahrsd.samples import Array

#: turns of the frame of the positions from which it starts, degrees
_TURNS_DEG = (0.0, 90.0, 180.0, -90.0)
#: by how much place (m) and turn (deg) are moved for the derivatives, and at most at once
_STEP = np.array([0.02, 0.02, 0.02, 0.5])
_MOST = np.array([1.0, 1.0, 1.0, 60.0])
#: starts that are followed
_STARTS = 3
_PASSES, _DAMPINGS = 12, 4
_FIRST_DAMPING, _DAMPED, _RELAXED = 0.01, 10.0, 0.1
#: gain of a pass, in parts of all, below which it has arrived
_ARRIVED = 1e-4
_TINY = 1e-9

#: whitened columns (N, 3, 3) of unit moments for each place and turn (4,)
Seen = Callable[[Sequence[Array]], list[Array]]


def closest_object(seen: Seen, known: Array, innovation: Array, starts: Sequence[Array]) -> Array:
    """Place (m) and turn (deg) (4,) downhill of a start that explain most of innovation (N, 3).

    known (N, 3, q): whitened columns of what is fitted beside it
    """
    search = _Search(seen, known, innovation)
    turned = [start + np.array([0, 0, 0, turn]) for start, turn in product(starts, _TURNS_DEG)]
    return max((search.from_(one) for one in search.best(turned)), key=lambda found: found[0])[1]


class _Search:
    """Columns and innovation with what is known projected out."""

    def __init__(self, seen: Seen, known: Array, innovation: Array) -> None:
        self._seen = seen
        self._known = known.reshape(innovation.size, -1)
        self._inverse = solve(self._known.T @ self._known, np.eye(self._known.shape[1]))
        self._left = self._without_known(innovation.reshape(-1, 1))[:, 0]

    def best(self, starts: Sequence[Array]) -> list[Array]:
        """The few that explain most as they are."""
        gains = [self._gain(columns)[0] for columns in self._columns(starts)]
        return [starts[k] for k in np.argsort(gains)[::-1][:_STARTS]]

    def from_(self, at: Array) -> tuple[float, Array]:
        """Squares explained and where, from one start downhill."""
        columns = self._columns([at])[0]
        gain, moment = self._gain(columns)
        damping = _FIRST_DAMPING
        for _ in range(_PASSES):
            moved = self._columns([at + _STEP * (np.arange(4) == axis) for axis in range(4)])
            slopes = [
                (one - columns) @ moment / step for one, step in zip(moved, _STEP, strict=True)
            ]
            for _ in range(_DAMPINGS):
                change = self._change(np.column_stack([columns, *slopes]), damping)
                new = at + np.clip(change, -_MOST, _MOST)
                tried = self._columns([new])[0]
                more, again = self._gain(tried)
                if more > gain:
                    break
                damping *= _DAMPED
            else:
                break
            before, at, columns, gain, moment = gain, new, tried, more, again
            damping *= _RELAXED
            if gain - before < _ARRIVED * gain:
                break
        return gain, at

    def _without_known(self, columns: Array) -> Array:
        return np.asarray(columns - self._known @ (self._inverse @ (self._known.T @ columns)))

    def _columns(self, places: Sequence[Array]) -> list[Array]:
        return [self._without_known(one.reshape(-1, 3)) for one in self._seen(places)]

    def _gain(self, columns: Array) -> tuple[float, Array]:
        """Squares that a moment explains, and that moment (3,)."""
        moment = solve(columns.T @ columns, (columns.T @ self._left)[:, None])[:, 0]
        return float(self._left @ columns @ moment), moment

    def _change(self, columns: Array, damping: float) -> Array:
        """Change of place and turn (4,), the moment free."""
        G = columns.T @ columns
        loaded = np.diag(G) * np.repeat([_TINY, damping], [3, 4])
        right = (columns.T @ self._left)[:, None]
        return np.asarray(solve(G + np.diag(loaded), right)[3:, 0])
