"""Work next to the core: in order, bounded, and reported when it fails or hangs."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from patience import PATIENCE_S
from planted_calibrator import PlantedCalibrator
from virtual_run import VirtualRun

from ahrsd import events
from ahrsd.calibration import Estimate, Observability
from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.core.estimation import EstimationTask, EstimatorState
from ahrsd.daemon.core_runner import MOST_WAITING, Worker
from ahrsd.events import Examine
from ahrsd.inputs import Examined, Input, LinkLost, LinkOpened
from ahrsd.samples import SampleBlock
from ahrsd.telemetry.public import Public
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from drivers.vn100.emulator.scenarios import Setup, build


@pytest.fixture
def worker():
    made = Worker()
    yield made
    made.close(5.0)


def wait(condition):
    for _ in range(1000):
        if condition():
            return
        threading.Event().wait(0.01)
    raise AssertionError("it did not happen within 10 s")


def test_work_is_done_in_order_and_counted_once(worker):
    done, woken = [], threading.Event()
    worker.woken = woken.set
    for k in range(20):
        worker.put(lambda k=k: done.append(k))
    counted = 0

    def all_counted():
        nonlocal counted
        counted += sum(pieces for pieces, _ in worker.take_done())
        return counted == 20

    wait(all_counted)
    assert done == list(range(20))
    assert woken.is_set()
    assert worker.take_done() == []


def test_giving_work_never_blocks_and_a_full_queue_is_reported(worker):
    gate = threading.Event()
    for _ in range(MOST_WAITING):
        assert not worker.full
        worker.put(lambda: gate.wait() and None)
    assert worker.full
    worker.put(lambda: None)  # giving more anyway does not block
    worker.wait_for_room(0.05)
    assert worker.full
    gate.set()
    wait(lambda: not worker.full)
    worker.wait_for_room(60.0)  # there is room: at once


def test_long_work_is_reported_as_stuck_and_does_not_block(worker, monkeypatch):
    monkeypatch.setattr("ahrsd.daemon.core_runner._STUCK_S", 0.05)
    gate = threading.Event()
    assert not worker.stuck
    worker.put(lambda: gate.wait() and None)
    wait(lambda: worker.stuck)
    for _ in range(2 * MOST_WAITING):
        worker.put(lambda: None)
    assert not worker.full  # bytes are still accepted: the service manager will end the process
    gate.set()
    wait(lambda: not worker.stuck)


def test_ended_thread_is_reported(worker, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    worker.put(lambda: 1 / 0)

    def told():
        try:
            worker.take_done()
        except RuntimeError as error:
            return "the estimator's thread ended" in str(error)
        return False

    wait(told)


def test_watchdog_is_not_fed_while_the_estimator_is_stuck(live, monkeypatch):
    monkeypatch.setattr("ahrsd.daemon.core_runner._STUCK_S", 0.2)
    gate, fed = threading.Event(), []
    with live({"output": "imu"}) as daemon:
        public = Public(time.monotonic())
        public.notifier.feed = lambda: fed.append(time.monotonic())
        daemon.daemon._telemetry = public
        daemon.until(lambda: len(fed) > 20)
        daemon.core.calibrator.take = lambda _: gate.wait(PATIENCE_S)
        daemon.until(lambda: daemon.shell.worker.stuck)
        daemon.flowing()  # a cycle that started before may end
        count = len(fed)
        daemon.flowing()
        daemon.flowing()
        assert len(fed) == count
        gate.set()
        daemon.until(lambda: len(fed) > count)


class BesideRun(VirtualRun):
    """The calibrator's work is done when `work` is called; `fed` has every input."""

    def __init__(self, mode: Mode = Mode.OBSERVE) -> None:
        self.fed: list[Input] = []
        self.waiting: deque[Examine] = deque()
        policy = WriteBackPolicy(
            mode=mode,
            approval="auto",
            armed_at_start=True,
            commit_unattended=True,
            max_change_auto_deg=180.0,
            recheck_s=0.5,
        )
        settings = replace(core_settings(Config(), policy=policy), beside=True)
        device = build(Setup("rov", seed=3, output="imu", rate_hz=50))
        super().__init__(device, settings, step_s=0.1, listen=self._listen)

    def feed(self, item):
        waiting = [item]
        while waiting:
            self.fed.append(waiting.pop(0))
            for event in self.core.handle(self.fed[-1]):
                self.listen(event)
                self._carry_out(event, waiting)

    def _listen(self, event: events.Event) -> None:
        if isinstance(event, Examine):
            self.waiting.append(event)

    def work(self) -> None:
        """Does all waiting work."""
        done = len(self.waiting)
        while self.waiting:
            self.waiting.popleft().work()
        self.feed(Examined(self.now_ns, done))


def estimate() -> Estimate:
    return Estimate(
        np.diag([1.1, 1.0, 1 / 1.1]), np.array([0.03, 0.04, -0.02]), np.zeros(3),
        0.48, False, np.eye(12) * 1e-6, 1e-3, 1e-3, 1.0, 0.1,
        Observability(np.full(12, 0.01), (), 10.0), 10_000, 300.0, True,
    )  # fmt: skip


def test_replay_has_the_same_decisions_at_the_same_place():
    run = BesideRun()
    for wait_s in (3.0, 0.5, 7.0, 1.0, 12.0, 2.0, 30.0):
        run.run(wait_s)
        run.work()
    assert run.core.decisions.count >= 3
    again = Core(run.core.settings)
    for item in run.fed:
        again.handle(item)
    assert again.decisions.entries == run.core.decisions.entries
    assert again.decisions.sha256 == run.core.decisions.sha256


def test_delayed_reports_equal_immediate_ones():
    run = BesideRun()
    run.run(60.0)
    run.work()
    at_once = Core(replace(run.core.settings, beside=False))
    for item in run.fed:
        if not isinstance(item, Examined):
            at_once.handle(item)
    said, said_at_once = (
        [e for e in core.decisions.entries if "converged" in e] for core in (run.core, at_once)
    )
    assert len(said) >= 2
    assert said == said_at_once


def candidate(run: BesideRun) -> BesideRun:
    """Observing, with a candidate among the results that wait to be judged."""
    assert run.until(lambda: run.core.writeback.state.value == "OBSERVING", 10.0), run.notes
    run.run(2.0)
    run.work()
    run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
    run.run(1.5)
    assert run.waiting
    return run


def test_timely_verdict_leads_to_a_write():
    run = candidate(BesideRun(Mode.STAGE))
    run.work()
    assert run.until(lambda: run.writes > 0, 10.0), run.states


def test_verdict_from_before_a_lost_link_writes_nothing():
    run = candidate(BesideRun(Mode.STAGE))
    run.feed(LinkLost(run.now_ns, "pulled"))
    run.feed(LinkOpened(run.now_ns, "virtual", 115200))
    run.work()
    assert run.until(lambda: run.core.writeback.state.value == "OBSERVING", 20.0), run.notes
    assert run.writes == 0
    assert "QUALIFIED" not in run.states


def test_verdict_on_outdated_registers_writes_nothing():
    run = candidate(BesideRun(Mode.STAGE))
    run.core.set_registers_in_force(run.core.registers)
    run.work()
    run.run(5.0)
    assert run.writes == 0
    assert "QUALIFIED" not in run.states


# -- failures --------------------------------------------------------------------------------------


def broken(*_):
    raise np.linalg.LinAlgError("Singular matrix")


REASON = "LinAlgError: Singular matrix"


def failures(run):
    return [e for e in run.core.decisions.entries if e["state"] == "ESTIMATOR FAILED"]


def break_off(run: BesideRun) -> None:
    """Makes the next piece of work of the calibrator fail; its successors work again."""
    run.core.calibrator.take = broken
    run.run(1.0)
    done, failure = 0, None
    while run.waiting and failure is None:
        failure = run.waiting.popleft().work()
        done += 1
    assert failure is not None
    assert failure.reason == REASON
    assert "Traceback" in failure.trace
    run.feed(Examined(run.now_ns, done, failure.reason))
    run.work()


def test_failure_is_a_state_and_the_estimator_restarts():
    run = BesideRun()
    run.run(5.0)
    run.work()
    first = run.core.calibrator
    break_off(run)
    assert run.core.estimation.state.failed
    assert (run.core.estimation.state.reason, run.core.estimation.state.failures) == (REASON, 1)
    assert ("error", f"ESTIMATOR FAILED: {REASON}; it begins anew in 5 s") in run.notes
    assert len(failures(run)) == 1
    second, samples = run.core.calibrator, run.core.stream.facts.samples
    assert second is not first
    run.run(3.0)  # the pause: samples continue
    run.work()
    assert run.core.stream.facts.samples > samples
    assert not second.started
    run.run(4.0)
    run.work()
    assert not run.core.estimation.state.failed
    assert second.started


def test_replay_contains_the_failure_at_the_same_place():
    run = BesideRun()
    run.run(5.0)
    run.work()
    break_off(run)
    run.run(20.0)
    run.work()
    again = Core(run.core.settings)
    for item in run.fed:
        again.handle(item)
    assert len(failures(run)) == 1
    assert again.decisions.sha256 == run.core.decisions.sha256
    assert again.estimation.state.failures == 1


def test_repeated_failures_lengthen_the_pause():
    state = EstimatorState()
    pauses = []
    for _ in range(6):
        state.record_failure(REASON)
        pauses.append(state.left_s)
        while state.failed:
            state.accepts(second())
    assert pauses == [5.0, 10.0, 20.0, 40.0, 60.0, 60.0]
    for _ in range(301):
        assert state.accepts(second())
    state.record_failure(REASON)
    assert state.left_s == 5.0


def second() -> SampleBlock:
    return SampleBlock(*([np.full(4, 0.25)] * 3), *([np.zeros((4, 3))] * 3))


@pytest.mark.parametrize("state", ["QUALIFIED", "TRIAL"])
def test_failed_estimator_writes_nothing_and_ends_a_trial(state):
    run = candidate(BesideRun(Mode.STAGE if state == "TRIAL" else Mode.OBSERVE))
    run.work()
    if state == "TRIAL":
        assert run.until(lambda: run.core.writeback.state.value == "TRIAL", 20.0), run.states
        before = run.states.count("ROLLED_BACK")
        run.core.calibrator.take = broken
        run.run(2.0)
        fail_waiting(run)
        assert run.until(lambda: run.states.count("ROLLED_BACK") > before, 20.0), run.states
        assert run.core.writeback.history.open is None
    else:
        assert run.core.writeback.proposal is not None
        run.core.calibrator.take = broken
        run.run(1.0)
        fail_waiting(run)
    assert run.core.writeback.proposal is None
    assert "no gate has judged yet" in run.core.writeback.obstacles()


def fail_waiting(run: BesideRun) -> None:
    done, failure = 0, None
    while run.waiting and failure is None:
        failure = run.waiting.popleft().work()
        done += 1
    assert failure is not None
    run.feed(Examined(run.now_ns, done, failure.reason))


def test_worker_continues_after_a_failure_and_logs_it_once(worker, caplog):
    done = []
    for k in range(6):
        one = SimpleNamespace(broken=False)  # a separate calibrator
        piece = EstimationTask(one, broken if k in (1, 3) else lambda k=k: done.append(k))
        worker.put(piece.work)
    batches = []
    wait(lambda: batches.extend(worker.take_done()) or sum(n for n, _ in batches) == 6)
    assert done == [0, 2, 4, 5]
    ends = np.cumsum([n for n, _ in batches]).tolist()
    assert [end for end, (_, reason) in zip(ends, batches, strict=True) if reason] == [2, 4]
    assert caplog.text.count("the estimator broke off: LinAlgError: Singular matrix") == 1
    assert ["Traceback" in getattr(r, "trace", "") for r in caplog.records] == [True]


def test_failed_calibrator_gets_no_further_work():
    done = []
    one, other = SimpleNamespace(broken=False), SimpleNamespace(broken=False)
    assert EstimationTask(one, broken).work().reason == REASON
    assert EstimationTask(one, lambda: done.append(1)).work() is None
    assert EstimationTask(other, lambda: done.append(2)).work() is None
    assert done == [2]
