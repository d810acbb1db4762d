"""Where a magnetic object is, from the size of the field along the way past it.

The size of the calibrated field does not turn with the sensor.  An object adds to it, nearly, the
part of its own field along the earth's: u . B(p - p0; k), linear in its moment k for a given place.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ahrsd.samples import Array

_REACH_M = 25.0
_MOST_ROWS = 600
_STARTS_M = (
    (0.0, 0.0, 1.0),
    (0.0, 0.0, 4.0),
    (1.5, 1.5, 0.5),
    (-1.5, -1.5, 0.5),
)
_TURNS_RAD = (-np.pi / 2, np.pi / 2, np.pi)  # of a frame of positions that is not north's
_NEAREST_M = 0.2


def unit_fields(away_m: Array, distance_m: float, axes: Array | None = None) -> Array:
    """Fields (N, 3, 3) of unit moments at offsets (N, 3) from the object.

    A moment is given as the field that it makes beside itself at `distance_m`.
    axes: (N, 3, 3) the world's axes as the fields are wanted, the world's own if None
    """
    size = np.sqrt(np.einsum("ni,ni->n", away_m, away_m))
    distance = np.maximum(size, _NEAREST_M / 4)
    r = away_m / distance[:, None]
    strength = (distance_m / distance) ** 3
    seen = r if axes is None else np.einsum("nij,nj->ni", axes, r)
    fields = (3 * strength[:, None] * seen)[:, :, None] * r[:, None, :]
    fields -= strength[:, None, None] * (np.eye(3) if axes is None else axes)
    return np.asarray(fields)


def found_place(
    size_gauss: Array, place_m: Array, field_n: Array, row: int
) -> tuple[Array, float] | None:
    """The object's place (3,) that explains the size (N,) near `row` best, and the turn about down
    (rad) from the frame of the positions to that of the field; None where the way is too short.

    place_m: (N, 3) way of the sensor;  field_n: (3,) the earth's field
    """
    near = np.linalg.norm(place_m - place_m[row], axis=1) < _REACH_M
    rows = np.flatnonzero(near)
    rows = rows[:: max(len(rows) // _MOST_ROWS, 1)]
    if len(rows) < 20:
        return None
    u = field_n / np.linalg.norm(field_n)
    way, size = place_m[rows], size_gauss[rows]

    def left(unknown: Array) -> float:
        place, turn = unknown[:3], float(unknown[3])
        c, s = np.cos(turn), np.sin(turn)
        seen = np.array([c * u[0] + s * u[1], c * u[1] - s * u[0], u[2]])
        columns = np.column_stack([seen @ unit_fields(way - place, 1.0), np.ones(len(way))])
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        right = columns.T @ size
        ridge = columns.T @ columns + 1e-9 * np.eye(4)
        outside = max(_NEAREST_M - float(np.linalg.norm(way - place, axis=1).min()), 0.0)
        return float(size @ size - right @ np.linalg.solve(ridge, right)) * (1 + outside)

    starts = [np.append(place_m[row] + np.array(start), 0.0) for start in _STARTS_M]
    best = min((_lowest(left, start, 90) for start in starts), key=lambda one: one[0])
    turned = [_lowest(left, np.append(best[1][:3], best[1][3] + turn), 90) for turn in _TURNS_RAD]
    best = min((best, *turned), key=lambda one: one[0])
    found = _lowest(left, best[1], 250)[1]
    return found[:3], float(found[3])


def _lowest(cost: Callable[[Array], float], start: Array, evaluations: int) -> tuple[float, Array]:
    """The simplex's lowest cost and where it is."""
    from scipy.optimize import minimize  # dear to import, and seldom needed

    done = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"maxfev": evaluations, "xatol": 0.01, "fatol": 0.0},
    )
    return float(done.fun), np.asarray(done.x, dtype=np.float64)
