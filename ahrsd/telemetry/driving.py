"""Which way to turn the vehicle next, in words: from the directions that it has shown.

The field is fixed to the Earth, so a vehicle that turns level shows one ring of directions round
its own down axis, and one that leans over shows what lies beside that ring. All angles in degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ahrsd.evidence.coverage import CELLS, centres
from ahrsd.evidence.values import Bools
from ahrsd.samples import Array

REACH_DEG = 30.0  # how far a vehicle is asked to lean over
_LEVEL_DEG = 7.5  # half width of the ring of a level circle
_CIRCLE_DEG = 360.0
#: gates that open when a vehicle leans over; tests/telemetry/test_driving.py compares with advice
HELPED_BY_TILT = frozenset(
    {
        "field.inclination",
        "motion.planar_circle",
        "observability.converged",
        "observability.heading_sigma",
        "observability.held",
        "observability.score",
        "second_opinion.heading",
    }
)

#: azimuth of magnetic north from ahead, by quarters: where the vehicle faces then, and what it does
#: so that the side to the north goes down, or up
_QUARTERS = (
    ("north", 0.0, "nose down", "nose up"),
    ("west", 270.0, "roll to the right", "roll to the left"),
    ("south", 180.0, "nose up", "nose down"),
    ("east", 90.0, "roll to the left", "roll to the right"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """Directions that were shown, and those that a vehicle could show.

    seen, level, tilted (CELLS,): cells seen; of a level circle; of tilts up to `REACH_DEG`
    frame_b (3, 3): rows ahead, right, down of the level vehicle, in the sensor's axes
    ring_deg: angle from down to the field
    """

    seen: Bools
    level: Bools
    tilted: Bools
    frame_b: Array
    ring_deg: float

    @property
    def level_share(self) -> float:
        """Share of the level circle that was shown."""
        return _share(self.seen, self.level)

    @property
    def tilted_share(self) -> float:
        """The same of the tilts."""
        return _share(self.seen, self.tilted)


def shown_of(status: Mapping[str, Any]) -> Shown | None:
    """What the status says of it; None where the stream tells no down or nothing was counted."""
    motion = status["motion"]
    cells = None if motion is None else motion.get("directions")
    if not cells or len(cells) != CELLS or motion["dip_deg"] is None or None in motion["down_b"]:
        return None
    seen = np.array([cell == "1" for cell in cells])
    frame_b = _level_frame(np.array(motion["down_b"], dtype=float))
    ring_deg = 90.0 - float(motion["dip_deg"])
    from_down = np.degrees(np.arccos(np.clip(centres() @ frame_b[2], -1.0, 1.0)))
    level = np.abs(from_down - ring_deg) <= _LEVEL_DEG
    tilted = (np.abs(from_down - ring_deg) <= REACH_DEG) & ~level
    return Shown(seen, level, tilted, frame_b, ring_deg)


def tilt_is_wanted(status: Mapping[str, Any]) -> bool:
    """Whether a gate is shut that leaning over would help to open."""
    return any(not gate["ok"] and gate["gate"] in HELPED_BY_TILT for gate in status["gates"])


def circle_is_wanted(status: Mapping[str, Any]) -> bool:
    """Whether more of the level circle is of use: a heading is missing, or a tilt is wanted."""
    motion = status["motion"]
    return bool(motion is None or motion["next"]) or tilt_is_wanted(status)


def drive_next(status: Mapping[str, Any]) -> str:
    """What to drive next; empty where the directions that were shown are enough."""
    motion, shown = status["motion"], shown_of(status)
    if motion is None:
        return "drive two full circles in calm surroundings"
    if motion["next"]:
        return str(motion["next"])
    if shown is None or not tilt_is_wanted(status):
        return ""
    seen = status.get("readings") or {}
    new, now = seen.get("heading_would_be_deg"), seen.get("heading_deg")
    return _lean(shown, now if new is None else new)


def _lean(shown: Shown, heading_deg: float | None) -> str:
    """The quarter in which most tilts are missing, with the turn that leads there."""
    ahead, right, down = shown.frame_b
    middle = centres()
    quarter = (
        np.round(np.degrees(np.arctan2(middle @ right, middle @ ahead)) / 90.0).astype(int) % 4
    )
    farther = np.degrees(np.arccos(np.clip(middle @ down, -1.0, 1.0))) > shown.ring_deg
    missing = shown.tilted & ~shown.seen
    if not missing.any():
        return ""
    counts = np.array(
        [
            [np.count_nonzero(missing & (quarter == q) & (farther == away)) for away in (1, 0)]
            for q in range(4)
        ]
    )
    q, down_or_up = divmod(int(np.argmax(counts)), 2)
    name, face_deg, *leans = _QUARTERS[q]
    turn = _turn(heading_deg, face_deg)
    lean = f"{leans[down_or_up]} by up to {REACH_DEG:.0f} deg"
    return f"face {name}{turn} and {lean}, if the vehicle can"


def _turn(heading_deg: float | None, face_deg: float) -> str:
    if heading_deg is None:
        return ""
    turn = (face_deg - heading_deg + 180.0) % _CIRCLE_DEG - 180.0
    if abs(turn) < 20.0:
        return " (as now)"
    return f" ({abs(turn):.0f} deg to the {'right' if turn > 0 else 'left'})"


def _level_frame(down_b: Array) -> Array:
    down = down_b / max(float(np.linalg.norm(down_b)), 1e-9)
    ahead = np.array([1.0, 0.0, 0.0]) - down * down[0]
    if np.linalg.norm(ahead) < 0.1:  # x stands upright: any level axis does
        ahead = np.array([0.0, 1.0, 0.0]) - down * down[1]
    ahead /= np.linalg.norm(ahead)
    return np.array([ahead, np.cross(down, ahead), down])


def _share(seen: Bools, of: Bools) -> float:
    total = int(np.count_nonzero(of))
    return int(np.count_nonzero(seen & of)) / total if total else 0.0
