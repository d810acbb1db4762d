"""Random fault schedules against the emulated device and the whole core, in virtual time.

One schedule: `PER_SCHEDULE` faults of random kinds within half a minute, a candidate that qualifies
again and again (so that registers are written, tried, saved and undone all the while), and now and
then a full disk, a vehicle that says no, a killed program. Then the faults are over and a calm
follows, in which samples must flow, the state must not wait, and a stop must end.

hang:      no sample within `FLOW_S` after the last fault, or no end within `STOP_S` after a stop,
           in virtual time; or a step of the world that takes more processor time than `STEP_CPU_S`
           (nothing in it waits; on a machine that others use, real time is theirs)
differs:   the state says what the registers hold and they hold something else, without an alarm
outputs:   after the stop the device has other outputs than the user's (registers 5 to 7 and 75 to
           77, both ports), or its flash has; the program was killed in some of the schedules; where
           the program said that it could not put them back, after the next run
           (differs and outputs are not counted where a third party wrote, the unit was exchanged,
           or replies were altered; the flash not where it was torn)
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from planted_calibrator import PlantedCalibrator
from virtual_run import VirtualRun
from writeback_rig import estimate

from ahrsd.calibration import Estimate
from ahrsd.config.config import Config, core_settings
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.emulator.faults import FAULTS
from drivers.vn100.emulator.physics import draw_truth
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.registers import Values

PER_SCHEDULE = 40
BEGIN_S, FAULTS_S, CALM_S = 3.0, 30.0, 12.0
FLOW_S, STOP_S, STEP_CPU_S = 10.0, 5.0, 5.0
POLICY = WriteBackPolicy(
    mode=Mode.COMMIT, configure_stream=True, approval="auto",
    armed_at_start=True, commit_unattended=True,
    max_change_auto_deg=180.0, min_interval_s=0.0, cooldown_s=0.0, ram_writes_per_day=10**6,
    flash_writes_per_day=10**6, flash_writes_lifetime=10**6, rollbacks_to_lock=10**6,
    trial=TrialPolicy(duration_s=3.0, max_spread_percent=100.0, worse_percent=1e6),
)  # fmt: skip
OTHERS = ("third_party", "replug_other", "altered_reply")  # in a quarter of the schedules
Registers = dict[tuple[int, int], Values]
ALARMS = ("FAULT", "LOCKED", "FLASH_TORN")
OUTPUTS = (5, 6, 7, 75, 76, 77)
AGREE = {"TRIAL": "new", "PROVEN": "new", "COMMITTED": "new", "CONFIRMED": "new"}


@dataclass
class FaultTally:
    """What was seen; counters add up."""

    schedules: int = 0
    cycles: Counter[str] = field(default_factory=Counter)  # by fault
    device_s: float = 0.0
    states: Counter[str] = field(default_factory=Counter)  # entered, all schedules
    ends: Counter[str] = field(default_factory=Counter)
    writes: int = 0
    saves: int = 0
    samples: int = 0
    restarts_of_program: int = 0
    exceptions: list[str] = field(default_factory=list)
    hangs: list[str] = field(default_factory=list)
    differs: list[str] = field(default_factory=list)
    outputs_changed: list[str] = field(default_factory=list)
    outputs_compared: int = 0
    left_to_the_next_run: int = 0  # stops in which the device was away
    leaked_threads: int = 0
    leaked_files: int = 0


def schedule(draw: np.random.Generator) -> tuple[str, ...]:
    """Random faults with random parameters at random times; all are over at the end."""
    lines = []
    alone = draw.random() < 0.75
    names = [name for name in FAULTS if not (alone and name.startswith(OTHERS))]
    for name in draw.choice(names, size=PER_SCHEDULE):
        start_s = BEGIN_S + draw.uniform(0.0, FAULTS_S - 2.0)
        kind = FAULTS[str(name)]
        value = kind.parameter
        if name == "refused_write":
            value = float(draw.integers(1, 13))
        elif name.startswith("third_party"):
            value = float(draw.choice([23, 25, 84, 44]))
        elif kind.unit in ("per byte", "per message"):
            value = min(kind.parameter * float(draw.choice([0.3, 1.0, 5.0])), 1.0)
        lines.append(f"{name}={min(value, 1e3)}@{start_s:.3f}+{draw.uniform(0.05, 0.8):.3f}")
    return tuple(lines)


class Schedule:
    """One run of a schedule."""

    def __init__(self, number: int, seed: int, tally: FaultTally) -> None:
        self.draw = np.random.default_rng([seed, number])
        self.tally, self.where = tally, f"schedule {number} of seed {seed}: "
        self.faults = schedule(self.draw)
        self.longest_s = 0.0
        device_seed = int(self.draw.integers(1000))
        truth = draw_truth(device_seed)
        self.planted: Estimate = estimate(
            soft_iron=truth.soft_iron,
            hard_iron_gauss=truth.hard_iron_gauss,
            gyro_bias_rad_s=truth.gyro_bias_rad_s,
        )
        motion = (("static", 12.0), ("tumble", 6.0), ("static", 1000.0))
        output = str(self.draw.choice(["ascii", "imu", "binary"]))
        setup = Setup(
            "rov", device_seed, self.faults, output=output, rate_hz=20, motion=motion,
            firmware=str(self.draw.choice(["3", "3.0.0.0"])),
        )  # fmt: skip
        settings = core_settings(Config(), policy=POLICY)
        self.run_ = VirtualRun(build(setup), settings, step_s=0.05)
        self.users = outputs_of(self.run_.emulator.memory.ram)

    def step(self) -> None:
        """One step of the world, and what a program under test may not do in it."""
        run = self.run_
        if not isinstance(run.core.calibrator, PlantedCalibrator):
            run.core.calibrator = PlantedCalibrator(run.core.calibrator, self.planted)
        begun = time.process_time()
        run.step()
        self.longest_s = max(self.longest_s, time.process_time() - begun)

    def until(self, end_s: float) -> None:
        while self.run_.now_s < end_s:
            self.step()

    def go(self) -> None:
        """The faults, the calm, the stop."""
        run, draw = self.run_, self.draw
        while run.now_s < BEGIN_S + FAULTS_S:
            self.step()
            dice = draw.random()
            if dice < 0.01:
                run.disk_full = not run.disk_full
            elif dice < 0.02:
                run.safe = not run.safe
            elif dice < 0.023:
                run.restart()
                self.tally.restarts_of_program += 1
            elif dice < 0.1 and run.core.writeback.state.value in ALARMS:
                run.operate("unlock", "campaign")
            elif dice < 0.03:
                verb = str(draw.choice(["rollback", "lock"]))
                run.operate(verb, "campaign")
        run.disk_full, run.safe = False, True
        self.calm()

    def calm(self) -> None:
        run = self.run_
        samples = run.samples
        end_s = run.now_s + FLOW_S
        while run.samples == samples and run.now_s < end_s:
            self.step()
        if run.samples == samples:
            self.tally.hangs.append(f"{self.where}no sample in the calm, {run.describe()}")
        self.until(run.now_s + CALM_S)
        self.compare()
        self.tally.ends[run.core.writeback.state.value] += 1
        self.stop()
        if any("not everything was put back" in text for _, text in run.notes):
            self.tally.left_to_the_next_run += 1
            run.restart()
            self.until(run.now_s + CALM_S)
            self.stop()
        self.compare_outputs()

    def stop(self) -> None:
        """A stop, which must end."""
        run = self.run_
        run.finished = False
        run.stop()
        end_s = run.now_s + STOP_S
        while not run.finished and run.now_s < end_s:
            self.step()
        if not run.finished:
            self.tally.hangs.append(f"{self.where}no end after a stop, {run.describe()}")

    @property
    def others(self) -> bool:
        """Whether somebody else meddled."""
        return any(fault.startswith(OTHERS) for fault in self.faults)

    def compare_outputs(self) -> None:
        """Are the outputs the user's, after everything?"""
        if self.others:
            return
        self.tally.outputs_compared += 1
        memory = self.run_.emulator.memory
        places = {"RAM": memory.ram, "flash": memory.flash}
        if any(fault.startswith("torn_flash") for fault in self.faults):
            del places["flash"]
        for place, values in places.items():
            held = outputs_of(values)
            if other := {key: row for key, row in held.items() if row != self.users[key]}:
                where = f"{self.where}{place} {other}, {self.run_.describe()}"
                self.tally.outputs_changed.append(where)

    def compare(self) -> None:
        """State and registers, where nobody else meddled."""
        run = self.run_
        if self.others:
            return
        state, history = run.core.writeback.state.value, run.core.writeback.history
        wanted = history.open.new if AGREE.get(state) and history.open else history.holds
        held = {n: run.emulator.memory.get(n) for n in wanted or {}}
        if state in (*AGREE, "OBSERVING", "CANDIDATE", "QUALIFIED", "ROLLED_BACK") and any(
            not np.allclose(held[n], values, atol=1e-5) for n, values in (wanted or {}).items()
        ):
            self.tally.differs.append(f"{self.where}{run.describe()}")


def outputs_of(memory: Registers) -> Registers:
    """The registers that say what the device sends, of both ports."""
    return {key: values for key, values in memory.items() if key[0] in OUTPUTS}


def run_one(number: int, seed: int, tally: FaultTally) -> None:
    """One schedule; exceptions are caught here, named and counted."""
    threads, files = threading.active_count(), sum(1 for _ in Path("/proc/self/fd").iterdir())
    one = Schedule(number, seed, tally)
    try:
        one.go()
    except Exception as error:  # noqa: BLE001 - any at all is a finding
        tally.exceptions.append(f"{one.where}{type(error).__name__}: {error}")
    run = one.run_
    if one.longest_s > STEP_CPU_S:
        tally.hangs.append(f"{one.where}a step took {one.longest_s:.1f} s")
    tally.schedules += 1
    tally.cycles.update(fault.split("=")[0] for fault in one.faults)
    tally.device_s += run.now_s
    tally.states.update(run.states)
    tally.writes += run.writes
    tally.saves += run.saves
    tally.samples += run.samples
    tally.leaked_threads += threading.active_count() - threads
    tally.leaked_files += sum(1 for _ in Path("/proc/self/fd").iterdir()) - files
