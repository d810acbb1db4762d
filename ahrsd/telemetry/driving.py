"""Which way to turn the vehicle next, in words, and how long it will take at the present rate.

From the directions that the vehicle has shown, and each gate's way to its limit. The field is fixed
to the Earth, so a vehicle that turns level shows one ring of directions round its own down axis,
and one that leans over shows what lies beside that ring. All angles in degrees.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ahrsd.evidence.coverage import CELLS, cell_centres
from ahrsd.evidence.segments import HistoryParameters
from ahrsd.evidence.values import Bools
from ahrsd.samples import Array

# -- Which way to turn -----------------------------------------------------------------------------


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
    from_down = np.degrees(np.arccos(np.clip(cell_centres() @ frame_b[2], -1.0, 1.0)))
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
    middle = cell_centres()
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


# -- How long it takes -----------------------------------------------------------------------------


_WINDOW_S = 150.0  # the present: a verdict comes every few seconds, a segment lasts 30
_LEAST_S = 20.0
_LONGEST_S = 3600.0  # beyond that, the rate of today says nothing
_EVERY_S = 1.0

#: a segment is held out once in so long, and must have turned by 60 deg to be of use
_HELD_OUT_S = HistoryParameters().segment_s * HistoryParameters().heldout_every
_TURNS_DEG_S = 60.0 / HistoryParameters().segment_s
_FOLLOWS = "evidence.complete"
_WINDOWS, _COVERAGE = "heldout_heading.windows", "heldout_heading.coverage"

LEVEL, TILTED = "level circle", "tilts"  # names of what was shown, beside those of the gates


class Pace:
    """Remembers the newest minutes of what moves. Time is the device's."""

    def __init__(self) -> None:
        self._seen: dict[str, deque[tuple[float, float]]] = {}
        self._goals: dict[str, float] = {}
        self._turning: deque[tuple[float, float]] = deque()  # deg/s
        self._at_s = -math.inf

    def take(self, status: Mapping[str, Any]) -> None:
        """The newest status; where the device's time fell, what was before is forgotten."""
        at_s = float(status["at_s"] or 0.0)
        if at_s < self._at_s:
            self._seen.clear()
            self._turning.clear()
            self._at_s = -math.inf
        if at_s - self._at_s < _EVERY_S:
            return
        self._at_s, self._goals = at_s, {}
        for gate in status["gates"]:
            if not gate["ok"] and gate["value"] is not None and gate["limit"] is not None:
                self._add(gate["gate"], gate["value"], gate["limit"])
        if (shown := shown_of(status)) is not None:
            self._add(LEVEL, shown.level_share, 1.0)
            self._add(TILTED, shown.tilted_share, 1.0)
        turning = (status.get("readings") or {}).get("gyro_b_rad_s") or [None]
        if None not in turning:
            _append(self._turning, self._at_s, math.degrees(math.hypot(*turning)))
        self._seen = {name: seen for name, seen in self._seen.items() if name in self._goals}

    def _add(self, name: str, value: float, goal: float) -> None:
        self._goals[name] = float(goal)
        _append(self._seen.setdefault(name, deque()), self._at_s, float(value))

    def left_s(self, name: str) -> float | None:
        """Time until the goal; None where it does not come nearer, or not within an hour."""
        seen = self._seen.get(name)
        if not seen:
            return None
        (first_s, first), (last_s, last) = seen[0], seen[-1]
        found = left_s(last_s - first_s, first, last, self._goals[name])
        if found is None and name in (_WINDOWS, _COVERAGE) and self._turns:
            missing = max(self._goals[name] - last, 1.0) if name == _WINDOWS else 1.0
            return missing * _HELD_OUT_S
        return found

    @property
    def _turns(self) -> bool:
        """Whether the vehicle turns enough for segments that are held out."""
        rates = [rate for _, rate in self._turning]
        return bool(rates) and sum(rates) / len(rates) >= _TURNS_DEG_S

    def slowest(self, gates: Iterable[str]) -> tuple[str, float] | None:
        """Which of these gates opens last; None where nobody can say."""
        left = {name: self.left_s(name) for name in self._moving(gates)}
        known = {name: seconds for name, seconds in left.items() if seconds is not None}
        if not known or len(known) < len(left):
            return None
        name = max(known, key=lambda one: known[one])
        return name, known[name]

    def standing(self, gates: Iterable[str]) -> list[str]:
        """Those of these gates that were followed for long enough and do not come nearer."""
        return [
            name
            for name in self._moving(gates)
            if self.left_s(name) is None and self._at_s - self._seen[name][0][0] >= _LEAST_S
        ]

    def _moving(self, gates: Iterable[str]) -> list[str]:
        """Gates that are measured; the count of what is not measured yet follows from others."""
        return [name for name in gates if name in self._goals and name != _FOLLOWS]


def _append(seen: deque[tuple[float, float]], at_s: float, value: float) -> None:
    seen.append((at_s, value))
    while seen[0][0] < at_s - _WINDOW_S:
        seen.popleft()


def left_s(span_s: float, first: float, last: float, goal: float) -> float | None:
    """Time from `last` to `goal` for what came from `first` to `last` in `span_s`.

    What grows does so evenly; what falls, falls by the same share in the same time.
    """
    if span_s < _LEAST_S:
        return None
    if last == goal or (last - goal) * (first - goal) < 0:
        return 0.0
    if last > goal:
        if goal <= 0 or first <= 0:
            return None
        first, last, goal = math.log(first), math.log(last), math.log(goal)
    rate = (last - first) / span_s
    if (goal - last) * rate <= 0:
        return None
    left = (goal - last) / rate
    return left if left <= _LONGEST_S else None


def about(seconds: float | None) -> str:
    """The time in words, coarse as it is known."""
    if seconds is None:
        return "not at the present rate"
    if seconds < 50.0:
        return f"about {max(math.ceil(seconds / 10.0), 1) * 10} s at the present rate"
    return f"about {max(round(seconds / 60.0), 1)} min at the present rate"
