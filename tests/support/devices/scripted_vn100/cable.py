"""The cable between a host and a unit: delays, losses, exchange of the unit, the second master."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scripted_vn100.unit import Change, Unit
from scripted_vn100.wire import sentence


@dataclass
class Faults:
    """What happens to replies: shares of them that are lost, doubled, and late by `late_s`."""

    lost: float = 0.0
    doubled: float = 0.0
    late: float = 0.0
    late_s: float = 0.15
    draw: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))


class Cable:
    """One unit at the end; time is an argument. `units` has every one that ever was there.

    moment(label): called before and after each command of the host is carried out; the script may
                   do anything there, also exchange the unit
    attached:      (time, serial) of every exchange, the first unit included
    """

    def __init__(self, unit: Unit, at_s: float = 0.0) -> None:
        self.unit = unit
        self.units = {unit.serial: unit}
        self.faults = Faults()
        self.attached = [(at_s, unit.serial)]
        self.plugged = True
        self._nobody_until_s = at_s
        self.moment: Callable[[str], None] = lambda _: None
        self.heard: list[tuple[float, int, str]] = []
        self.answered: list[tuple[float, int, str]] = []
        self._input = bytearray()
        self._waiting: list[tuple[float, bytes]] = []
        self._out: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()

    # -- the host's side ---------------------------------------------------------------------------

    def receive(self, data: bytes, at_s: float) -> None:
        """Bytes of the host; while the unit is exchanged nobody hears them."""
        if at_s < self._nobody_until_s:
            self._input.clear()
            return
        self._input += data
        while (end := self._input.find(b"\n")) >= 0:
            line = bytes(self._input[:end]).strip(b"\r")
            del self._input[: end + 1]
            if line:
                self._waiting.append((at_s, line))

    def advance(self, at_s: float) -> bytes:
        """What the host hears up to this time."""
        while self._waiting:
            since_s, line = self._waiting[0]
            begin_s = max(since_s, self.unit.busy_until_s, self.unit.silent_until_s)
            if begin_s > at_s:
                break
            self._waiting.pop(0)
            self._carry_out(line, begin_s)
        for due_s, data in self.unit.stream(at_s):
            self._put(due_s, data)
        found = bytearray()
        while self._out and self._out[0][0] <= at_s:
            found += heapq.heappop(self._out)[2]
        return bytes(found) if self.plugged else b""

    def next_s(self) -> float:
        """When something other than the stream may be heard."""
        waiting = [
            max(s, self.unit.busy_until_s, self.unit.silent_until_s) for s, _ in self._waiting
        ]
        return min([*waiting, *(due_s for due_s, _, _ in self._out[:1])], default=float("inf"))

    def _carry_out(self, line: bytes, at_s: float) -> None:
        text = line.decode("ascii", "replace")
        label = ",".join(text.strip("$").split("*")[0].split(",")[:2])
        self.heard.append((at_s, self.unit.serial, label))
        self.moment(f"before {label}")
        unit = self.unit
        if unit.silent_until_s > at_s:  # exchanged or switched off in this very moment
            return
        due_s, reply = unit.answer(line, at_s)
        self.moment(f"after {label}")
        faults = self.faults
        if self.unit is not unit or faults.draw.random() < faults.lost:
            return
        self.answered.append((at_s, unit.serial, label))
        if faults.late and faults.draw.random() < faults.late:
            due_s += faults.late_s
        self._put(due_s, reply)
        if faults.doubled and faults.draw.random() < faults.doubled:
            self._put(due_s + 0.001, reply)

    def _put(self, due_s: float, data: bytes) -> None:
        heapq.heappush(self._out, (due_s, next(self._order), data))

    # -- what the script does ----------------------------------------------------------------------

    def exchange(self, unit: Unit, at_s: float, *, silent_s: float = 0.0) -> None:
        """Another unit takes over; what the old one had not said yet is gone."""
        self.unit = unit
        self.units[unit.serial] = unit
        self.attached.append((at_s, unit.serial))
        self._out.clear()
        self._waiting.clear()
        self._input.clear()
        self._nobody_until_s = at_s + silent_s
        unit.asynchronous = True
        unit.silent_until_s = at_s + silent_s
        unit.attach(at_s + silent_s)

    def other_master(self, body: str, at_s: float) -> bytes:
        """A command over the unit's other port; its reply goes there too."""
        return self.unit.answer(sentence(body).strip(), at_s, "other")[1]

    def log(self) -> list[Change]:
        """All changes of all units, in time."""
        return sorted((c for u in self.units.values() for c in u.log), key=lambda c: c.at_s)
