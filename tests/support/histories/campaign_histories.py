"""Random histories in which something always forbids a write: how many writes there are.

Six families, taken in turn; in the first five every single verdict has what the name says:

ram gate red    one to three gates that guard RAM are red, the mode is stage or commit
flash gate red  all is green but one to three gates that guard the flash; mode commit
observe, passive all is green, the mode forbids
not armed       all is green, nobody need approve, and nobody has spoken in this run
mixed           gates come and go; a write is wrong where the newest verdict was not green
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from writeback_rig import Rig, estimate

from ahrsd.calibration import Estimate
from ahrsd.events import GateResult
from ahrsd.gates import GATES, Level, for_level
from ahrsd.writeback import flow
from ahrsd.writeback.composition import Proposal, UnwritableError
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import Command, Read, Word, Write

FAMILIES = ("ram gate red", "flash gate red", "observe", "passive", "not armed", "mixed")
STEPS = 24


@cache
def table() -> tuple[GateResult, ...]:
    """Every gate there is, green."""
    return tuple(
        GateResult(gate.gate, 1.0, 1.0, True, 0.0, "", "the advice of this gate") for gate in GATES
    )


@cache
def guarding(level: Level) -> tuple[GateResult, ...]:
    """The gates that guard this level, green."""
    return for_level(table(), level)


@cache
def found_with(shift: int) -> Estimate:
    """One of a few estimates."""
    return estimate(hard_iron_gauss=np.array([0.03 * shift, 0.04, -0.02]))


@contextmanager
def remembered() -> Iterator[None]:
    """While it lasts, what `compose` answered once it answers again: it is a pure function."""
    true, known = flow.compose, dict[Any, Proposal | UnwritableError]()

    def compose(found: Estimate, registers: Any, *, gyro_is_raw: bool = True) -> Proposal:
        key = (id(found), registers.get(23), registers.get(84), registers.get(26), gyro_is_raw)
        if key not in known:
            try:
                known[key] = true(found, registers, gyro_is_raw=gyro_is_raw)
            except UnwritableError as error:
                known[key] = error
        answer = known[key]
        if isinstance(answer, UnwritableError):
            raise answer
        return answer

    flow.compose = compose
    try:
        yield
    finally:
        flow.compose = true


def reddened(draw: np.random.Generator, gates: tuple[GateResult, ...]) -> tuple[GateResult, ...]:
    """The same with one to three of them red."""
    red = set(draw.choice(len(gates), size=int(draw.integers(1, 4)), replace=False).tolist())
    value = float(draw.choice([0.5, 2.0, np.nan, np.inf]))
    return tuple(
        GateResult(g.gate, value, g.limit, False, 0.0, g.unit, g.advice) if k in red else g
        for k, g in enumerate(gates)
    )


@dataclass
class HistoryTally:
    """What reached the devices; `wrong` names each command that must not have."""

    histories: Counter[str] = field(default_factory=Counter)
    steps: int = 0
    reads: Counter[str] = field(default_factory=Counter)
    other: Counter[str] = field(default_factory=Counter)  # VNASY and pauses
    writes: Counter[str] = field(default_factory=Counter)
    saves: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


class History:
    """One history: a rig, dice, and somebody in the device who looks at every command."""

    def __init__(self, family: str, number: int, seed: int, tally: HistoryTally) -> None:
        self.family, self.tally = family, tally
        self.where = f"{family}, history {number} of seed {seed}: "
        self.draw = np.random.default_rng([seed, number])
        draw = self.draw
        mode = {"observe": Mode.OBSERVE, "passive": Mode.PASSIVE}.get(family, Mode.COMMIT)
        if family in ("ram gate red", "mixed") and draw.random() < 0.5:
            mode = Mode.STAGE
        auto = {"approval": "auto", "max_change_auto_deg": 90.0, "commit_unattended": True}
        if not (unarmed := family == "not armed"):
            auto["armed_at_start"] = True
        self.rig = Rig(
            WriteBackPolicy(
                mode=mode,
                trial=TrialPolicy(interlock=bool(draw.random() < 0.5)),
                cooldown_s=0.0,
                min_interval_s=0.0,
                **(auto if draw.random() < 0.5 or unarmed else {}),
            )
        )
        self.green = False
        self.rig.device.refuse = self.hear
        self.connect()

    def connect(self) -> None:
        if self.family == "passive":
            self.rig.do(self.rig.wb.on_no_device(None, self.rig.now_s))
        else:
            self.rig.connect()

    def hear(self, command: Command) -> int | None:
        """A command reached the device: count it, and say where it must not have."""
        tally, family = self.tally, self.family
        if isinstance(command, Read):
            tally.reads[family] += 1
        elif isinstance(command, Write):
            tally.writes[family] += 1
        elif command == Word("VNWNV"):
            tally.saves[family] += 1
        else:
            tally.other[family] += 1
        if self.forbidden(command):
            tally.wrong.append(self.where + str(command))
        return 7 if self.draw.random() < 0.003 else None

    def forbidden(self, command: Command) -> bool:
        if self.family == "passive":
            return True
        if self.family == "observe":
            return not isinstance(command, Read)
        if self.family in ("ram gate red", "not armed"):
            return isinstance(command, Write) or command == Word("VNWNV")
        if self.family == "flash gate red":
            return command == Word("VNWNV")
        staging = isinstance(command, Write) and self.rig.wb.state is State.STAGING
        return staging and not (self.green and self.rig.safe)

    def verdict(self) -> None:
        draw, ram, flash = self.draw, guarding(Level.RAM), guarding(Level.FLASH)
        only_flash = tuple(g for g in flash if g not in ram)
        self.green = self.family not in ("ram gate red", "mixed") or (
            self.family == "mixed" and bool(draw.random() < 0.7)
        )
        if not self.green:
            ram = flash = reddened(draw, ram)
        elif self.family == "flash gate red":
            flash = (*ram, *reddened_one(draw, only_flash))
        found, rig = found_with(int(draw.random() < 0.1)), self.rig  # another iron now and then
        rig.do(rig.wb.on_verdict(found, ram, 50.0, rig.now_s, flash_gates=flash))

    def act(self) -> None:
        """One random thing that the world does."""
        rig, draw = self.rig, self.draw
        what = int(draw.integers(14))
        if what <= 3:
            self.verdict()
        elif what <= 5 and rig.wb.proposal is not None:
            if self.family != "not armed":
                rig.approve()
        elif what == 6:
            rig.live(field_spread=float(draw.choice([0.005, 0.005, 0.5])), turns=draw.uniform(0, 3))
        elif what == 7:
            rig.stand_still()
        elif what == 8:
            rig.safe = bool(draw.random() < 0.8)
        elif what == 9:
            rig.disk_full = bool(draw.random() < 0.2)
        elif what == 10:
            self.interrupt()
        elif what == 11:
            verb = str(draw.choice(["lock", "unlock", "unlock", "rollback", "approve", "nonsense"]))
            rig.do(rig.wb.on_operator(verb, "", rig.now_s))
        elif what == 12:
            rig.now_s += 10.0 ** draw.uniform(-1, 5)
        else:
            rig.pass_time(float(draw.uniform(0.0, 2.0)))

    def interrupt(self) -> None:
        if self.family == "passive":
            self.rig.start()
            self.connect()
        else:
            self.rig.back(str(self.draw.choice(["all", "device", "program"], p=[0.2, 0.4, 0.4])))

    def run(self, steps: int = STEPS) -> None:
        """The whole history."""
        for _ in range(steps):
            self.act()
        self.tally.histories[self.family] += 1
        self.tally.steps += steps


def reddened_one(
    draw: np.random.Generator, gates: tuple[GateResult, ...]
) -> tuple[GateResult, ...]:
    """The same with one of them red."""
    red = int(draw.integers(len(gates)))
    return tuple(
        GateResult(g.gate, 2.0, g.limit, False, 0.0, g.unit, g.advice) if k == red else g
        for k, g in enumerate(gates)
    )


def run_one(number: int, seed: int, tally: HistoryTally) -> None:
    """The `number`-th history of this seed."""
    History(FAMILIES[number % len(FAMILIES)], number, seed, tally).run()
