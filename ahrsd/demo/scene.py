"""The two people of the demo, and its narrator.

The operator approves the candidate by its id; somebody takes the device's power away and gives it
back once the registers are saved. Neither knows the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.calibration_json import UNKNOWN_HEADING_DEG
from ahrsd.events import (
    Estimated,
    Event,
    GateResult,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)
from ahrsd.gates import Level, for_level, guards_a_write
from ahrsd.heading import tilt_compensated_heading
from ahrsd.report import EventCollector
from ahrsd.report.contents import RunTime
from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.composition import Proposal
from ahrsd.writeback.states import State

_SAY_EVERY_S = 60.0
_LONGEST_S = 300.0  # device time after the save in which every heading should be driven
_AFTER_S = 2.0  # device time after the restart
_SECTOR_DEG = 10.0
_ENOUGH = 35 / 36  # of all headings
_HOPELESS = frozenset({State.ROLLED_BACK, State.FAULT, State.LOCKED, State.FLASH_TORN})


@dataclass(slots=True)
class DemoScene:
    """Listens to the core's events; what it does to the daemon and the device is set before.

    seconds: device time at most;  say: takes a line;  live: samples since the write
    in_force: what the device held when the candidate was approved
    stop, operate: of the daemon;  candidate: what waits for an operator;  registers: in force;
    power_cycle: the device's
    """

    seconds: float
    say: Callable[[str], None]
    stop: Callable[[str], None] = lambda reason: None
    operate: Callable[[str, str], None] = lambda verb, text: None
    candidate: Callable[[], Proposal | None] = lambda: None
    registers: Callable[[], Mapping[int, tuple[float | int | str, ...]]] = dict
    power_cycle: Callable[[], None] = lambda: None
    collector: EventCollector = field(default_factory=EventCollector)
    clock: RunTime = field(default_factory=RunTime)
    state: str = State.RECONCILING.value
    gates: tuple[GateResult, ...] = ()
    estimate: Estimate | None = None
    approved: Estimate | None = None
    proposed: dict[int, tuple[float | int | str, ...]] = field(default_factory=dict)
    in_force: dict[int, tuple[float | int | str, ...]] = field(default_factory=dict)
    live: list[tuple[Array, Array]] = field(default_factory=list)
    shown: set[int] = field(default_factory=set)
    written: bool = False
    cut: bool = False
    after_s: float = 0.0
    passed_s: float = 0.0
    newest_s: float = math.nan
    said_s: float = -math.inf

    def __call__(self, event: Event) -> None:
        """Watch one event."""
        if not self._planned(event):
            self.collector.add(event)
        match event:
            case SamplesSeen(block):
                self._samples(block)
            case Estimated(estimate=estimate):
                self.estimate = estimate
            case Judged(gates=gates):
                self.gates = tuple(gate for gate in gates if guards_a_write(gate.gate))
                self._progress()
            case RegisterWritten(register=register, outcome=outcome):
                self._line("", f"register {register} {outcome}")
            case StateChanged(new=new, reason=reason):
                self.state = new
                self._line(new, reason)
                self._act(new)

    def _planned(self, event: Event) -> bool:
        """Whether it is the warning of the restart that this scene brought about."""
        return (
            self.cut and isinstance(event, Noted) and event.text.startswith("the device restarted")
        )

    def _samples(self, block: SampleBlock) -> None:
        now_s = float(block.time_s[-1])
        step_s = now_s - self.newest_s
        self.clock.samples(block.time_s)
        if step_s > 0.0:  # the device's time begins again when its power was away
            self.passed_s += step_s
        self.newest_s = now_s
        if self.passed_s > self.seconds:
            self._end(f"{self.seconds:.0f} s of device time are over")
        if self.written:
            self._show(block)
        if self.state in (State.COMMITTED, State.CONFIRMED):
            self.after_s += max(step_s, 0.0)
        if self.state == State.COMMITTED and not self.cut:
            complete = len(self.shown) >= _ENOUGH * 360.0 / _SECTOR_DEG
            if complete or self.after_s > _LONGEST_S:
                self._line("", "shown on every heading; its power is switched off and on again")
                self.cut, self.after_s = True, 0.0
                self.power_cycle()
        if self.state == State.CONFIRMED and self.after_s > _AFTER_S:
            self._end("saved, and read after a restart")

    def _show(self, block: SampleBlock) -> None:
        """Live samples for the picture, and the headings that they cover."""
        assert self.approved is not None
        self.live.append((block.raw_b_gauss, block.accel_b_m_s2))
        field_b_gauss = self.approved.correction.apply(block.raw_b_gauss[-1:])
        heading = tilt_compensated_heading(field_b_gauss, block.accel_b_m_s2[-1:])
        sector = math.degrees(float(heading[0])) % 360.0 // _SECTOR_DEG
        self.shown.add(int(sector))

    def _act(self, state: str) -> None:
        if state == State.QUALIFIED:
            self._approve()
        elif state in _HOPELESS:
            self._end(f"ended in {state}")
        self.written = self.written or state == State.TRIAL

    def _approve(self) -> None:
        proposal = self.candidate()
        if proposal is None:
            return
        self.approved, self.proposed = self.estimate, dict(proposal.new)
        self.in_force = dict(self.registers())
        self._line("", f"the operator approves candidate {proposal.id}, which is to send:")
        for line in proposal.lines:
            self.say(" " * 27 + line)
        self.operate("approve", proposal.id)

    def _progress(self) -> None:
        if self.passed_s - self.said_s < _SAY_EVERY_S or self.estimate is None:
            return
        self.said_s = self.passed_s
        shut = [g.gate for g in self.gates if not g.ok]
        of_write = [g.gate for g in for_level(self.gates, Level.RAM) if not g.ok]
        sigma_deg = self.estimate.heading_sigma_deg
        known = sigma_deg < UNKNOWN_HEADING_DEG
        text = f"heading {f'known to {sigma_deg:.2f} deg (1 sigma)' if known else 'not known'}; "
        text += f"{len(self.gates) - len(shut)} of {len(self.gates)} gates open"
        if shut:
            text += f", next {of_write[0]}" if of_write else f"; the save waits for {shut[0]}"
        self._line("", text)

    def _line(self, state: str, text: str) -> None:
        at_s = 0.0 if math.isnan(self.clock.newest_s) else self.clock.newest_s
        self.say(f"{at_s:8.1f} s  {state:15}{text}")

    def _end(self, reason: str) -> None:
        self.stop(reason)


def live_samples(scene: DemoScene, every: int = 5) -> tuple[Array, Array]:
    """Raw field (N, 3) in gauss and specific force (N, 3) since the write, thinned."""
    if not scene.live:
        return np.zeros((0, 3)), np.zeros((0, 3))
    raw, accel = zip(*scene.live, strict=True)
    return np.vstack(raw)[::every], np.vstack(accel)[::every]
