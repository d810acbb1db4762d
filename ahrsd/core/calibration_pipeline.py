"""Samples to a judged estimate: what is held out, what the estimator sees, what the gates say."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.estimator.model_checks import change_message
from ahrsd.estimator.online import Estimator
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.estimator.step_detector import Step, StepDetector
from ahrsd.events import GateResult, Noted
from ahrsd.evidence.collector import EvidenceCollector
from ahrsd.evidence.segments import Role
from ahrsd.evidence.values import BasisFacts, Evidence, HealthFacts
from ahrsd.gates import GateLimits, judge
from ahrsd.samples import Array, SampleBlock
from ahrsd.world_field import WorldField

_PATIENCE_S = 60.0  # after a step was told, for the estimator to see it and begin anew by itself


@dataclass(frozen=True, slots=True)
class CalibratorSettings:
    """What the calibration needs from the configuration."""

    estimator: EstimatorParameters
    limits: GateLimits
    world_field: WorldField | None = None
    held_out: bool = True


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
        """Whether the estimator began anew by itself since the last call."""
        at_s = self.estimator.restarted_s
        if estimate is not None and at_s is not None and at_s != self._heeded_s:
            self._heeded_s = at_s
            self._void = change_message(at_s)
            self._begin_anew([self._void])

    def _begin_anew(self, notes: list[str]) -> None:
        """The estimate forgot what was before a change: evidence from then proves nothing now."""
        self._notes += [(self._at_s, text) for text in notes]
        self.collector = EvidenceCollector()
        self.steps.restart()
        self.step_open = False

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


def _unknown_first_step(block: SampleBlock) -> SampleBlock:
    if not block.gap_before or np.isnan(block.dt_s[0]):
        return block
    dt_s = block.dt_s.copy()
    dt_s[0] = np.nan
    return replace(block, dt_s=dt_s)
