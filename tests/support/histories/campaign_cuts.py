"""Power cuts at random points of named steps, with what is lost, and what is seen afterwards.

One run: a write-back goes one of `WAYS`; the power goes at a point of the wanted step (before or
after a command or a record); in a third of the runs it goes again while that is being recovered,
and in half of those a third time. Then everything comes back and two questions are asked:

disagreement:  the journal's state and the registers differ and nothing is alarming
unrecoverable: the lines that the journal keeps, typed in by a person, do not bring the device back
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from writeback_rig import Cut, Device, Rig

from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import Command, Read, Word, Write
from drivers.vn100.registers import Values, parse

STEPS = (
    "PREPARED is journalled", "the device is compared", "register 23 is written",
    "register 84 is written", "what was written is read back", "RAM_VERIFIED is journalled",
    "PROVEN is journalled", "FLASH_SENT is journalled", "the device is compared before the save",
    "VNWNV", "the save is acknowledged", "the old values are put back",
)  # fmt: skip
HOLDS_OLD = {State.OBSERVING, State.CANDIDATE, State.QUALIFIED, State.ROLLED_BACK}
HOLDS_NEW = {State.STAGED, State.TRIAL, State.PROVEN, State.COMMITTED, State.CONFIRMED}
ALARMS = (State.FAULT, State.FLASH_TORN, State.LOCKED)


def step_of(rig: CampaignRig) -> str | None:
    """The named step in which the rig is now."""
    state, saying = rig.wb.state, rig.saying
    if state is State.STAGING:
        if isinstance(saying, Write):
            return f"register {saying.register} is written"
        return "what was written is read back" if isinstance(saying, Read) else None
    if state is State.SAVING:
        return "VNWNV" if saying == Word("VNWNV") else "the device is compared before the save"
    return {
        State.PREPARING: "PREPARED is journalled",
        State.CHECKING: "the device is compared",
        State.STAGED: "RAM_VERIFIED is journalled",
        State.PROVEN: "PROVEN is journalled",
        State.SAVE_PREPARING: "FLASH_SENT is journalled",
        State.COMMITTED: "the save is acknowledged",
        State.ROLLING_BACK: "the old values are put back",
    }.get(state)


class CampaignRig(Rig):
    """A rig that knows where it is, and whose VNWNV can be torn by a cut."""

    def start(self) -> None:
        super().start()
        self.saying: Command | None = None
        self.seen: list[str | None] = []
        self.tear: Callable[[Device], None] | None = None
        self.device.refuse = self._hear

    def _hear(self, command: Command) -> int | None:
        """Remember what is being said; inside VNWNV the power may go as well."""
        self.saying = command
        if command == Word("VNWNV"):
            self.points += 1
            self.seen.append("VNWNV")
            if self.points == self.cut_at:
                if self.tear is not None:
                    self.tear(self.device)
                raise Cut
        return None

    def _point(self) -> None:
        self.seen.append(step_of(self))
        super()._point()


def bad_way(rig: Rig) -> None:
    """A calibration that the trial throws out."""
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.live(field_spread=0.5)


def regretted_way(rig: Rig) -> None:
    """Proven, and then a person wants the old values back."""
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict(flash_gates=rig.RED)
    rig.approve()
    rig.live()
    rig.do(rig.wb.on_operator("rollback", "", rig.now_s))


def stopped_way(rig: Rig) -> None:
    """The daemon is told to stop in the trial."""
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()
    rig.do(rig.wb.on_stop(rig.now_s))


def refused_way(rig: Rig) -> None:
    """The device refuses register 84 once register 23 is written."""
    hear, old = rig.device.refuse, rig.device.held()[84]

    def refuse(command: Command) -> int | None:
        hear(command)
        new = isinstance(command, Write) and command.register == 84 and command.values != old
        return 5 if new else None

    rig.device.refuse = refuse
    rig.connect()
    rig.pass_time(0.1)
    rig.verdict()
    rig.approve()


WAYS: dict[str, Callable[[Rig], None]] = {
    "whole": lambda rig: rig.whole_way(),
    "bad": bad_way,
    "regretted": regretted_way,
    "stopped": stopped_way,
    "refused": refused_way,
}


def make() -> CampaignRig:
    """A rig in mode commit with a device in factory state."""
    return CampaignRig(WriteBackPolicy(mode=Mode.COMMIT, trial=TrialPolicy(duration_s=600.0)))


@cache
def places() -> dict[str, list[tuple[str, int]]]:
    """Of each step the ways and points that are in it, from ways without a cut."""
    found: dict[str, list[tuple[str, int]]] = {step: [] for step in STEPS}
    for way, act in WAYS.items():
        rig = make()
        act(rig)
        for number, step in enumerate(rig.seen, 1):
            if step is not None:
                found[step].append((way, number))
    return found


def typed_in(lines: list[str]) -> dict[int, Values]:
    """What the journal's lines, typed in by a person, leave in the registers."""
    held: dict[int, Values] = {}
    for line in lines:
        _, number, *tokens = line.strip().removeprefix("$").split("*")[0].split(",")
        held[int(number)] = parse(int(number), tokens)
    return held


def same(one: dict[int, Values], two: dict[int, Values]) -> bool:
    """Equal up to the digits that the device prints."""
    return all(np.allclose(one[n], two[n], rtol=0, atol=1e-6) for n in (23, 84))


def disagreement(rig: Rig, old: dict[int, Values], new: dict[int, Values]) -> str:
    """How state and device differ without an alarm; empty where they do not."""
    device, state = rig.device.held(), rig.wb.state
    if state in HOLDS_OLD:
        left = rig.wb.history.holds or old  # what the last transaction left, by the journal
        return "" if same(device, left) else f"{state.value} and the device has other values"
    if state in HOLDS_NEW:
        return "" if same(device, new) else f"{state.value} and the device has other values"
    if state in ALARMS:
        return "" if rig.notes("error") else f"{state.value} without a word"
    return f"it stays in {state.value}"


def unrecoverable(rig: Rig, old: dict[int, Values]) -> str:
    """Why the old values could not be put back by hand; empty where they could or are there."""
    if same(rig.device.held(), old):
        return ""
    prepared = [r for r in rig.journal if r.kind == "PREPARED"]
    if not prepared:
        return "the device differs and the journal knows of nothing"
    back = typed_in(prepared[0].facts["lines_old"])
    return "" if set(back) == {23, 84} and same(back, old) else "the journal's lines are others"


def tears(draw: np.random.Generator, rig: Rig) -> Callable[[Device], None] | None:
    """What a cut inside VNWNV leaves in flash: nothing new, all of it, a part, or rubbish."""

    def one(device: Device) -> None:
        number = int(draw.choice([23, 84]))
        device.flash[number] = device.ram[number]

    def everything(device: Device) -> None:
        device.flash = dict(device.ram)

    def rubbish(device: Device) -> None:
        device.flash[23] = tuple(draw.normal(size=12).tolist())

    return [None, one, everything, rubbish][int(draw.integers(4))]


@dataclass
class CutTally:
    """What was seen; counters add up."""

    cuts: Counter[str] = field(default_factory=Counter)  # by step, first cuts
    again: int = 0  # further cuts, in recoveries
    ends: Counter[str] = field(default_factory=Counter)  # states in which it ended
    disagreements: list[str] = field(default_factory=list)
    unrecoverable: list[str] = field(default_factory=list)
    flash_after: int = 0  # runs in which something after the cut wrote flash


def run_one(step: str, number: int, seed: int, tally: CutTally) -> None:
    """One run of `step`, the `number`-th of this seed."""
    draw = np.random.default_rng([seed, STEPS.index(step), number])
    way, at = places()[step][int(draw.integers(len(places()[step])))]
    rig = make()
    old, new = rig.device.held(), _new_values()
    rig.tear = tears(draw, rig)
    if not rig.cut(at, lambda: WAYS[way](rig)):
        raise AssertionError(f"{way} has no point {at}")
    tally.cuts[step] += 1
    saved = rig.device.flash_writes
    for _ in range(int(draw.integers(1, 3)) if draw.random() < 1 / 3 else 0):
        lost = str(draw.choice(["all", "device", "program"]))
        if not rig.cut(int(draw.integers(1, 12)), lambda lost=lost: rig.back(lost)):
            break
        tally.again += 1
    rig.back(str(draw.choice(["all", "device", "program"])))
    tally.ends[rig.wb.state.value] += 1
    where = f"{step}, run {number} of seed {seed}, way {way}, point {at}: "
    if text := disagreement(rig, old, new):
        tally.disagreements.append(where + text)
    if text := unrecoverable(rig, old):
        tally.unrecoverable.append(where + text)
    tally.flash_after += rig.device.flash_writes > saved


@cache
def _new_values() -> dict[int, Values]:
    rig = make()
    rig.whole_way()
    return rig.device.held()
