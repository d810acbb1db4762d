"""A calibrator that is cheap and honest: a sphere through the samples it was given, and rest.

It stands in for the estimator in histories by the hundred thousand: right for sensors without soft
iron, from nothing but the raw samples, and it notices iron that steps. All gates are green but
while a step is open. So what reaches the write-back is judged as in a run, and what was mixed from
two units or from two irons shows as a step or as a bad fit.
"""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.core.estimation import Calibrator
from ahrsd.estimator.step_detector import Step
from ahrsd.events import GateResult
from ahrsd.gates import GATES
from ahrsd.samples import Array, SampleBlock

EVERY_S = 1.0
LEAST_SAMPLES, LEAST_AXIS_GAUSS = 24, 0.12
STEP_GAUSS, MISFIT_GAUSS, STILL_GAUSS, STILL_RAD_S = 0.008, 0.0015, 0.005, 0.003
APART_GAUSS = 0.006  # at most, with and without the first second: iron that moved early on


class FittingCalibrator(Calibrator):
    """See the module. One of it costs some ten microseconds a block."""

    def __init__(self, settings: object, present: Affine, present_gyro_bias_rad_s: Array) -> None:
        super().__init__(settings, present, present_gyro_bias_rad_s)  # type: ignore[arg-type]
        self._void = ""  # told once, where the core asks for it
        self._reset()

    def _reset(self) -> None:
        self._normal, self._right, self._square = np.zeros((4, 4)), np.zeros(4), 0.0
        self._count = self._resting = 0
        self._since: list[tuple[float, Array, Array, int]] = []  # the sums before each second
        self._rest_sum = np.zeros(3)
        self._last_s = float("-inf")
        self.estimate = None

    def make_fresh(self) -> Calibrator:
        return FittingCalibrator(self.settings, self.present, self.present_gyro_bias_rad_s)

    def compare_with(self, present: Affine, present_gyro_bias_rad_s: Array) -> None:
        self.present, self.present_gyro_bias_rad_s = present, present_gyro_bias_rad_s

    def finish(self) -> Estimate | None:
        return self.estimate

    def take(self, block: SampleBlock) -> bool:
        self.started, at_s = True, float(block.time_s[-1])
        self._at_s = at_s
        if self.estimate is not None and not self.step_open and self._stepped(block):
            return True
        if self.step_open:  # told: now from the samples behind it
            self._reset()
            self.step_open = False
            self._notes.append((at_s, f"calibrated anew from {at_s:.0f} s"))
        self._add(block)
        if 0.0 <= at_s - self._last_s < EVERY_S:
            return False
        self._last_s = at_s
        found = self._fit(at_s)
        if found is None:
            return False
        self.estimate = found
        return True

    def _stepped(self, block: SampleBlock) -> bool:
        assert self.estimate is not None
        found = self.estimate
        away = np.linalg.norm(block.raw_b_gauss - found.hard_iron_gauss, axis=1) - found.field_gauss
        if abs(float(np.mean(away))) < STEP_GAUSS:
            return False
        at_s = float(block.time_s[-1])
        size = np.full(3, float(np.mean(away)))
        self.step = Step("hard iron", at_s, at_s, size, np.full(3, 1e-3), 1)
        self.step_open = True
        self._void = self.step.words
        self._notes.append((at_s, self._void))
        return True

    def _add(self, block: SampleBlock) -> None:
        raw, at_s = block.raw_b_gauss, float(block.time_s[0])
        if not self._since or not 0.0 <= at_s - self._since[-1][0] < EVERY_S:
            self._since.append((at_s, self._normal.copy(), self._right.copy(), self._count))
        row = np.column_stack([2.0 * raw, np.ones(len(raw))])
        length = np.sum(raw * raw, axis=1)
        self._normal += row.T @ row
        self._right += row.T @ length
        self._square += float(length @ length)
        self._count += len(raw)
        gyro = block.gyro_b_rad_s
        still = float(np.ptp(raw, axis=0).max()) < STILL_GAUSS
        if len(raw) > 2 and still and float(np.ptp(gyro, axis=0).max()) < STILL_RAD_S:
            self._rest_sum += gyro.sum(axis=0)
            self._resting += len(raw)

    def _fit(self, at_s: float) -> Estimate | None:
        if self._count < LEAST_SAMPLES or self._resting < 6:
            return None
        solution = _solved(self._normal, self._right, self._count)
        if solution is None:
            return None
        hard = solution[:3]
        field_gauss = float(np.sqrt(max(solution[3] + hard @ hard, 1e-9)))
        left = max(self._square - float(solution @ self._right), 0.0) / self._count
        if np.sqrt(left) / (2.0 * field_gauss) > MISFIT_GAUSS:
            self._reset()
            self._void = "the samples fit no sphere: begun anew"
            self._notes.append((at_s, self._void))
            return None
        for _, normal, right, count in self._since[1:2]:
            newer = _solved(self._normal - normal, self._right - right, self._count - count)
            if newer is None or np.linalg.norm(newer[:3] - hard) > APART_GAUSS:
                return None
        return Estimate(
            soft_iron=np.eye(3),
            hard_iron_gauss=hard,
            gyro_bias_rad_s=self._rest_sum / self._resting,
            field_gauss=field_gauss,
            field_known=False,
            covariance=np.eye(12) * 1e-7,
            noise_mag_gauss=1e-3,
            noise_gyro_rad_s=4e-4,
            misfit=1.0,
            heading_sigma_deg=0.1,
            observability=Observability(np.full(12, 0.01), (), 10.0),
            samples=self._count,
            duration_s=60.0,
            converged=True,
        )

    def judge_estimate(self, at_s: float, *_: object) -> tuple[GateResult, ...]:
        ok = not self.step_open
        self.gates = tuple(
            GateResult(g.gate, 1.0, 1.0, ok, at_s, "", "the iron stepped") for g in GATES
        )
        return self.gates


def _solved(normal: Array, right: Array, count: int) -> Array | None:
    """The sphere, None where the samples do not reach far enough to tell one."""
    mean = normal[:3, 3] / (2.0 * count)
    spread = normal[:3, :3] / (4.0 * count) - np.outer(mean, mean)
    if np.linalg.eigvalsh(spread)[0] < LEAST_AXIS_GAUSS**2:
        return None
    return np.linalg.solve(normal, right)
