"""The write-back with the real session on the emulated device: bytes, retries and every fault."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd.writeback.actions import AppendToJournal, IdentifyAgain, RunProcedure
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode, Purpose, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import identify_surely, read_surely
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.session import ProcedureFailed, ProcedureFinished, Session

STEP_S = 0.01
FAULT_OVER_S = 12.0
HOLDS_OLD = (State.OBSERVING, State.CANDIDATE, State.QUALIFIED, State.ROLLED_BACK)


class Bench:
    """A minimal core, an emulated device, and one clock for both."""

    def __init__(self, setup, estimate):
        self.emulator = build(setup)
        self.estimate = estimate
        policy = WriteBackPolicy(mode=Mode.COMMIT, trial=TrialPolicy(interlock=False))
        self.wb = WriteBack(policy)
        self.gate = lambda _: True
        self.session = Session(self.allow)
        self.now_s = 1.0
        self.emulator.advance(self.now_s)
        self.journal, self.running, self.waiting = [], None, []
        self.identified, self.restarts = None, 0
        self.identify()

    def allow(self, command):
        return self.gate(command)

    def identify(self):
        def everything():
            who = yield from identify_surely()
            return who, (yield from read_surely(who, (23, 84)))

        self.waiting.append(RunProcedure("identify", Purpose.READ, everything, lambda _: True))

    def do(self, actions):
        queue = list(actions)
        while queue:
            action = queue.pop(0)
            if isinstance(action, AppendToJournal):
                record = SimpleNamespace(kind=action.kind.value, facts=dict(action.facts))
                self.journal.append(record)
                queue = self.wb.on_journal_ok(action.kind, self.now_s) + queue
            elif isinstance(action, RunProcedure):
                self.waiting.append(action)
            elif isinstance(action, IdentifyAgain):
                self.identify()

    def step(self):
        """Exchanges bytes in both directions once."""
        self.do(self.wb.on_interlock(True, self.now_s))
        self.do(self.wb.tick(self.now_s))
        if self.waiting and not self.session.busy:
            self.running = self.waiting.pop(0)
            self.gate = self.running.gate
            self.end(self.session.start(self.running.make(), self.now_s))
        self.emulator.receive(self.session.take_output(), self.now_s)
        self.now_s += STEP_S
        self.end(self.session.receive(self.emulator.advance(self.now_s), self.now_s))
        if (due := self.session.deadline_s) is not None and self.now_s >= due:
            self.end(self.session.tick(self.now_s))
        if self.emulator.counters["restarts"] > self.restarts:
            self.restarts = self.emulator.counters["restarts"]
            self.do(self.wb.on_reset(self.now_s))
            self.end(self.session.link_lost(self.now_s))
            self.waiting.clear()
            self.identify()

    def end(self, events):
        for event in events:
            if not isinstance(event, ProcedureFinished | ProcedureFailed):
                continue
            name = self.running.name
            if name == "identify" and isinstance(event, ProcedureFailed):
                self.identify()
            elif name == "identify":
                who, held = event.result
                wall_s, boot_s = 1.8e9 + self.now_s, self.now_s
                self.do(self.wb.on_clock(wall_s, "boot", boot_s, self.now_s))
                self.do(self.wb.on_device(who, held, self.journal, self.now_s))
                self.identified = who
            elif isinstance(event, ProcedureFinished):
                self.do(self.wb.on_procedure_finished(name, event.result, self.now_s))
            else:
                self.do(self.wb.on_procedure_failed(name, event.error, self.now_s))

    def until(self, condition, seconds):
        end_s = self.now_s + seconds
        while not condition() and self.now_s < end_s:
            self.step()
        return condition()

    def settled(self):
        return not self.session.busy and not self.waiting and self.wb.idle

    @property
    def held(self):
        return {n: tuple(self.emulator.memory.get(n)) for n in (23, 84)}


def make_estimate():
    from ahrsd.calibration import Estimate, Observability

    return Estimate(
        np.diag([1.1, 1.0, 1.0 / 1.1]),
        np.array([0.03, 0.04, -0.02]),
        np.array([0.01, -0.02, 0.005]),
        *(0.48, False, np.eye(12) * 1e-6, 1e-3, 1e-3, 1.0, 0.1),
        *(Observability(np.full(12, 0.01), (), 10.0), 10_000, 300.0, True),
    )


def begin(setup):
    """A known device and a candidate that an operator approves; the fault comes later."""
    from ahrsd.events import GateResult

    bench = Bench(setup, make_estimate())
    assert bench.until(lambda: bench.wb.state is State.OBSERVING, 3.0)
    old = bench.held
    green = (GateResult("observability", 3.0, 1.0, True, 0.0, "", ""),)
    bench.do(bench.wb.on_verdict(bench.estimate, green, 1.0, bench.now_s))
    new = {n: tuple(v) for n, v in bench.wb.proposal.new.items()}
    assert bench.until(lambda: bench.now_s >= 3.0, 3.0)
    bench.do(bench.wb.on_operator("approve", bench.wb.proposal.id, bench.now_s))
    return bench, old, new


@pytest.mark.parametrize("firmware", ["3.0.0.0", "3"])
def test_registers_reach_the_device_exactly_and_are_rolled_back(firmware):
    bench, old, new = begin(Setup(firmware=firmware, rate_hz=40))
    assert bench.until(lambda: bench.wb.state is State.TRIAL, 5.0)
    assert bench.held == new
    assert set(new) == {23, 84}
    bench.do(bench.wb.on_operator("rollback", "", bench.now_s))
    assert bench.until(lambda: bench.wb.state is State.ROLLED_BACK, 5.0)
    assert bench.held == old
    before = bench.emulator.counters.copy()
    bench.until(lambda: False, 1.0)
    assert bench.emulator.counters != before  # it streams


def test_firmware_2_with_applied_onboard_estimator_is_not_written():
    bench, old, _ = begin(Setup(firmware="2", rate_hz=40))
    bench.until(lambda: False, 2.0)
    assert bench.wb.state is State.QUALIFIED
    assert bench.held == old
    assert any("on-board estimator" in text for text in bench.wb.obstacles())


FAULTS = [
    "late_reply", "late_reply=1.6", "lost_reply=0.5", "lost_reply", "wrong_reply=0.7",
    "altered_reply=0.5", "refused_write", "refused_write=3", "silent_refusal", "collision",
    "byte_drop=0.01", "bit_flip=0.01", "noise_insert=0.5", "garbage=0.3", "duplicate=0.7",
    "burst_latency=60", "false_header=0.5", "mute",
]  # fmt: skip
CHECK_S, WRITE_S = 3.0, (3.28, 3.31, 3.33)  # steps of a transaction that begins at 3.0
SCHEDULES = [
    *(f"{fault}@{at_s}+6" for fault in FAULTS for at_s in (CHECK_S, *WRITE_S)),
    *(f"{fault}@{at_s}" for fault in ("reset", "power_cut") for at_s in (3.1, *WRITE_S)),
    *(f"power_cut_wrg={n}@3.1" for n in (1, 2)),
]
#: each fault from the check on, and from one moment of the write that differs between faults
QUICK = [
    *(f"{fault}@{at_s}+6" for k, fault in enumerate(FAULTS) for at_s in (CHECK_S, WRITE_S[k % 3])),
    *(one for one in SCHEDULES if one.startswith(("reset", "power_cut"))),
]


def come_to_rest(bench):
    """Runs until nothing is in progress; after a FAULT a person requests a check on a good line."""

    def at_rest():
        return bench.wb.state is State.TRIAL or bench.settled()

    bench.until(lambda: bench.now_s >= FAULT_OVER_S, 60.0)
    assert bench.until(at_rest, 60.0)
    if bench.wb.state is State.FAULT:
        bench.do(bench.wb.on_operator("unlock", "the line is good", bench.now_s))
        bench.until(lambda: bench.wb.state not in (State.FAULT, State.RECONCILING), 30.0)
        assert bench.until(at_rest, 30.0)


@pytest.mark.parametrize(
    "fault",
    [pytest.param(one, marks=() if one in QUICK else pytest.mark.slow) for one in SCHEDULES],
)
def test_machine_and_device_agree_after_every_fault(fault):
    """How far the write comes may vary. Afterwards machine and device must agree."""
    bench, old, new = begin(Setup(seed=1, firmware="3", faults=(fault,), rate_hz=20))
    come_to_rest(bench)
    assert bench.wb.state in (State.TRIAL, *HOLDS_OLD)
    assert bench.held == (new if bench.wb.state is State.TRIAL else old)


@pytest.mark.parametrize("at_s", [3.0, 3.1, 3.2])
def test_foreign_value_written_during_a_write_stays(at_s):
    bench, old, _ = begin(Setup(firmware="3", faults=(f"third_party_change@{at_s}",), rate_hz=20))
    come_to_rest(bench)
    assert bench.held[23] != old[23]
    assert bench.held[84] == old[84]
    assert "RAM_VERIFIED" not in [record.kind for record in bench.journal]
