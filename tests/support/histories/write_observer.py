"""Who wrote what into which unit, and whether that was right: an observer outside the product.

It knows the true iron of every unit, hears what the daemon announces, reads what it journals, and
has each unit's own log. It imports nothing of the project. What it counts:

not_judged_here    a value in a unit that was not judged on that unit: neither its own (what it held
                   or somebody else put there) nor a candidate announced while it was on the cable
                   and right for the iron that it felt; but for a unit that told before to hold a
                   value of this register which it does not apply: its samples cannot be un-mapped
other_journal      a value of a candidate, journaled under another unit's number
void_save          a save of values that the iron had made wrong, as `GRACE_S` of readings showed:
                   iron that leaves a field's length as it was shows in no reading at rest
foreign_save       a save of what another program wrote while this one listened, and did not save
half_save          a save while the device does not hold all of the transaction's new values; one
                   that shows them in every reading and does not apply them is for the trial on
                   samples to find, and that lasts two seconds in these histories
foreign_replaced   a write over another program's value that the unit shows and the journal knows
                   nothing of; a write that the unit did not carry out made no value another
                   program's
proven_not_held    PROVEN of values that the device, when asked, does not show
unproven_saved     a save for a client (no FLASH_SENT announced it) of a value that came from the
                   daemon and that nothing has made permanent before; but for a unit that shows
                   the old value in every reading and applies the new one
false_confirmed    CONFIRMED although that unit did not restart with the values in its flash
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scripted_vn100 import Cable, Change, Unit
from scripted_vn100.memory import stored

GRACE_S = 3.0  # in which nobody can know yet that the iron changed
VISIBLE_GAUSS, READINGS_S, LONGEST_S = 0.008, 0.2, 60.0
RACE_S = 1.5  # in which another program's write may slip between a look and an act
HARD_GAUSS, SOFT, BIAS_RAD_S = 0.012, 0.03, 0.004
KINDS = (
    "not_judged_here", "other_journal", "void_save", "foreign_save", "half_save",
    "foreign_replaced", "proven_not_held", "unproven_saved", "false_confirmed",
)  # fmt: skip
_LINE = re.compile(r"\$VNWRG,0?(23|84),([^*]*)\*")
_REGISTERS = (23, 84)
_OF_NO_WRITE = ("LOCKED", "UNLOCKED", "CLIENT_SAVED", "CLIENT_RESET", "CLIENT_WRITES")


@dataclass
class Seen:
    """What is known of one unit. Texts are register values as the device prints them."""

    own: dict[int, set[str]] = field(default_factory=lambda: {23: set(), 84: set()})
    judged: dict[int, dict[str, float]] = field(default_factory=lambda: {23: {}, 84: {}})
    author: dict[int, tuple[str, float]] = field(
        default_factory=lambda: {23: ("unit", -1e9), 84: ("unit", -1e9)}
    )
    flash_author: dict[int, tuple[str, float]] = field(
        default_factory=lambda: {23: ("unit", -1e9), 84: ("unit", -1e9)}
    )
    changed_s: float = -1e9
    restarts: list[tuple[float, tuple[str, str]]] = field(default_factory=list)
    prepared: dict[str, Any] | None = None
    prepared_s: float = -1e9
    sent_s: float = -1e9
    announced: bool = False  # a save of the daemon's own, by its journal
    lies: set[int] = field(default_factory=set)  # registers that showed another value at PREPARED
    flash: dict[int, str] = field(default_factory=dict)
    kept: dict[int, set[str]] = field(default_factory=lambda: {23: set(), 84: set()})
    noted: int = 0


class Observer:
    """Call `look` after whatever may have changed a unit; `violations` are lines of text."""

    def __init__(self, cable: Cable) -> None:
        self.cable = cable
        self.units: dict[int, Seen] = {}
        self.violations: list[tuple[str, str]] = []
        self.counts: Counter[str] = Counter()
        self.newest_prepared: int | None = None
        self.begun_s = 0.0
        self.clients_values: set[tuple[int, str]] = set()
        self.attached_s: dict[int, list[float]] = defaultdict(list)

    # -- what it is told ---------------------------------------------------------------------------

    def begun(self, at_s: float) -> None:
        """The program was started: what it reads first in a unit is that unit's own, for it."""
        self.begun_s = at_s

    def look(self, at_s: float) -> None:
        """Take what is new in the units' logs up to this time."""
        for unit in list(self.cable.units.values()):
            seen = self.seen(unit)
            while seen.noted < len(unit.log) and unit.log[seen.noted].at_s <= at_s:
                seen.noted += 1
                self._change(unit, seen, unit.log[seen.noted - 1])

    def asked_by_client(self, body: str) -> None:
        """A program on the owner's port sends this line; what it writes is its own."""
        if match := _LINE.search(f"${body}*"):
            self.clients_values.add((int(match[1]), stored(int(match[1]), match[2].split(","))))

    def announced(self, text: str, at_s: float) -> None:
        """A line of the daemon's log; candidates are named in it with the lines to send."""
        if "candidate" not in text:
            return
        unit = self.cable.unit
        seen = self.seen(unit)
        for number, body in _LINE.findall(text):
            printed = stored(int(number), body.split(","))
            seen.judged[int(number)][printed] = at_s
            self.counts["candidates"] += 1

    def record(
        self, serial: int, kind: str, facts: dict[str, Any], at_s: float, *, late: bool = False
    ) -> None:
        """A record that reached the journal of this serial number.

        late: the disk was full when it was made, so it says how things stood then
        """
        self.look(at_s)
        self.counts[kind] += 1
        if serial not in self.cable.units:
            return
        unit = self.cable.units[serial]
        seen = self.seen(unit)
        if kind not in _OF_NO_WRITE:
            seen.announced = kind == "FLASH_SENT"
        if kind == "PREPARED":
            seen.prepared, self.newest_prepared = dict(facts), serial
            seen.prepared_s, seen.sent_s = at_s, -1e9
            seen.lies = {n for n in _REGISTERS if unit.shown(n) != unit.memory.ram[n]}
        elif kind == "FLASH_SENT":
            seen.sent_s = at_s
        elif kind == "PROVEN" and not facts.get("unsent") and not late:
            new = self._new(seen)
            held = all(unit.shown(n) == text for n, text in new.items())
            if not (held and self.cable.unit is unit) and at_s - self._since_s(seen) > RACE_S:
                self._wrong("proven_not_held", at_s, f"unit {serial} holds {unit.memory.ram[23]}")
        elif kind == "CONFIRMED":
            self._confirmed(unit, seen, at_s)

    # -- what it concludes -------------------------------------------------------------------------

    def seen(self, unit: Unit) -> Seen:
        """What is known of a unit."""
        if unit.serial not in self.units:
            seen = self.units[unit.serial] = Seen()
            seen.flash = {number: unit.memory.flash[number] for number in _REGISTERS}
            for number in _REGISTERS:
                seen.own[number] |= {unit.memory.flash[number], unit.memory.ram[number]}
        return self.units[unit.serial]

    def _since_s(self, seen: Seen) -> float:
        """Since when the unit at the cable is as it is."""
        return max(seen.changed_s, self.cable.attached[-1][0])

    def _change(self, unit: Unit, seen: Seen, change: Change) -> None:
        if change.what == "write" and change.register in _REGISTERS:
            who = change.who
            if (change.register, change.asked) in self.clients_values:
                who = "other"  # whoever it is: not the daemon
                self.counts["client writes"] += 1
            if who == "other":
                seen.own[change.register].add(change.after)
            else:
                self._written(unit, seen, change)
            if change.after == change.asked:  # else what is there is still whose it was
                seen.author[change.register] = (who, change.at_s)
            seen.changed_s = change.at_s
        elif change.what == "save":
            if change.who == "host" and seen.announced:
                self._saved(unit, seen, change)
                seen.announced = False
            elif change.who == "host":
                self._saved_for_a_client(unit, seen, change)
            elif change.who == "other":  # whoever saves it makes it the user's
                for number, text in zip(_REGISTERS, change.pair, strict=True):
                    seen.own[number].add(text)
            seen.flash_author = dict(seen.author)
            seen.flash = dict(zip(_REGISTERS, change.pair, strict=True))
        elif change.what in ("restart", "factory"):
            seen.restarts.append((change.at_s, change.pair))
            seen.flash = dict(zip(_REGISTERS, change.pair, strict=True))
            seen.author = dict(seen.flash_author)
            seen.changed_s = change.at_s

    def _written(self, unit: Unit, seen: Seen, change: Change) -> None:
        number, text = change.register, change.asked
        self.counts["writes"] += 1
        who, since_s = seen.author[number]
        if who == "other" and change.at_s - since_s > RACE_S and text != change.before:
            named = [self._pair(seen, which).get(number) for which in ("old", "new")]
            if change.before not in named and number not in seen.lies:
                self._wrong("foreign_replaced", change.at_s, f"register {number}: {change.before}")
        if text in seen.own[number]:
            return
        announced = text in seen.judged[number]
        lied = any(
            one.what == "write" and one.register == number and one.asked != one.after
            for one in unit.log
            if one.at_s < change.at_s
        )
        judged = announced and (lied or self._was_right(unit, number, text, change.at_s))
        where = f"unit {unit.serial} register {number}: {text}"
        if not judged:
            self._wrong("not_judged_here", change.at_s, where)
        if (
            self.newest_prepared != unit.serial
            or (seen.prepared or {}).get("serial") != unit.serial
        ):
            self._wrong("other_journal", change.at_s, f"{where}, journal {self.newest_prepared}")

    def _saved(self, unit: Unit, seen: Seen, change: Change) -> None:
        self.counts["saves"] += 1
        at_s, ram = change.at_s, dict(zip(_REGISTERS, change.pair, strict=True))
        new = self._new(seen)
        for number in _REGISTERS:
            text = ram[number]
            seen.kept[number].add(text)
            who, since_s = seen.author[number]
            theirs = who == "other" and seen.flash_author[number] != (who, since_s)
            known_s = self._first_read_s(unit, number, since_s)
            theirs &= since_s > max(known_s, self.begun_s + RACE_S)
            if theirs and at_s - since_s > RACE_S and text != new.get(number):
                self._wrong("foreign_save", at_s, f"unit {unit.serial} register {number}: {text}")
            half = number in new and new[number] not in (text, unit.shown(number))
            if half and at_s - self._since_s(seen) > RACE_S:
                self._wrong("half_save", at_s, f"unit {unit.serial} register {number}: {text}")
            ours = who == "host" and text not in seen.own[number]
            if ours and self._shown_s(unit, number, text, at_s) >= GRACE_S:
                self._wrong("void_save", at_s, f"unit {unit.serial} register {number}: {text}")

    def _saved_for_a_client(self, unit: Unit, seen: Seen, change: Change) -> None:
        self.counts["client saves"] += 1
        for number, text in zip(_REGISTERS, change.pair, strict=True):
            if text == seen.flash.get(number):  # it makes nothing permanent that was not
                continue
            if not {text, unit.shown(number)} & (seen.own[number] | seen.kept[number]):
                where = f"unit {unit.serial} register {number}: {text}"
                self._wrong("unproven_saved", change.at_s, where)

    def _shown_s(self, unit: Unit, number: int, text: str, until_s: float) -> float:
        """For how long readings have shown that this value is wrong, since it was right last."""
        shown_s = 0.0
        for at_s in np.arange(until_s, max(until_s - LONGEST_S, 0.0), -READINGS_S):
            if self._right(unit, number, text, float(at_s)):
                break
            shown_s += READINGS_S * self._visible(unit, number, text, float(at_s))
        return shown_s

    def _visible(self, unit: Unit, number: int, text: str, at_s: float) -> bool:
        """Whether a reading that this value corrects is not as long as the field is."""
        if number == 84:
            return True
        values, iron = np.array([float(token) for token in text.split(",")]), unit.iron
        field = unit.vehicle.field_b(at_s, READINGS_S)
        raw = iron.soft @ field + iron.hard_gauss + unit.vehicle.hard_at(at_s)
        away = np.linalg.norm(values[:9].reshape(3, 3) @ (raw - values[9:]))
        return bool(abs(away - np.linalg.norm(field)) > VISIBLE_GAUSS)

    def _first_read_s(self, unit: Unit, number: int, until_s: float) -> float:
        """When this run of the program read a register of this unit first, since its last restart
        before a time: what it reads behind a restart it must take for what is in flash."""
        label = f"VNRRG,{number}"
        restarts = [at_s for at_s, _ in self.seen(unit).restarts if at_s <= until_s]
        begun_s = max([self.begun_s, *restarts])
        times = (
            at_s
            for at_s, serial, heard in self.cable.answered
            if at_s >= begun_s and (serial, heard) == (unit.serial, label)
        )
        return next(times, float("inf"))

    def _confirmed(self, unit: Unit, seen: Seen, at_s: float) -> None:
        new = self._new(seen)
        begun_s = max(seen.sent_s, seen.prepared_s)
        shown = [
            at
            for at, pair in seen.restarts
            if at >= begun_s
            and all(dict(zip(_REGISTERS, pair, strict=True))[n] == text for n, text in new.items())
        ]
        if not new or not shown or self.cable.unit is not unit:
            self._wrong(
                "false_confirmed", at_s, f"unit {unit.serial}, restarts {seen.restarts[-2:]}"
            )

    def _pair(self, seen: Seen, which: str) -> dict[int, str]:
        values = (seen.prepared or {}).get(which, {})
        return {int(n): stored(int(n), [repr(float(v)) for v in row]) for n, row in values.items()}

    def _new(self, seen: Seen) -> dict[int, str]:
        return self._pair(seen, "new")

    def _was_right(self, unit: Unit, number: int, text: str, until_s: float) -> bool:
        """Whether the value was right for what this unit felt, at any time while it was there."""
        times = [0.0, *(at_s for at_s, _ in unit.vehicle.moved), until_s]
        return any(self._right(unit, number, text, at_s) for at_s in times if at_s <= until_s)

    def _right(self, unit: Unit, number: int, text: str, at_s: float) -> bool:
        values = np.array([float(token) for token in text.split(",")])
        iron = unit.iron
        if number == 84:
            return bool(np.abs(values[9:] - iron.gyro_bias_rad_s).max() < BIAS_RAD_S)
        wanted = iron.moved(unit.vehicle.hard_at(at_s)).correction()
        matrix = values[:9] / np.cbrt(np.linalg.det(values[:9].reshape(3, 3)))
        return bool(
            np.abs(matrix - wanted[:9]).max() < SOFT
            and np.linalg.norm(values[9:] - wanted[9:]) < HARD_GAUSS
        )

    def _wrong(self, kind: str, at_s: float, text: str) -> None:
        self.counts[kind] += 1
        self.violations.append((kind, f"{at_s:.2f} s: {kind}: {text}"))
