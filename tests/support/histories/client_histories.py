"""Random histories of two clients, a daemon that writes, and a device; judged from outside.

Clients read, set, save, reset, try what is not theirs, send garbage, go away and come back, at
random moments of a write-back that is approved again and again. What must not be, counted:

wrong answers  an answer to something that this client did not ask, or an error it cannot have
calibration    registers 23 or 84 in RAM with values that are neither the user's nor the candidate's
               (nor, with `passes`, what the owner was let write)
overwritten    a value of the owner's replaced by anything but a transaction that has it as its old
               value, the owner itself, or a restart
flash          the candidate in flash although the daemon did not save it, or anything foreign
hangs          at the end a client is not answered, or the device does not stream
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from cabled_run import FIRST, CabledRun, estimate, two_units
from cabled_units import printed
from planted_calibrator import PlantedCalibrator

from ahrsd import inputs
from ahrsd.sharing.arbiter import SharePolicy

SHARES = (SharePolicy("owner", owner=True), SharePolicy("log"))
ONE = "1,0,0,0,1,0,0,0,1,0,0,0"
NEW = {23: "1,0,0,0,1,0,0,0,1,0.05,-0.03,0.04", 84: "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005"}
THEIRS = "2,0,0,0,1,0,0,0,1,0.1,0.1,0.1"
READS = [f"VNRRG,{n:02d}" for n in (1, 2, 3, 4, 5, 6, 7, 23, 30, 44, 75, 84, 85)]
SETS = ["VNWRG,06,0", "VNWRG,06,19", "VNWRG,07,20", "VNWRG,07,40", "VNWRG,05,921600"]
SETS += ["VNWRG,85,0,8,8,8,8,0,3,3,3,0", "VNASY,0", "VNASY,1"]
PASSED = "1,0,0,0,1,0,0,0,1,0.1,0.1,0.1"  # what an owner writes that may
NOT_THEIRS = [f"VNWRG,{n},{THEIRS}" for n in (23, 25, 84)] + ["VNRFS", "VNTAR", "VNSGB", "VNXYZ"]
PASSING = [f"VNWRG,{n},{PASSED}" for n in (23, 84)] + ["VNRFS", "VNTAR", "VNSGB"]
GARBAGE = ["$", "\x00\xff", "$VNRRG,01*00\r\n", "$VNRRG,", "x" * 300, "\r\n", "$VNWRG,23,1"]


def _printed(values: list[float]) -> str:
    return printed(",".join(repr(float(v)) for v in values))


class ClientHistory:
    """One history. `wrong`: what was seen that must not be; `asked`: commands of clients."""

    def __init__(self, seed: int, *, passes: bool = False) -> None:
        self._rng = np.random.default_rng(seed)
        cable = two_units(binary=bool(seed % 2))
        shares = (replace(SHARES[0], calibration="pass"), SHARES[1]) if passes else SHARES
        self.run = CabledRun(cable, shares=shares, min_interval_s=0.0, cooldown_s=0.0)
        self._passes, self._watched = passes, 0
        self._ram = dict.fromkeys(NEW, ONE)
        self.let_through = 0  # writes of what calibrates that the device was sent for the owner
        self.wrong: Counter[str] = Counter()
        self.asked = 0
        self._open: dict[str, list[str]] = {"owner": [], "log": []}
        self._committed = False

    def play(self, steps: int = 1500) -> None:
        """Virtual time; a step is 50 ms."""
        rng, run = self._rng, self.run
        for step in range(steps):
            if rng.random() < 0.25:
                self._client(["owner", "log"][rng.integers(0, 2)])
            if step % 200 == 100 and run.core.writeback.proposal is not None:
                proposal = run.core.writeback.proposal.id
                run.feed(inputs.Operator(run.now_ns, "approve", proposal))
            if rng.random() < 0.005:
                run.safe = not run.safe
            if rng.random() < 0.005:
                run.cable.moving = not run.cable.moving
            run.step()
            if not isinstance(run.core.calibrator, PlantedCalibrator):  # begun anew: it still knows
                run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
            self._judge()
        self._end()

    def _client(self, name: str) -> None:
        rng = self._rng
        kind = rng.choice(
            ["read", "set", "save", "reset", "theirs", "garbage", "leave"],
            p=[0.55, 0.2, 0.04, 0.01, 0.1, 0.07, 0.03],
        )
        theirs = PASSING if self._passes and name == "owner" else NOT_THEIRS
        pool = {"read": READS, "set": SETS, "theirs": theirs}
        pool |= {"save": ["VNWNV"], "reset": ["VNRST"]}
        if kind == "garbage":
            text = GARBAGE[rng.integers(0, len(GARBAGE))]
            self.run.feed(inputs.ClientSent(self.run.now_ns, name, text))
            self._open[name].append("VNERR")
        elif kind == "leave":
            self._answers(name)
            self.run.feed(inputs.ClientLeft(self.run.now_ns, name))
            self._open[name].clear()
        else:
            self.asked += 1
            line = pool[str(kind)][rng.integers(0, len(pool[str(kind)]))]
            self._open[name].append(line)
            self.run.say(name, line)

    def _judge(self) -> None:
        run = self.run
        self._committed |= "COMMITTED" in run.states
        self._judge_writes()
        for name in self._open:
            self._answers(name)
        for number, allowed in ((23, NEW[23]), (84, NEW[84])):
            ram, flash = (printed(run.cable.unit.__dict__[m][number]) for m in ("ram", "flash"))
            theirs = (PASSED,) if self._passes else ()
            if ram not in (ONE, allowed, *theirs):
                self.wrong["calibration"] += 1
            saved = self._committed or run.state == "SAVING"
            if flash not in ((ONE, allowed, *theirs) if saved else (ONE, *theirs)):
                self.wrong["flash"] += 1

    def _judge_writes(self) -> None:
        """Who wrote register 23 or 84, by the journal: a client's record or a transaction."""
        unit, journal = self.run.cable.unit, self.run.journal.get(FIRST, [])
        fresh, self._watched = unit.writes[self._watched :], len(unit.writes)
        for number, text in [(n, text) for n, text in fresh if n in NEW]:
            before, self._ram[number] = self._ram[number], text
            if text == PASSED and journal[-1]["kind"] == "CLIENT_WRITES":
                self.let_through += 1
                continue
            prepared = [r["facts"] for r in journal if r["kind"] == "PREPARED"]
            old = _printed(prepared[-1]["old"][str(number)]) if prepared else ""
            if PASSED in (before, text) and old != PASSED:
                self.wrong["overwritten"] += 1
        self._ram = {n: printed(unit.ram[n]) for n in NEW}

    def _answers(self, name: str) -> None:
        for answer in self.run.answers(name):
            word, *rest = answer.split(",")
            fits = [
                line
                for line in self._open[name]
                if word == "VNERR"
                or (line.split(",")[0] == word and line.split(",")[1:2] == rest[:1])
            ]
            if not fits:
                self.wrong["wrong answers"] += 1

    def _end(self) -> None:
        run = self.run
        run.safe = False  # no write or save begins any more
        run.run(8.0)
        for name in self._open:
            run.feed(inputs.ClientLeft(run.now_ns, name))
            run.answers(name)
            run.say(name, "VNRRG,01", "VNRRG,30")
        run.run(3.0)
        for name in self._open:
            answers = [answer[:8] for answer in run.answers(name)]
            if answers != ["VNRRG,01", "VNRRG,30"]:
                self.wrong["hangs"] += 1
        if not run.until(lambda: not run.cable.unit.paused, 30.0):  # a save may be under way
            self.wrong["hangs"] += 1
