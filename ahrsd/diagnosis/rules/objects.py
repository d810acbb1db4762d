"""The place of a magnetic object in the world: Gauss-Newton on the whitened innovation.

Its moment is linear for a given place, and so is the calibration, which takes a part of what it
does; only the place and the turn of the frame of the positions are not.  The size of the field
alone, from which the search begins, does not know what the calibration has taken: metres away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ahrsd.diagnosis.effects.base import Setting, readings_of
from ahrsd.diagnosis.effects.world import NEAREST_M, object_setting, position_m
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.values import Context
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

#: columns (N, 3, 3) of unit moments at a place and turn (4,)
Fields = Callable[[Array], Array]
#: columns (N, 3, p) as the innovation sees them, each
Whitened = Callable[[Sequence[Array]], list[Array]]


def closest_object(
    fields: Fields,
    whitened: Whitened,
    known: Array,
    innovation: Array,
    starts: Sequence[Array],
) -> Array:
    """Place (m) and turn (deg) (4,) downhill of a start that explain most of innovation (N, 3).

    known (N, 3, q): whitened columns of what is fitted beside it
    """
    search = _Search(fields, whitened, known, innovation)
    turned = [start + np.array([0, 0, 0, turn]) for start, turn in product(starts, _TURNS_DEG)]
    return max((search.from_(one) for one in search.best(turned)), key=lambda found: found[0])[1]


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Whitened columns (3 N, p) of an object, and these before the filter (N, 3, p).

    known: (q, p) products with the known columns;  score: (p,) with what these leave
    """

    fields: Array
    columns: Array
    known: Array
    score: Array


class _Search:
    """The regression on an object's moment, what is known regressed out of it."""

    def __init__(self, fields: Fields, whitened: Whitened, known: Array, innovation: Array) -> None:
        self._fields = fields
        self._whitened = whitened
        self._known = known.reshape(innovation.size, -1)
        self._inverse = solve(self._known.T @ self._known, np.eye(self._known.shape[1]))
        e = innovation.ravel()
        self._left = e - self._known @ (self._inverse @ (self._known.T @ e))

    def best(self, starts: Sequence[Array]) -> list[Array]:
        """The few that explain most as they are."""
        gains = [self._gain(seen)[0] for seen in self._at(starts)]
        return [starts[k] for k in np.argsort(gains)[::-1][:_STARTS]]

    def from_(self, at: Array) -> tuple[float, Array]:
        """Squares explained and where, from one start downhill."""
        (seen,) = self._at([at])
        gain, moment = self._gain(seen)
        damping = _FIRST_DAMPING
        for _ in range(_PASSES):
            # the filter is linear: what a moment's field changes by passes it, not every column
            moved = [self._fields(at + step) for step in np.diag(_STEP)]
            slopes = [
                (one - seen.fields) @ moment / step for one, step in zip(moved, _STEP, strict=True)
            ]
            (steep,) = self._seen([np.stack(slopes, axis=2)])
            for _ in range(_DAMPINGS):
                change = self._change(seen, steep, damping)
                new = at + np.clip(change, -_MOST, _MOST)
                (tried,) = self._at([new])
                more, again = self._gain(tried)
                if more > gain:
                    break
                damping *= _DAMPED
            else:
                break
            before, at, seen, gain, moment = gain, new, tried, more, again
            damping *= _RELAXED
            if gain - before < _ARRIVED * gain:
                break
        return gain, at

    def _at(self, places: Sequence[Array]) -> list[_Seen]:
        return self._seen([self._fields(place) for place in places])

    def _seen(self, fields: list[Array]) -> list[_Seen]:
        out = []
        for plain, columns in zip(fields, self._whitened(fields), strict=True):
            X = columns.reshape(len(self._left), -1)
            out.append(_Seen(plain, X, self._known.T @ X, self._left @ X))
        return out

    def _information(self, one: _Seen, other: _Seen) -> Array:
        """Products of columns without what is known."""
        return np.asarray(
            one.columns.T @ other.columns - one.known.T @ (self._inverse @ other.known)
        )

    def _gain(self, seen: _Seen) -> tuple[float, Array]:
        """Squares that a moment explains, and that moment (3,)."""
        moment = solve(self._information(seen, seen), seen.score[:, None])[:, 0]
        return float(seen.score @ moment), moment

    def _change(self, seen: _Seen, steep: _Seen, damping: float) -> Array:
        """Change of place and turn (4,), the moment free."""
        cross = self._information(seen, steep)
        G = np.block(
            [[self._information(seen, seen), cross], [cross.T, self._information(steep, steep)]]
        )
        loaded = np.diag(G) * np.repeat([_TINY, damping], [3, 4])
        right = np.concatenate([seen.score, steep.score])[:, None]
        return np.asarray(solve(G + np.diag(loaded), right)[3:, 0])


def moved_object(context: Context, setting: Setting, place_and_turn: Array) -> Setting:
    """The setting of an object (3 m, 1 deg) elsewhere, its distance that to the nearest place."""
    way = position_m(readings_of(context))
    if way is None:
        return setting
    away = way - place_and_turn[:3]
    nearest = float(np.sqrt(np.einsum("ni,ni->n", away, away).min()))
    at = object_setting(place_and_turn[:3], max(nearest, NEAREST_M), float(place_and_turn[3]))
    return {**setting, **at}
