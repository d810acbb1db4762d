"""The trial: new registers against the old ones, on the same live samples."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from ahrsd.writeback.policy import TrialPolicy

JUMP_NOISE_DEG = 1.0  # of a heading read off single samples; below it no jump is unexpected


@dataclass(frozen=True, slots=True)
class TrialMetrics:
    """Figures over the trial so far, both corrections applied to the same raw samples.

    duration_s, turns: of use, on the device's clock
    new_figure, old_figure: the same figure of quality (heading or field error, smaller is better)
                       over the newest stretch with the new and with the old registers
    turned:            whether the vehicle turned in that stretch; at rest the figures are of noise,
                       which a soft iron makes larger along some axes than along others
    field_spread:      std/mean of the corrected field
    new_swing, old_swing: how far the corrected field moves when the corrected gyroscope carries it
                       into one frame, in parts of the field; `old`: the least with either or both
                       of the registers put back; 0 while nothing is known
    heading_jump_deg:  how far the heading moved when the registers changed; None: not seen yet
    wrong, old_wrong:  how much of the corrected field an error of the calibration still explains,
                       in parts of the field; nan while nothing is known
    wrong_sigmas:      by how many of its own sigmas that is beyond the limit; negative: within
    """

    duration_s: float
    turns: float
    new_figure: float
    old_figure: float
    field_spread: float
    turned: bool = True
    heading_jump_deg: float | None = None
    new_swing: float = 0.0
    old_swing: float = 0.0
    wrong: float = float("nan")
    old_wrong: float = float("nan")
    wrong_sigmas: float = float("nan")

    @property
    def finite(self) -> bool:
        """Whether anything can be said."""
        return bool(
            np.isfinite(
                [self.duration_s, self.turns, self.new_figure, self.old_figure, self.field_spread]
            ).all()
        )


class TrialVerdict(Enum):
    """What the metrics say."""

    GOES_ON = "goes on"
    PASSED = "passed"
    FAILED = "failed"


class Trial:
    """Judges a sequence of metrics; `predicted_jump_deg` comes from the proposal."""

    def __init__(self, policy: TrialPolicy, predicted_jump_deg: float) -> None:
        self._policy = policy
        self._predicted_deg = predicted_jump_deg
        self._worse_since_s: float | None = None

    @property
    def in_question(self) -> bool:
        """Whether the newest figures speak against the new registers."""
        return self._worse_since_s is not None

    def judge(self, metrics: TrialMetrics) -> tuple[TrialVerdict, str]:
        """The finding and its reason. Metrics that are not finite say nothing."""
        if not metrics.finite:
            return TrialVerdict.GOES_ON, "nothing to judge yet"
        if reason := self._failure(metrics):
            return TrialVerdict.FAILED, reason
        policy = self._policy
        if self._worse_since_s is not None:
            return TrialVerdict.GOES_ON, "worse than the old registers for the moment"
        # turns end a trial only once they have been judged
        turned = metrics.turns >= policy.turns and np.isfinite(metrics.wrong_sigmas)
        if metrics.duration_s >= policy.duration_s or turned:
            return TrialVerdict.PASSED, (
                f"the field varies by {metrics.new_figure:.2%}, with the old registers by "
                f"{metrics.old_figure:.2%} ({metrics.duration_s:.0f} s, {metrics.turns:.1f} turns)"
            )
        return TrialVerdict.GOES_ON, ""

    def _failure(self, metrics: TrialMetrics) -> str | None:
        policy = self._policy
        spread_percent = 100.0 * metrics.field_spread
        if spread_percent > policy.max_spread_percent:
            return (
                f"the corrected field varies by {spread_percent:.1f} %, "
                f"limit {policy.max_spread_percent} %"
            )
        if metrics.wrong_sigmas > policy.wrong_sigmas:
            return (
                f"an error of the calibration explains {metrics.wrong:.2%} of the corrected field "
                f"(with the old registers {metrics.old_wrong:.2%}), clearly more than "
                f"{policy.max_wrong_percent} %"
            )
        if (jump := metrics.heading_jump_deg) is not None and self._unexpected(jump):
            return f"the heading jumped by {jump:.1f} deg, predicted {self._predicted_deg:.1f} deg"
        worse = _worse(metrics, 1.0 + policy.worse_percent / 100.0)
        if worse is None:
            self._worse_since_s = None
            return None
        if self._worse_since_s is None:
            self._worse_since_s = metrics.duration_s
        if metrics.duration_s - self._worse_since_s >= policy.worse_for_s:
            return f"{worse}, for {policy.worse_for_s:.0f} s"
        return None

    def _unexpected(self, jump_deg: float) -> bool:
        """More than twice the prediction, or over it by the limit; a nan is unexpected too."""
        size = abs(jump_deg)
        likely = size <= 2.0 * self._predicted_deg + JUMP_NOISE_DEG
        return not (likely and size <= self._predicted_deg + self._policy.max_jump_deg)


def _worse(metrics: TrialMetrics, factor: float) -> str | None:
    """What is worse with the new registers than with the old ones, in words."""
    if metrics.turned and metrics.new_figure > metrics.old_figure * factor:
        return (
            f"the field varies by {metrics.new_figure:.2%}, with the old registers by "
            f"{metrics.old_figure:.2%}"
        )
    if metrics.new_swing > metrics.old_swing * factor:
        return (
            f"carried by the gyroscope the field moves by {metrics.new_swing:.2%}, with a register "
            f"put back by {metrics.old_swing:.2%}"
        )
    return None
