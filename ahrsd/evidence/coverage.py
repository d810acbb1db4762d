"""Which attitudes the vehicle has shown, and what is missing in words."""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.evidence.directions import shown
from ahrsd.evidence.heading import sectors
from ahrsd.evidence.segments import Nodes
from ahrsd.evidence.values import SECTOR_DEG, SECTORS, Bools, Coverage, Regime
from ahrsd.samples import Array

PLANAR_DEG = 5.0
FREE_DEG = 30.0
_ANY_DEG = 45.0  # of heading, below which there was no motion to speak of


def coverage(nodes: Nodes, heading_rad: Array, correction: Affine) -> Coverage:
    """Coverage of all segments; `heading_rad` (N,) is their `gyro_heading_rad`."""
    directions = shown(correction.apply(nodes.raw_b_gauss))
    if not nodes.has_gravity:
        nan = float("nan")
        return Coverage(nan, nan, nan, "unknown", "add acceleration to the stream", directions)
    seen = sectors(heading_rad)
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
    """The shorter way to sweep every sector that is missing, from the present heading."""
    missing = np.flatnonzero(~seen)
    if len(missing) == 0:
        return ""
    here = int(heading_deg // SECTOR_DEG)
    right = int(np.max((missing - here) % SECTORS)) * SECTOR_DEG
    left = int(np.max((here - missing) % SECTORS)) * SECTOR_DEG
    way, far = ("left", left) if left < right else ("right", right)
    return f"turn {way} about {far:.0f} deg more"


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
