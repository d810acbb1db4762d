"""How long it will take at the present rate: each gate's way to its limit, and what was shown."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

from ahrsd.evidence.segments import HistoryParameters
from ahrsd.telemetry.driving import shown_of

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
