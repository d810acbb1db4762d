"""From samples to a judged estimate: held-out data, estimator, evidence and gates.

**Tasks.** The calibrator takes samples and judges the estimate. Now and then that takes much of a
second, in which the port, the interlock and an operator would wait. So each block becomes a
task whose result is taken later. In a run another thread does the tasks in order
(`daemon.core_runner.Worker`), and the input `Examined` says how many are done. A replay does them
when it comes to that input, and so takes the same decisions from the same results at the same
place. Only its tasks may change a calibrator.

`run_supervised` is the one place where every exception is caught: a failure of the estimator
becomes a state with a reason (`core`) and never ends the program. In a run `Examined` says which
task failed, so that a replay takes the same decision.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.core.settings import CalibratorSettings
from ahrsd.estimator.model_checks import change_message
from ahrsd.estimator.online import Estimator
from ahrsd.estimator.step_detector import Step, StepDetector
from ahrsd.events import Failure, GateResult, Noted
from ahrsd.evidence.collector import EvidenceCollector
from ahrsd.evidence.segments import Role
from ahrsd.evidence.values import BasisFacts, Evidence, HealthFacts
from ahrsd.gates import GateLimits, judge
from ahrsd.samples import Array, SampleBlock
from ahrsd.stream.decompensation import user_compensation
from drivers.vn100.registers import Values

# -- The calibration of one device -----------------------------------------------------------------


_PATIENCE_S = 60.0  # after a reported step, for the estimator to detect it and restart by itself


class Calibrator:
    """One device's calibration. `present` and `present_gyro_bias_rad_s` are the user's registers 23
    and 84: the reference for a candidate, also while a candidate is on trial.
    """

    def __init__(
        self, settings: CalibratorSettings, present: Affine, present_gyro_bias_rad_s: Array
    ) -> None:
        self.settings = settings
        self.present = present
        self.present_gyro_bias_rad_s = present_gyro_bias_rad_s
        self.estimator = Estimator(settings.estimator, present, present_gyro_bias_rad_s)
        self.collector = EvidenceCollector()
        self.estimate: Estimate | None = None
        self.evidence: Evidence | None = None
        self.gates: tuple[GateResult, ...] = ()
        self._gap = True
        self.started = False
        self.broken = False  # a task failed in it: its state is undefined
        self.steps = StepDetector()
        self.step: Step | None = None  # the newest reported step
        self.step_open = False  # the estimate still uses data from before the step
        self._notes: list[tuple[float, str]] = []
        self._void = ""
        self._at_s = float("nan")
        self._reported_restart_s: float | None = None  # of the estimator
        self._reported_warnings: set[str] = set()  # without their numbers

    @property
    def proposed(self) -> Affine | None:
        """The correction of the estimate; None until it has converged."""
        found = self.estimate
        return found.correction if found is not None and found.converged else None

    def take_void(self) -> str:
        """Why calibrations from before the last call are void; empty if they may be valid."""
        void, self._void = self._void, ""
        return void

    def take_notes(self, host_s: float) -> list[Noted]:
        """Warnings since the last call, about changes on the vehicle and the estimate."""
        notes, self._notes = self._notes, []
        return [Noted(at_s, host_s, "warning", text) for at_s, text in notes]

    def compare_with(self, present: Affine, present_gyro_bias_rad_s: Array) -> None:
        """Set the reference for a candidate; before the first sample also the prior's centre."""
        if not self.started:
            self.estimator = Estimator(self.settings.estimator, present, present_gyro_bias_rad_s)
        self.present, self.present_gyro_bias_rad_s = present, present_gyro_bias_rad_s

    def set_settings(self, settings: CalibratorSettings) -> None:
        """Use other settings from now on."""
        self.settings = settings

    def make_fresh(self) -> Calibrator:
        """A calibrator without samples: later samples must not be mixed with earlier ones."""
        return Calibrator(self.settings, self.present, self.present_gyro_bias_rad_s)

    def take(self, block: SampleBlock) -> bool:
        """Take samples in order; returns whether there is something new to judge."""
        new = False
        self.started = True
        self._at_s = float(block.time_s[-1]) if len(block) else self._at_s
        stepped = self._detect_step(block)
        parts = self.collector.split(block)
        for _, part in parts:
            self.collector.add(part)
        for piece in self._training_parts(parts) if self.settings.held_out else [block]:
            new |= self.estimator.add(_clear_first_step(piece))
        if new:
            self.estimate = self._apply_known_field(self.estimator.estimate())
            self._report_estimator_news(self.estimate)
        return (new or stepped) and self.estimate is not None

    def _detect_step(self, block: SampleBlock) -> bool:
        """Whether this block shows a step of hard iron or gyro bias. Restarts when overdue."""
        step = self.steps.add(block, self.estimate)
        if step is not None:
            self.step, self.step_open = step, True
            self._notes.append((step.told_s, step.words))
            self._void = step.words
        elif self.step_open and self._restart_overdue:
            self.estimator = Estimator(
                self.settings.estimator, self.present, self.present_gyro_bias_rad_s
            )
            self.estimate, self._gap, self._reported_restart_s = None, True, None
            self._restart_evidence([f"calibrated anew from {self._at_s:.0f} s"])
        return step is not None

    @property
    def _restart_overdue(self) -> bool:
        return self.step is None or not 0.0 <= self._at_s - self.step.told_s <= _PATIENCE_S

    def _report_estimator_news(self, estimate: Estimate | None) -> None:
        """Note a restart that the estimator made by itself, and warnings that are new."""
        at_s = self.estimator.restarted_s
        if estimate is not None and at_s is not None and at_s != self._reported_restart_s:
            self._reported_restart_s = at_s
            self._void = change_message(at_s)
            self._restart_evidence([self._void])
            self._reported_warnings.add(_warning_without_numbers(self._void))
        for text in () if estimate is None else estimate.warnings:
            if _warning_without_numbers(text) not in self._reported_warnings:
                self._reported_warnings.add(_warning_without_numbers(text))
                self._notes.append((self._at_s, text))

    def _restart_evidence(self, notes: list[str]) -> None:
        """The estimate discarded data before a change: discard the evidence from then as well."""
        self._notes += [(self._at_s, text) for text in notes]
        self.collector = EvidenceCollector()
        self.steps.restart()
        self.step_open = False
        self._reported_warnings = set()

    def _training_parts(self, parts: Iterable[tuple[Role, SampleBlock]]) -> Iterator[SampleBlock]:
        """The parts for the estimator, with a gap marked after each held-out part."""
        for role, part in parts:
            if role == "heldout":
                self._gap = True
                continue
            yield replace(part, gap_before=True) if self._gap else part
            self._gap = False

    def finish(self) -> Estimate | None:
        """End of the stream: iterate until the estimate has converged."""
        self.estimate = self._apply_known_field(self.estimator.finish())
        return self.estimate

    def judge_estimate(
        self, at_s: float, health: HealthFacts, basis: BasisFacts, margin: float = 1.0
    ) -> tuple[GateResult, ...]:
        """Evaluate the evidence for the present estimate and judge it by the gates.

        margin: factor on the required improvement (larger after a rollback).
        """
        if self.estimate is None:
            return ()
        self.evidence = self.collector.evaluate(
            self.estimate,
            self.present,
            self.present_gyro_bias_rad_s,
            self.settings.world_field,
            health,
            replace(basis, stepped=self.step_open),
        )
        self.gates = judge(
            self.evidence, self.settings.limits.with_margin(margin), at_s, self.gates
        )
        return self.gates

    def _apply_known_field(self, estimate: Estimate | None) -> Estimate | None:
        """With a world field the scale is known: scale A so that the corrected field has it."""
        field = self.settings.world_field
        if estimate is None or field is None:
            return estimate
        factor = estimate.field_gauss / field.total_gauss
        scale = np.r_[np.full(6, factor), np.ones(6)]
        return replace(
            estimate,
            soft_iron=estimate.soft_iron * factor,
            field_gauss=field.total_gauss,
            field_known=True,
            covariance=estimate.covariance * np.outer(scale, scale),
        )


def _warning_without_numbers(warning: str) -> str:
    """A warning without its numbers, which differ between estimates."""
    return warning.partition(":")[0]


def _clear_first_step(block: SampleBlock) -> SampleBlock:
    if not block.gap_before or np.isnan(block.dt_s[0]):
        return block
    dt_s = block.dt_s.copy()
    dt_s[0] = np.nan
    return replace(block, dt_s=dt_s)


# -- Tasks of the estimation -----------------------------------------------------------------------


PAUSE_S = (5.0, 60.0)  # after a failure; at most, if it fails again soon
HEALTHY_S = 300.0  # time without failure after which the next one counts as the first
_LONGEST_REASON = 200
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Circumstances:
    """Circumstances at the arrival of a block.

    at_s, host_s: time of the device and of the host
    era: equal for blocks that were taken with the same registers in force, over one link
    """

    at_s: float
    host_s: float
    health: HealthFacts
    basis: BasisFacts
    margin: float
    era: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class EstimationResult:
    """Result of a task. `estimate` is None if there is nothing new to judge.

    void: why calibrations from before this block are void, empty if they may be valid
    """

    calibrator: Calibrator
    when: Circumstances
    proposed: Affine | None
    notes: tuple[Noted, ...]
    estimate: Estimate | None = None
    gates: tuple[GateResult, ...] = ()
    void: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class EstimationFailure:
    """A failed task: the state of `calibrator` is undefined, and it is no longer used."""

    calibrator: Calibrator
    reason: str


class EstimationTask:
    """Work that is done once: by the thread, or when its result is needed."""

    def __init__(self, calibrator: Calibrator, make: Callable[[], EstimationResult | None]) -> None:
        self.calibrator = calibrator
        self._make = make
        self._done = False
        self._result: EstimationResult | None = None
        self._failure: Failure | None = None

    def work(self) -> Failure | None:
        """Do the work; returns the failure. None: it succeeded, or the calibrator was broken."""
        self._done = True
        if not self.calibrator.broken:
            self._result, self._failure = run_supervised(self._make)
            self.calibrator.broken = self._failure is not None
        return self._failure

    def result(self) -> EstimationResult | EstimationFailure | None:
        """The result; does the work first if the thread has not."""
        if not self._done:
            self.work()
        if self._failure is not None:
            return EstimationFailure(self.calibrator, self._failure.reason)
        return self._result


def run_supervised(make: Callable[[], T | None]) -> tuple[T | None, Failure | None]:
    """Call `make`; returns its result, or the failure if it raised."""
    try:
        return make(), None
    except Exception as error:  # noqa: BLE001 - see the module
        text = " ".join(str(error).split())[:_LONGEST_REASON]
        reason = f"{type(error).__name__}: {text}" if text else type(error).__name__
        return None, Failure(reason, traceback.format_exc())


class EstimatorState:
    """Whether the estimator works: after a failure it pauses for a while, then restarts.

    Pauses are measured by samples, not by a clock, so that a replay has the same ones.
    """

    def __init__(self) -> None:
        self.reason = ""  # of the newest failure
        self.failures = 0
        self.left_s = 0.0  # of the pause
        self._pause_s = PAUSE_S[0]
        self._since_s = 0.0

    @property
    def failed(self) -> bool:
        """Whether there is no estimator now."""
        return self.left_s > 0.0

    def record_failure(self, reason: str) -> None:
        """Start a pause after a failure; a longer one if the last failure was recent."""
        again = self.failures > 0 and self._since_s < HEALTHY_S
        self._pause_s = min(2 * self._pause_s, PAUSE_S[1]) if again else PAUSE_S[0]
        self.reason, self.failures = reason, self.failures + 1
        self.left_s, self._since_s = self._pause_s, 0.0

    def accepts(self, block: SampleBlock) -> bool:
        """Whether the estimator may take this block; False during a pause."""
        span_s = float(np.nansum(block.dt_s))
        if not self.failed:
            self._since_s += span_s
            return True
        self.left_s -= span_s
        return False


class EstimationQueue:
    """Tasks whose results the core has not taken yet, oldest first."""

    def __init__(self) -> None:
        self._tasks: deque[EstimationTask] = deque()

    def examine(
        self, calibrator: Calibrator, blocks: list[SampleBlock], circumstances: Circumstances
    ) -> EstimationTask:
        """Let the calibrator take the blocks and judge; circumstances of the last one."""
        return self._append(calibrator, partial(_take_and_judge, calibrator, blocks, circumstances))

    def add_earlier(
        self, calibrator: Calibrator, block: SampleBlock, circumstances: Circumstances
    ) -> EstimationTask:
        """Let the calibrator take a block of an earlier run, without judging."""
        return self._append(
            calibrator, partial(_take_earlier_block, calibrator, block, circumstances)
        )

    def set_present(
        self, calibrator: Calibrator, present: Affine, bias_b_rad_s: Array
    ) -> EstimationTask:
        """Set the calibrator's reference for a candidate."""
        return self._append(calibrator, partial(calibrator.compare_with, present, bias_b_rad_s))

    def set_settings(self, calibrator: Calibrator, settings: CalibratorSettings) -> EstimationTask:
        """Set the calibrator's settings, with other limits."""
        return self._append(calibrator, partial(calibrator.set_settings, settings))

    def _append(
        self, calibrator: Calibrator, make: Callable[[], EstimationResult | None]
    ) -> EstimationTask:
        task = EstimationTask(calibrator, make)
        self._tasks.append(task)
        return task

    def take_results(
        self, tasks: int, broken: str = ""
    ) -> list[EstimationResult | EstimationFailure]:
        """The results of the oldest tasks; an incomplete recording may request too many.

        broken: how the last one of them failed; it is not tried again
        """
        taken = [self._tasks.popleft() for _ in range(min(tasks, len(self._tasks)))]
        last = [EstimationFailure(taken.pop().calibrator, broken)] if broken and taken else []
        if last:
            last[0].calibrator.broken = True
        found = [one for task in taken if (one := task.result()) is not None]
        return [*found, *last]


def _take_earlier_block(
    calibrator: Calibrator, block: SampleBlock, now: Circumstances
) -> EstimationResult:
    calibrator.take(block)
    notes, void = tuple(calibrator.take_notes(now.host_s)), calibrator.take_void()
    return EstimationResult(calibrator, now, None, notes, void=void)


def _take_and_judge(
    calibrator: Calibrator, blocks: list[SampleBlock], now: Circumstances
) -> EstimationResult:
    new, void = False, ""
    for block in blocks:
        new |= calibrator.take(block)
        void = calibrator.take_void() or void
    proposed, notes = calibrator.proposed, tuple(calibrator.take_notes(now.host_s))
    if not new:
        return EstimationResult(calibrator, now, proposed, notes, void=void)
    gates = calibrator.judge_estimate(now.at_s, now.health, now.basis, now.margin)
    return EstimationResult(calibrator, now, proposed, notes, calibrator.estimate, gates, void)


# -- The calibration in use ------------------------------------------------------------------------


class Estimation:
    """The calibrator in use, its tasks, and whether it works.

    begin: has a task done, by the thread or at once
    """

    def __init__(
        self, settings: CalibratorSettings, begin: Callable[[EstimationTask], None]
    ) -> None:
        self._settings, self._begin = settings, begin
        self._present: tuple[Affine, Array] = (Affine.identity(), np.zeros(3))
        self._queue = EstimationQueue()
        self.state = EstimatorState()
        self.calibrator = Calibrator(settings, *self._present)
        self.proposed: Affine | None = None

    def restart_from_identity(self) -> None:
        """New calibrator: another device, or the samples were decompensated wrongly."""
        self.calibrator = Calibrator(self._settings, Affine.identity(), np.zeros(3))

    def restart(self) -> None:
        """New calibrator for a stream with other quantities."""
        self.calibrator = self.calibrator.make_fresh()
        self._pass_present()

    def compare_with(self, users: Mapping[int, Values]) -> None:
        """Set the reference for a candidate: the correction by the user's registers."""
        self._present = user_compensation(users)
        self._pass_present()

    def set_limits(self, limits: Mapping[str, Any]) -> CalibratorSettings:
        """Judge by these limits from now on; returns the new settings."""
        self._settings = replace(self._settings, limits=GateLimits(**limits))
        self._begin(self._queue.set_settings(self.calibrator, self._settings))
        return self._settings

    def examine(self, blocks: list[SampleBlock], when: Circumstances) -> None:
        """Let the calibrator take the blocks and judge."""
        self._begin(self._queue.examine(self.calibrator, blocks, when))

    def restart_with_earlier(self, blocks: list[SampleBlock], when: Circumstances) -> None:
        """New calibrator that takes the blocks of an earlier run first."""
        self.restart_from_identity()
        self._pass_present()
        for block in blocks:
            self._begin(self._queue.add_earlier(self.calibrator, block, when))

    def take_results(
        self, tasks: int, failure: str = ""
    ) -> Iterator[EstimationResult | EstimationFailure]:
        """Results of the oldest tasks, without those of a calibrator that was replaced."""
        for found in self._queue.take_results(tasks, failure):
            if found.calibrator is self.calibrator:
                if isinstance(found, EstimationResult):
                    self.proposed = found.proposed
                yield found

    def record_failure(self, reason: str) -> float:
        """Replace the failed calibrator and drop its proposal; returns the pause in seconds."""
        self.state.record_failure(reason)
        self.calibrator = Calibrator(self._settings, *self._present)
        self.proposed = None
        return self.state.left_s

    def _pass_present(self) -> None:
        self._begin(self._queue.set_present(self.calibrator, *self._present))
