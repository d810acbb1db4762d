"""The slow part of the core, as tasks that another thread may do.

The calibrator takes samples and judges; now and then that takes a good part of a second, in which
the port, the vehicle's word and an operator would wait. So the core makes a task of each
block and takes its result later: in a run another thread does the tasks in their order
(`estimation_worker`), and the input `Examined` says how many are done. A replay does them when it
comes to that input, and so takes the same decisions from the same results at the same place.

A calibrator belongs to its tasks: only they may change it.

`supervised` is the one place where whatever breaks off is caught: what the estimator cannot take
is a state with a reason (`core`), never an end. In a run `Examined` says which task broke off, so
that a replay takes the same decision.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.core.calibration_pipeline import Calibrator, CalibratorSettings
from ahrsd.events import Failure, GateResult, Noted
from ahrsd.evidence.values import BasisFacts, HealthFacts
from ahrsd.samples import Array, SampleBlock

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
