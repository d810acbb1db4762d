"""Directions of the field in the sensor's own frame, as cells of a sphere.

The sphere is cut into rings of 10 degrees from the sensor's z axis, each ring into sectors of about
10 degrees of arc, so that all cells are about equally large. A vehicle that turns level shows one
ring; where it tilts, it shows what lies beside that ring. Numbers of cells run ring by ring from
+z, in a ring from +x to +y.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.evidence.values import Bools
from ahrsd.samples import Array

CELL_DEG = 10.0
_RINGS = round(180.0 / CELL_DEG)
_MIDDLE_RAD = np.radians((np.arange(_RINGS) + 0.5) * CELL_DEG)
_SECTORS = np.round(360.0 / CELL_DEG * np.sin(_MIDDLE_RAD)).astype(int)
_FIRST = np.concatenate([[0], np.cumsum(_SECTORS)])
CELLS = int(_FIRST[-1])


def cells_of(directions_b: Array) -> NDArray[np.intp]:
    """The cell of each (N, 3) vector; only its direction counts. Vectors of no length: none."""
    length = np.linalg.norm(directions_b, axis=1)
    unit = directions_b[length > 0] / length[length > 0, None]
    from_z_rad = np.arccos(np.clip(unit[:, 2], -1.0, 1.0))
    ring = np.minimum((np.degrees(from_z_rad) / CELL_DEG).astype(int), _RINGS - 1)
    share = np.arctan2(unit[:, 1], unit[:, 0]) / (2 * np.pi) % 1.0
    sector = np.minimum((share * _SECTORS[ring]).astype(int), _SECTORS[ring] - 1)
    return np.asarray(_FIRST[ring] + sector, dtype=np.intp)


def shown(directions_b: Array) -> Bools:
    """(CELLS,) the cells in which at least one of the (N, 3) vectors lies."""
    seen = np.zeros(CELLS, dtype=bool)
    seen[cells_of(directions_b)] = True
    return seen


def centres() -> Array:
    """(CELLS, 3) unit vectors to the middle of each cell."""
    ring = np.repeat(np.arange(_RINGS), _SECTORS)
    sector = np.arange(CELLS) - _FIRST[ring]
    angle = 2 * np.pi * (sector + 0.5) / _SECTORS[ring]
    level = np.sin(_MIDDLE_RAD)[ring]
    return np.column_stack(
        [level * np.cos(angle), level * np.sin(angle), np.cos(_MIDDLE_RAD)[ring]]
    )
