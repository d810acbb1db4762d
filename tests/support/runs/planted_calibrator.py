"""A calibrator that always says the same, as a bad fit does that has passed the gates."""

from __future__ import annotations

from ahrsd.calibration import Affine, Estimate
from ahrsd.core.estimation import Calibrator
from ahrsd.events import GateResult
from ahrsd.gates import GATES
from ahrsd.samples import Array, SampleBlock

EVERY_S = 1.0


class PlantedCalibrator(Calibrator):
    """Estimates nothing: after `every_s` of samples it gives `planted`, and every gate is green."""

    def __init__(self, real: Calibrator, planted: Estimate) -> None:
        super().__init__(real.settings, real.present, real.present_gyro_bias_rad_s)
        self._planted = planted
        self._last_s = float("-inf")

    def make_fresh(self) -> Calibrator:
        return PlantedCalibrator(self, self._planted)

    def compare_with(self, present: Affine, present_gyro_bias_rad_s: Array) -> None:
        self.present, self.present_gyro_bias_rad_s = present, present_gyro_bias_rad_s

    def take(self, block: SampleBlock) -> bool:
        now_s = float(block.time_s[-1])
        new = not 0.0 <= now_s - self._last_s < EVERY_S
        if new:
            self._last_s, self.estimate = now_s, self._planted
        return new

    def judge_estimate(self, at_s: float, *_: object) -> tuple[GateResult, ...]:
        self.gates = tuple(GateResult(g.gate, 1.0, 1.0, True, at_s, "", "") for g in GATES)
        return self.gates
