"""The sphere of directions as two discs seen from above the vehicle, ahead at the top.

Left the half below the vehicle, right the half above it, each in Lambert's equal-area projection: a
share of a disc is the same share of its half of the sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.evidence.coverage import CELLS, cells_of, centres
from ahrsd.evidence.values import Bools
from ahrsd.samples import Array
from ahrsd.telemetry.driving import Shown

WIDTH, HEIGHT = 360, 196
RADIUS = 80.0
MIDDLES = ((90.0, 100.0), (270.0, 100.0))  # of the disc below and of that above


@dataclass(frozen=True, slots=True)
class Dots:
    """Cells as paths of SVG, drawn with round caps: a dot each.

    shown: seen and counted; fresh: seen just now; wanted: to be shown still; other: the rest
    """

    shown: str
    fresh: str
    wanted: str
    other: str


def dots(shown: Shown, fresh: Bools, *, circle: bool, tilts: bool) -> Dots:
    """The dots of what was shown. circle, tilts: whether more of them is wanted."""
    at = project(centres(), shown.frame_b)
    wanted = ((shown.level & circle) | (shown.tilted & tilts)) & ~shown.seen
    new = fresh & ~shown.seen
    rest = ~shown.seen & ~new & ~wanted
    return Dots(*[_path(at[chosen]) for chosen in (shown.seen, new, wanted & ~new, rest)])


def project(directions_b: Array, frame_b: Array) -> Array:
    """(N, 3) vectors to (N, 2) places in the picture. frame_b: rows ahead, right, down."""
    unit = directions_b / np.linalg.norm(directions_b, axis=1, keepdims=True)
    ahead, right, down = (unit @ frame_b.T).T
    above = down < 0
    from_axis = np.sqrt(np.maximum(1.0 - np.abs(down), 0.0)) * RADIUS
    level = np.maximum(np.hypot(ahead, right), 1e-12)
    middle = np.where(above[:, None], MIDDLES[1], MIDDLES[0])
    return np.asarray(middle + (from_axis / level)[:, None] * np.column_stack([right, -ahead]))


def marker(field_b: Sequence[float | None], frame_b: Array) -> tuple[float, float] | None:
    """Where the field is seen now; None where it is not known."""
    known = [value for value in field_b if value is not None]
    if len(known) < 3 or not np.any(known):
        return None
    x, y = project(np.array([known], dtype=float), frame_b)[0]
    return round(float(x), 1), round(float(y), 1)


class Fresh:
    """Cells that were seen in the newest minutes: shown, but not counted before a verdict."""

    def __init__(self, keep_s: float = 120.0) -> None:
        self._keep_s = keep_s
        self._last_s = np.full(CELLS, -np.inf)

    def take(self, field_b: Sequence[float | None], at_s: float) -> None:
        """The direction at `at_s`; a time that fell begins anew."""
        if np.max(self._last_s) > at_s:
            self._last_s[:] = -np.inf
        if None not in field_b:
            self._last_s[cells_of(np.array([field_b], dtype=float))] = at_s

    def cells(self, at_s: float) -> Bools:
        """(CELLS,) seen within the time that is kept."""
        return np.asarray(self._last_s >= at_s - self._keep_s)


def _path(places: Array) -> str:
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in places.tolist())
