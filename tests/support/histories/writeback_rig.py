"""A write-back with everything around it: a device with RAM and flash, a journal, a vehicle.

Small on purpose: the procedures are carried out command by command without bytes, so that a cut can
be placed at every one of them. The session and the emulator have tests of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from ahrsd.calibration import Estimate, Observability
from ahrsd.events import GateResult, Noted, StateChanged
from ahrsd.samples import SampleBlock
from ahrsd.writeback.actions import (
    Action,
    AppendToJournal,
    Emit,
    IdentifyAgain,
    InForce,
    Look,
    RunProcedure,
    SetUpStream,
)
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import State
from ahrsd.writeback.trial import TrialMetrics
from drivers.vn100.commands import (
    CONFIGURATION,
    Command,
    Identity,
    NoReply,
    NotPermitted,
    Pause,
    Read,
    Seen,
    Word,
    Write,
)
from drivers.vn100.errors import DeviceRefused, DriverError
from drivers.vn100.messages import Reply
from drivers.vn100.registers import (
    REGISTERS,
    Unit,
    Values,
    as_stored,
    format_reply,
    parse,
    profile_of,
)

MODEL, FIRMWARE, SERIAL = "VN-100T-CR", "3.1.0.0", 100130608
PROFILE = profile_of(FIRMWARE)
GREEN = (GateResult("observability", 3.0, 1.0, True, 0.0, "", ""),)
RED = (GateResult("observability", 0.3, 1.0, False, 0.0, "", "turn more"),)


class Cut(Exception):
    """The power went."""


@lru_cache(maxsize=4096)
def printed(number: int, values: Values) -> Values:
    return parse(number, format_reply(number, values).split(",")[1:])


@lru_cache(maxsize=4096)
def stored(number: int, values: Values) -> Values:
    return as_stored(number, values)


@dataclass
class Device:
    """A VN-100's registers. `log` has every command that reached it; `refuse` answers VNERR."""

    serial: int = SERIAL
    flash: dict[int, Values] = field(default_factory=dict)
    log: list[Command] = field(default_factory=list)
    refuse: Callable[[Command], int | None] = lambda _: None
    mute: Callable[[Command], bool] = lambda _: False
    asynchronous: bool = True
    flash_writes: int = 0

    def __post_init__(self) -> None:
        defaults = {n: REGISTERS[n].defaults[3] for n in CONFIGURATION if PROFILE.has(n)}
        self.flash = {**defaults, **self.flash}
        self.ram = dict(self.flash)

    def restart(self) -> None:
        self.ram = dict(self.flash)
        self.asynchronous = True

    def answer(self, command: Command) -> Reply:
        self.log.append(command)
        if (code := self.refuse(command)) is not None:
            raise DeviceRefused(code)
        if isinstance(command, Write):
            self.ram[command.register] = stored(command.register, command.values)
        if isinstance(command, Word) and command.word == "VNASY":
            self.asynchronous = command.arguments == (1,)
        if isinstance(command, Word) and command.word == "VNWNV":
            self.flash, self.flash_writes = dict(self.ram), self.flash_writes + 1
        if self.mute(command):
            raise NoReply(command)
        if isinstance(command, Read | Write):
            word = "VNRRG" if isinstance(command, Read) else "VNWRG"
            who = {1: (MODEL,), 3: (self.serial,), 4: (FIRMWARE,)}
            values = who.get(command.register) or self.ram[command.register]
            text = format_reply(command.register, values)
            return Reply(word, command.register, tuple(text.split(",")[1:]))
        return Reply("", None, ())

    def held(self, where: str = "ram") -> dict[int, Values]:
        memory: dict[int, Values] = getattr(self, where)
        return {n: printed(n, memory[n]) for n in (23, 84)}


@dataclass(frozen=True)
class Record:
    kind: str
    facts: Mapping[str, Any]


def estimate(**changes: Any) -> Estimate:
    """A clear case: 12 deg of heading and a gyro bias."""
    values: dict[str, Any] = {
        "soft_iron": np.diag([1.1, 1.0, 1.0 / 1.1]),
        "hard_iron_gauss": np.array([0.03, 0.04, -0.02]),
        "gyro_bias_rad_s": np.array([0.01, -0.02, 0.005]),
        "field_gauss": 0.48,
        "field_known": False,
        "covariance": np.eye(12) * 1e-6,
        "noise_mag_gauss": 1e-3,
        "noise_gyro_rad_s": 1e-3,
        "misfit": 1.0,
        "heading_sigma_deg": 0.1,
        "observability": Observability(np.full(12, 0.01), (), 10.0),
        "samples": 10_000,
        "duration_s": 300.0,
        "converged": True,
    }
    return Estimate(**{**values, **changes})


def metrics(**changes: Any) -> TrialMetrics:
    values: dict[str, Any] = {
        "duration_s": 700.0,
        "turns": 1.0,
        "new_figure": 0.5,
        "old_figure": 10.0,
        "field_spread": 0.005,
        "wrong_sigmas": -10.0,
    }
    return TrialMetrics(**{**values, **changes})


class Rig:
    """The core's part, in a few lines: actions carried out in order, time moving on by itself."""

    GREEN, RED = GREEN, RED

    def __init__(self, policy: WriteBackPolicy, device: Device | None = None) -> None:
        self.policy = policy
        self.device = device or Device()
        self.journal: list[Record] = []
        self.disk_full = False
        self.safe = True
        self.now_s, self.wall_s = 1000.0, 1.8e9
        self.boots, self.boot_began_s = 1, 0.0  # of the computer
        self.tells_time, self.started_s = True, 0.0  # the device: in its stream; its start-up
        self.cut_at: int | None = None
        self.points = 0
        self.events: list[Any] = []
        self.in_force: list[Mapping[int, Values] | None] = []
        self.asked: list[Action] = []
        self.ended: list[str] = []
        self.start()

    def start(self) -> None:
        """A new process: nothing is remembered but the journal."""
        self.wb = WriteBack(self.policy)
        self.tell_clocks()

    def tell_clocks(self) -> None:
        """The computer's other clocks, as they are now."""
        boot_s = self.now_s - self.boot_began_s
        wall_s = self.wall_s + self.now_s
        self.do(self.wb.on_clock(wall_s, f"boot {self.boots}", boot_s, self.now_s))

    # -- what the core does ------------------------------------------------------------------------

    def connect(self, **changes: Any) -> None:
        registers = {n: printed(n, v) for n, v in self.device.ram.items()}
        identity = Identity(MODEL, 7, self.device.serial, FIRMWARE, PROFILE)
        arguments: dict[str, Any] = {
            "identity": identity,
            "registers": registers,
            "journal": list(self.journal),
            "host_s": self.now_s,
            **changes,
        }
        self.do(self.wb.on_device(**arguments))

    def do(self, actions: Sequence[Action]) -> None:
        queue = list(actions)
        while queue:
            action = queue.pop(0)
            if isinstance(action, AppendToJournal):
                queue = self._append(action) + queue
            elif isinstance(action, RunProcedure):
                queue += self._carry_out(action)
            elif isinstance(action, Look):
                queue += self._look(action)
            elif isinstance(action, Emit):
                self.events.append(action.event)
            elif isinstance(action, InForce):
                self.in_force.append(action.registers)
            else:
                self.asked.append(action)

    def _append(self, action: AppendToJournal) -> list[Action]:
        self._point()
        if self.disk_full:
            return self.wb.on_journal_failed(action.kind, "no space left", self.now_s)
        self.journal.append(Record(action.kind.value, dict(action.facts)))
        self._point()
        return self.wb.on_journal_ok(action.kind, self.now_s)

    def _carry_out(self, action: RunProcedure) -> list[Action]:
        procedure, outcome = action.make(), None
        try:
            while True:
                command = (
                    procedure.throw(outcome)
                    if isinstance(outcome, Exception)
                    else procedure.send(outcome)
                )
                outcome = self._say(action, command)
        except StopIteration as end:
            self.ended.append(f"{action.name}: {end.value}")
            return self.wb.on_procedure_finished(action.name, end.value, self.now_s)
        except DriverError as error:
            self.ended.append(f"{action.name}: {error}")
            return self.wb.on_procedure_failed(action.name, error, self.now_s)

    def _say(self, action: RunProcedure, command: Command) -> Reply | Exception:
        self.pass_time(0.01)
        if not action.gate(command):
            return NotPermitted(command)
        if isinstance(command, Pause):
            self.pass_time(command.seconds)
            return Reply("", None, ())
        self._point()
        try:
            reply = self.device.answer(command)
        except DriverError as error:
            return error
        self._point()
        return reply

    def _look(self, action: Look) -> list[Action]:
        """Who answers and what it holds, without a word in the log."""
        unit = Unit(MODEL, self.device.serial, FIRMWARE)
        held = {n: printed(n, self.device.ram[n]) for n in action.expected}
        return self.wb.on_looked(Seen(unit, held), "", self.now_s)

    def _point(self) -> None:
        """A place where the power may go."""
        self.points += 1
        if self.points == self.cut_at:
            raise Cut

    def pass_time(self, seconds: float) -> None:
        self.now_s += seconds
        self.do(self.wb.on_interlock(self.safe, self.now_s))
        self.do(self.wb.tick(self.now_s))
        self.hear_time()

    def hear_time(self) -> None:
        """The device's own time, where its stream has it."""
        if self.tells_time and self.device.asynchronous:
            self.do(self.wb.on_uptime(self.now_s - self.started_s, self.now_s))

    # -- what the world does -----------------------------------------------------------------------

    def verdict(self, gates: tuple[GateResult, ...] = GREEN, **changes: Any) -> None:
        flash = changes.pop("flash_gates", GREEN)
        self.do(self.wb.on_verdict(estimate(**changes), gates, 50.0, self.now_s, flash_gates=flash))

    def approve(self) -> None:
        assert self.wb.proposal is not None
        self.do(self.wb.on_operator("approve", self.wb.proposal.id, self.now_s))

    def live(self, **changes: Any) -> None:
        self.do(self.wb.on_trial_metrics(metrics(**changes), self.now_s))

    def stand_still(self, rate_rad_s: float = 0.0, seconds: float = 4.0) -> None:
        count = int(seconds / 0.1)
        time_s = self.now_s + 0.1 * (1 + np.arange(count))
        self.now_s = float(time_s[-1])
        gyro = np.tile(estimate().gyro_bias_rad_s + np.array([rate_rad_s, 0.0, 0.0]), (count, 1))
        accel = np.tile([0.0, 0.0, -9.8], (count, 1))
        dt_s = np.full(count, 0.1)
        block = SampleBlock(time_s, dt_s, time_s, np.zeros((count, 3)), gyro, accel)
        self.do(self.wb.on_interlock(self.safe, self.now_s))
        self.hear_time()
        self.do(self.wb.on_samples(block))

    def whole_way(self) -> None:
        """From the first verdict to the flash, every step that the policy allows."""
        self.connect()
        self.pass_time(0.1)
        self.verdict()
        if self.wb.state is State.QUALIFIED:
            self.approve()
        if self.wb.state is State.TRIAL:
            self.live()
        self.stand_still()

    def cut(self, at: int, act: Callable[[], None]) -> bool:
        """Whether the power went in `act`, at this point counted from now."""
        self.points, self.cut_at = 0, at
        try:
            act()
        except Cut:
            return True
        finally:
            self.cut_at = None
        return False

    def back(self, lost: str) -> None:
        """After a loss of "all" (device and computer), the "device", or the "program"."""
        self.now_s += 60.0
        if lost != "program":
            self.device.restart()
            self.started_s = self.now_s - 5.0
        if lost == "device":
            self.do(self.wb.on_link_lost(self.now_s))
            self.do(self.wb.on_reset(self.now_s))
        if lost == "all":
            self.boots, self.boot_began_s = self.boots + 1, self.now_s - 5.0
        if lost != "device":
            self.start()
        self.connect()
        asked = self.asked_again
        for _ in range(3 if self.tells_time else 0):  # a second of messages
            self.pass_time(0.6)
        if self.asked_again > asked:
            self.connect()

    # -- what a test asks --------------------------------------------------------------------------

    @property
    def kinds(self) -> list[str]:
        return [record.kind for record in self.journal]

    @property
    def states(self) -> list[str]:
        return [event.new for event in self.events if isinstance(event, StateChanged)]

    def notes(self, level: str) -> list[str]:
        return [e.text for e in self.events if isinstance(e, Noted) and e.level == level]

    @property
    def sent(self) -> list[str]:
        """What changed something: writes and words, without the pause of the output."""
        return [
            f"{c.register}" if isinstance(c, Write) else c.word
            for c in self.device.log
            if isinstance(c, Write) or (isinstance(c, Word) and c.word != "VNASY")
        ]

    @property
    def stream_set_up(self) -> int:
        return sum(isinstance(a, SetUpStream) for a in self.asked)

    @property
    def asked_again(self) -> int:
        return sum(isinstance(a, IdentifyAgain) for a in self.asked)
