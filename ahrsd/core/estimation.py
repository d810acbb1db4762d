"""Samples to a judged estimate: what is held out, what the estimator sees, what the gates say.

**Beside the core.** The calibrator takes samples and judges; now and then that takes a good part of
a second, in which the port, the vehicle's word and an operator would wait. So each block becomes a
task whose result is taken later: in a run another thread does the tasks in their order
(`estimation_worker`), and the input `Examined` says how many are done. A replay does them when it
comes to that input, and so takes the same decisions from the same results at the same place. A
calibrator belongs to its tasks: only they may change it.

`supervised` is the one place where whatever breaks off is caught: what the estimator cannot take
is a state with a reason (`core`), never an end. In a run `Examined` says which task broke off, so
that a replay takes the same decision.
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


_PATIENCE_S = 60.0  # after a step was told, for the estimator to see it and begin anew by itself


class Calibrator:
    """One device's calibration. `present` and `present_gyro_bias_rad_s` are the user's registers 23
    and 84: what a candidate must be better than, also while a candidate of ours is on trial.
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
        self.broken = False  # something broke off in it: it may be anything now
        self.steps = StepDetector()
        self.step: Step | None = None  # the newest one that was told
        self.step_open = False  # the estimate still rests on data from before it
        self._notes: list[tuple[float, str]] = []
        self._void = ""
        self._at_s = float("nan")
        self._heeded_s: float | None = None  # the estimator's restart that was told
        self._told: set[str] = set()  # what is wrong with the estimate, without its size

    @property
    def proposed(self) -> Affine | None:
        """The correction of the estimate, once it has converged."""
        found = self.estimate
        return found.correction if found is not None and found.converged else None

    def take_void(self) -> str:
        """Why a calibration from before the last call holds no more; empty where it may hold."""
        void, self._void = self._void, ""
        return void

    def take_notes(self, host_s: float) -> list[Noted]:
        """Warnings since the last call: what changed on the vehicle."""
        notes, self._notes = self._notes, []
        return [Noted(at_s, host_s, "warning", text) for at_s, text in notes]

    def compare_with(self, present: Affine, present_gyro_bias_rad_s: Array) -> None:
        """What a candidate must be better than; before the first sample also the prior's centre."""
        if not self.started:
            self.estimator = Estimator(self.settings.estimator, present, present_gyro_bias_rad_s)
        self.present, self.present_gyro_bias_rad_s = present, present_gyro_bias_rad_s

    def adopt(self, settings: CalibratorSettings) -> None:
        """Other limits from now on."""
        self.settings = settings

    def anew(self) -> Calibrator:
        """One that has seen nothing: what follows cannot be mixed with what came before."""
        return Calibrator(self.settings, self.present, self.present_gyro_bias_rad_s)

    def take(self, block: SampleBlock) -> bool:
        """Samples in order; true where there is something new to judge."""
        new = False
        self.started = True
        self._at_s = float(block.time_s[-1]) if len(block) else self._at_s
        stepped = self._watch(block)
        parts = self.collector.parts(block)
        for _, part in parts:
            self.collector.add(part)
        for piece in self._training(parts) if self.settings.held_out else [block]:
            new |= self.estimator.add(_unknown_first_step(piece))
        if new:
            self.estimate = self._scaled(self.estimator.estimate())
            self._heed(self.estimate)
        return (new or stepped) and self.estimate is not None

    def _watch(self, block: SampleBlock) -> bool:
        """Whether hard iron or gyro bias are seen to have stepped since the estimate was made."""
        step = self.steps.add(block, self.estimate)
        if step is not None:
            self.step, self.step_open = step, True
            self._notes.append((step.told_s, step.words))
            self._void = step.words
        elif self.step_open and self._waited_enough:
            self.estimator = Estimator(
                self.settings.estimator, self.present, self.present_gyro_bias_rad_s
            )
            self.estimate, self._gap, self._heeded_s = None, True, None
            self._begin_anew([f"calibrated anew from {self._at_s:.0f} s"])
        return step is not None

    @property
    def _waited_enough(self) -> bool:
        return self.step is None or not 0.0 <= self._at_s - self.step.told_s <= _PATIENCE_S

    def _heed(self, estimate: Estimate | None) -> None:
        """Whether the estimator began anew by itself since the last call, and what else it warns of
        for the first time."""
        at_s = self.estimator.restarted_s
        if estimate is not None and at_s is not None and at_s != self._heeded_s:
            self._heeded_s = at_s
            self._void = change_message(at_s)
            self._begin_anew([self._void])
            self._told.add(_kind(self._void))
        for text in () if estimate is None else estimate.warnings:
            if _kind(text) not in self._told:
                self._told.add(_kind(text))
                self._notes.append((self._at_s, text))

    def _begin_anew(self, notes: list[str]) -> None:
        """The estimate forgot what was before a change: evidence from then proves nothing now."""
        self._notes += [(self._at_s, text) for text in notes]
        self.collector = EvidenceCollector()
        self.steps.restart()
        self.step_open = False
        self._told = set()

    def _training(self, parts: Iterable[tuple[Role, SampleBlock]]) -> Iterator[SampleBlock]:
        """What the estimator may see; nothing is bridged over what is held out."""
        for role, part in parts:
            if role == "heldout":
                self._gap = True
                continue
            yield replace(part, gap_before=True) if self._gap else part
            self._gap = False

    def finish(self) -> Estimate | None:
        """The end of the stream: iterate to the end."""
        self.estimate = self._scaled(self.estimator.finish())
        return self.estimate

    def judged(
        self, at_s: float, health: HealthFacts, basis: BasisFacts, margin: float = 1.0
    ) -> tuple[GateResult, ...]:
        """Evaluate the evidence for the present estimate and pass it through the gates.

        margin: how much clearer than usual an improvement must be (after a rollback).
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

    def _scaled(self, estimate: Estimate | None) -> Estimate | None:
        """With a world field the scale is known: A grows so that the corrected field has it."""
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


def _kind(warning: str) -> str:
    """A warning without its numbers, which are others with each estimate."""
    return warning.partition(":")[0]


def _unknown_first_step(block: SampleBlock) -> SampleBlock:
    if not block.gap_before or np.isnan(block.dt_s[0]):
        return block
    dt_s = block.dt_s.copy()
    dt_s[0] = np.nan
    return replace(block, dt_s=dt_s)


# -- Beside the core -------------------------------------------------------------------------------


PAUSE_S = (5.0, 60.0)  # after a failure, and at most where it fails again soon
HEALTHY_S = 300.0  # without a failure: the next one is a first one
_LONGEST_REASON = 200
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Circumstances:
    """How things stood when the block came.

    at_s, host_s: time of the device and of the host
    era: two blocks of one era were taken with the same registers in force, over one link
    """

    at_s: float
    host_s: float
    health: HealthFacts
    basis: BasisFacts
    margin: float
    era: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class EstimationResult:
    """What a block brought. `estimate` is None where there is nothing new to judge.

    void: why a calibration from before this block holds no more, empty where it may hold
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
    """A task that broke off: `calibrator` may be anything now and is used no more."""

    calibrator: Calibrator
    reason: str


class EstimationTask:
    """Work that is done once: by the thread, or when its result is asked for."""

    def __init__(self, calibrator: Calibrator, make: Callable[[], EstimationResult | None]) -> None:
        self.calibrator = calibrator
        self._make = make
        self._begun = False
        self._result: EstimationResult | None = None
        self._failure: Failure | None = None

    def work(self) -> Failure | None:
        """Do it; returns how it broke off. None: not at all, or its calibrator was broken."""
        self._begun = True
        if not self.calibrator.broken:
            self._result, self._failure = supervised(self._make)
            self.calibrator.broken = self._failure is not None
        return self._failure

    def result(self) -> EstimationResult | EstimationFailure | None:
        """What it brought."""
        if not self._begun:
            self.work()
        if self._failure is not None:
            return EstimationFailure(self.calibrator, self._failure.reason)
        return self._result


def supervised(make: Callable[[], T | None]) -> tuple[T | None, Failure | None]:
    """What `make` returns, or how it broke off."""
    try:
        return make(), None
    except Exception as error:  # noqa: BLE001 - see the module
        text = " ".join(str(error).split())[:_LONGEST_REASON]
        reason = f"{type(error).__name__}: {text}" if text else type(error).__name__
        return None, Failure(reason, traceback.format_exc())


class EstimatorState:
    """Whether the estimator works: after it broke off it rests for a while, then begins anew.

    The pauses are of samples, not of a clock, so that a replay has the same ones.
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

    def broke_off(self, reason: str) -> None:
        """It did; soon again means a longer pause."""
        again = self.failures > 0 and self._since_s < HEALTHY_S
        self._pause_s = min(2 * self._pause_s, PAUSE_S[1]) if again else PAUSE_S[0]
        self.reason, self.failures = reason, self.failures + 1
        self.left_s, self._since_s = self._pause_s, 0.0

    def takes(self, block: SampleBlock) -> bool:
        """Whether the estimator may have this block, or it falls into a pause."""
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
        """Let the calibrator take the blocks and judge; how things stood when the last one came."""
        return self._put(calibrator, partial(_examined, calibrator, blocks, circumstances))

    def recall(
        self, calibrator: Calibrator, block: SampleBlock, circumstances: Circumstances
    ) -> EstimationTask:
        """Let the calibrator take a block of an earlier run; nothing is judged by it."""
        return self._put(calibrator, partial(_recalled, calibrator, block, circumstances))

    def compare(
        self, calibrator: Calibrator, present: Affine, bias_b_rad_s: Array
    ) -> EstimationTask:
        """Tell the calibrator what a candidate must be better than."""
        return self._put(calibrator, partial(calibrator.compare_with, present, bias_b_rad_s))

    def adopt(self, calibrator: Calibrator, settings: CalibratorSettings) -> EstimationTask:
        """Let the calibrator judge by other limits from now on."""
        return self._put(calibrator, partial(calibrator.adopt, settings))

    def _put(
        self, calibrator: Calibrator, make: Callable[[], EstimationResult | None]
    ) -> EstimationTask:
        task = EstimationTask(calibrator, make)
        self._tasks.append(task)
        return task

    def take(self, tasks: int, broken: str = "") -> list[EstimationResult | EstimationFailure]:
        """The results of the oldest tasks; a record that lost some of them may ask for more.

        broken: how the last one of them broke off; it is not tried again
        """
        taken = [self._tasks.popleft() for _ in range(min(tasks, len(self._tasks)))]
        last = [EstimationFailure(taken.pop().calibrator, broken)] if broken and taken else []
        if last:
            last[0].calibrator.broken = True
        found = [one for task in taken if (one := task.result()) is not None]
        return [*found, *last]


def _recalled(calibrator: Calibrator, block: SampleBlock, now: Circumstances) -> EstimationResult:
    calibrator.take(block)
    notes, void = tuple(calibrator.take_notes(now.host_s)), calibrator.take_void()
    return EstimationResult(calibrator, now, None, notes, void=void)


def _examined(
    calibrator: Calibrator, blocks: list[SampleBlock], now: Circumstances
) -> EstimationResult:
    new, void = False, ""
    for block in blocks:
        new |= calibrator.take(block)
        void = calibrator.take_void() or void
    proposed, notes = calibrator.proposed, tuple(calibrator.take_notes(now.host_s))
    if not new:
        return EstimationResult(calibrator, now, proposed, notes, void=void)
    gates = calibrator.judged(now.at_s, now.health, now.basis, now.margin)
    return EstimationResult(calibrator, now, proposed, notes, calibrator.estimate, gates, void)


# -- The calibration in use ------------------------------------------------------------------------


class Estimation:
    """The calibrator in use, its tasks, and whether it works.

    begin: has a task done, beside the core or at once
    """

    def __init__(
        self, settings: CalibratorSettings, begin: Callable[[EstimationTask], None]
    ) -> None:
        self._settings, self._begin = settings, begin
        self._compared: tuple[Affine, Array] = (Affine.identity(), np.zeros(3))
        self._queue = EstimationQueue()
        self.state = EstimatorState()
        self.calibrator = Calibrator(settings, *self._compared)
        self.proposed: Affine | None = None

    def begin_from_scratch(self) -> None:
        """Another device, or other registers than those that were taken out of the samples."""
        self.calibrator = Calibrator(self._settings, Affine.identity(), np.zeros(3))

    def begin_anew(self) -> None:
        """Other quantities: what follows cannot be mixed with what came before."""
        self.calibrator = self.calibrator.anew()
        self._compare()

    def compare_with(self, users: Mapping[int, Values]) -> None:
        """What a candidate must be better than: what these registers of the user do."""
        self._compared = user_compensation(users)
        self._compare()

    def adopt(self, limits: Mapping[str, Any]) -> CalibratorSettings:
        """Judge by these limits from now on; returns the settings with them."""
        self._settings = replace(self._settings, limits=GateLimits(**limits))
        self._begin(self._queue.adopt(self.calibrator, self._settings))
        return self._settings

    def examine(self, blocks: list[SampleBlock], when: Circumstances) -> None:
        """Let the calibrator take the blocks and judge."""
        self._begin(self._queue.examine(self.calibrator, blocks, when))

    def recall(self, blocks: list[SampleBlock], when: Circumstances) -> None:
        """A calibrator from scratch that takes the blocks of an earlier run first."""
        self.begin_from_scratch()
        self._compare()
        for block in blocks:
            self._begin(self._queue.recall(self.calibrator, block, when))

    def results(
        self, tasks: int, failure: str = ""
    ) -> Iterator[EstimationResult | EstimationFailure]:
        """Of the oldest tasks, those of the calibrator in use: another may have replaced it."""
        for found in self._queue.take(tasks, failure):
            if found.calibrator is self.calibrator:
                if isinstance(found, EstimationResult):
                    self.proposed = found.proposed
                yield found

    def broke_off(self, reason: str) -> float:
        """Drop the calibrator and what it proposed; returns for how long a new one rests."""
        self.state.broke_off(reason)
        self.calibrator = Calibrator(self._settings, *self._compared)
        self.proposed = None
        return self.state.left_s

    def _compare(self) -> None:
        self._begin(self._queue.compare(self.calibrator, *self._compared))
