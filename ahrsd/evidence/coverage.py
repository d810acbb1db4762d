"""Which field directions and attitudes the data cover, and in words what is missing.

Directions are those of the field in the sensor frame, as cells of a sphere. The sphere is divided
into rings of 10 degrees from the sensor's z axis, and each ring into sectors of about 10 degrees of
arc, so that all cells have about the same area. A vehicle that turns level visits one ring; with
tilt it visits neighbouring rings. Cells are numbered ring by ring from +z, within a ring from +x to
+y.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.calibration import Affine
from ahrsd.evidence.heading import visited_sectors
from ahrsd.evidence.segments import Nodes
from ahrsd.evidence.values import FREE_DEG, SECTOR_DEG, SECTORS, Bools, Coverage, Regime
from ahrsd.samples import Array

# -- Directions ------------------------------------------------------------------------------------


CELL_DEG = 10.0
_RINGS = round(180.0 / CELL_DEG)
_MIDDLE_RAD = np.radians((np.arange(_RINGS) + 0.5) * CELL_DEG)
_SECTORS = np.round(360.0 / CELL_DEG * np.sin(_MIDDLE_RAD)).astype(int)
_FIRST = np.concatenate([[0], np.cumsum(_SECTORS)])
CELLS = int(_FIRST[-1])


def cells_of(directions_b: Array) -> NDArray[np.intp]:
    """The cell of each (N, 3) vector by its direction; vectors of zero length are left out."""
    length = np.linalg.norm(directions_b, axis=1)
    unit = directions_b[length > 0] / length[length > 0, None]
    from_z_rad = np.arccos(np.clip(unit[:, 2], -1.0, 1.0))
    ring = np.minimum((np.degrees(from_z_rad) / CELL_DEG).astype(int), _RINGS - 1)
    share = np.arctan2(unit[:, 1], unit[:, 0]) / (2 * np.pi) % 1.0
    sector = np.minimum((share * _SECTORS[ring]).astype(int), _SECTORS[ring] - 1)
    return np.asarray(_FIRST[ring] + sector, dtype=np.intp)


def visited_cells(directions_b: Array) -> Bools:
    """(CELLS,) whether at least one of the (N, 3) vectors lies in the cell."""
    seen = np.zeros(CELLS, dtype=bool)
    seen[cells_of(directions_b)] = True
    return seen


def cell_centres() -> Array:
    """(CELLS, 3) unit vectors to the centre of each cell."""
    ring = np.repeat(np.arange(_RINGS), _SECTORS)
    sector = np.arange(CELLS) - _FIRST[ring]
    angle = 2 * np.pi * (sector + 0.5) / _SECTORS[ring]
    level = np.sin(_MIDDLE_RAD)[ring]
    return np.column_stack(
        [level * np.cos(angle), level * np.sin(angle), np.cos(_MIDDLE_RAD)[ring]]
    )


# -- Attitudes -------------------------------------------------------------------------------------


PLANAR_DEG = 5.0
_ANY_DEG = 45.0  # range of heading below which there is no motion to evaluate


def motion_coverage(nodes: Nodes, heading_rad: Array, correction: Affine) -> Coverage:
    """Coverage of all segments; `heading_rad` (N,) is their `gyro_heading_rad`."""
    directions = visited_cells(correction.apply(nodes.raw_b_gauss))
    if not nodes.has_gravity:
        nan = float("nan")
        return Coverage(nan, nan, nan, "unknown", "add acceleration to the stream", directions)
    seen = visited_sectors(heading_rad)
    down_b = nodes.down_b
    roll_deg = _half_range(np.degrees(np.unwrap(np.arctan2(down_b[:, 1], down_b[:, 2]))))
    pitch_deg = _half_range(np.degrees(np.arcsin(np.clip(-down_b[:, 0], -1.0, 1.0))))
    heading_deg = float(np.count_nonzero(seen) * SECTOR_DEG)
    known = heading_rad[np.isfinite(heading_rad)]
    return Coverage(
        heading_deg=heading_deg,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
        regime=_regime(heading_deg, roll_deg, pitch_deg, down_b),
        turn=turn_advice(seen, float(np.degrees(known[-1]))) if len(known) else "",
        directions=directions,
        down_b=np.mean(down_b, axis=0),
    )


def turn_advice(seen: Bools, heading_deg: float) -> str:
    """Advice: the shorter turn that visits all missing sectors, from the present heading."""
    missing = np.flatnonzero(~seen)
    if len(missing) == 0:
        return ""
    here = int(heading_deg // SECTOR_DEG)
    right = int(np.max((missing - here) % SECTORS)) * SECTOR_DEG
    left = int(np.max((here - missing) % SECTORS)) * SECTOR_DEG
    side, angle_deg = ("left", left) if left < right else ("right", right)
    return f"turn {side} about {angle_deg:.0f} deg more"


def _regime(heading_deg: float, roll_deg: float, pitch_deg: float, down_b: Array) -> Regime:
    if min(roll_deg, pitch_deg) >= FREE_DEG:
        return "3D"
    if heading_deg < _ANY_DEG:
        return "none"
    mean = np.mean(down_b, axis=0)
    tilt = np.degrees(np.arccos(np.clip(down_b @ mean / np.linalg.norm(mean), -1.0, 1.0)))
    return "2D" if np.quantile(tilt, 0.99) <= PLANAR_DEG else "partial"


def _half_range(values: Array) -> float:
    low, high = np.quantile(values, [0.01, 0.99])
    return float(min(high - low, 360.0) / 2)
