"""Samples of an earlier run: whether this run may use them, and when it confirms them.

The capture of a run that was killed holds the manoeuvre that was driven. Its samples come as inputs
(`EarlierSamples`, then `EarlierRun`), so that a replay decides the same. They are used only if they
are of the same device (model, serial number and firmware as both runs read them), were taken with
the registers that it holds now, have the same quantities as the stream of this run, and are not
older than the limit. Their age is measured by the time since the host's boot, within one boot; the
wall clock can only refuse them.

They are given to the estimator and the evidence, but no verdict rests on them alone. Nothing is
proposed until samples of this run cover enough turning and agree with the estimate (`CONFIRM_S`,
`CONFIRM_TURN_DEG`): a magnet mounted between the runs does not show at rest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.inputs import EarlierRun, EarlierSamples, WallClock
from ahrsd.printable import counted
from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.journal_history import Stamp, age_by_boottime_s, plausible
from drivers.vn100.registers import COMPENSATING, Unit, Values, same

CONFIRM_S = 60.0  # samples of this run before a candidate
CONFIRM_TURN_DEG = 90.0  # turning in them
AGREES = 0.05  # largest relative error of the corrected field's magnitude, mean over blocks
MOST_ROWS = 72_000  # of earlier samples that are kept until they are used
_MOST_LIVE_BLOCKS = 2400  # blocks of this run
OFF = "off: estimator.warm_start_s is 0"
PASSIVE = (
    "off: mode passive does not ask which device it is, so it is not known whose samples they are"
)


def too_old(then: Stamp, now: Stamp, limit_s: float) -> str:
    """Why samples of `then` are too old; empty if they may be used."""
    if not then.boot_id or not now.boot_id or then.boot_s is None or now.boot_s is None:
        return "their age is not known: the computer does not say when it was started"
    if then.boot_id != now.boot_id:
        return "they are from before the computer was started: their age is not known"
    age_s = age_by_boottime_s(then, now)
    if age_s is None:
        return "their time stamps are in the future"
    if age_s > limit_s:
        return f"they are {age_s / 60:.0f} min old, more than {limit_s / 60:.0f} min"
    if plausible(then.wall_s) and plausible(now.wall_s):
        wall_s = (now.wall_s or 0.0) - (then.wall_s or 0.0)
        if wall_s > limit_s:
            return f"they are {wall_s / 60:.0f} min old by the wall clock"
    return ""


@dataclass(frozen=True, slots=True)
class Present:
    """The state of this run.

    unit: None if the device is not identified
    compensated: of the stream, as in `EarlierRun`
    open: whether a write is under way or on trial
    """

    unit: Unit | None
    registers: Mapping[int, Values]
    compensated: tuple[bool, ...]
    at_s: float
    host_s: float
    open: bool = False
    candidate: bool = False
    terms: bool = False


class WarmStart:
    """See the module. Pure; times are arguments."""

    def __init__(self, limit_s: float, *, passive: bool = False) -> None:
        self.limit_s = limit_s
        self.off = PASSIVE if passive else OFF if limit_s <= 0.0 else ""
        self.refused = self.off
        self._blocks: list[SampleBlock] = []
        self._rows = 0
        self._run: EarlierRun | None = None
        self._clock: WallClock | None = None
        self._used = self._ended = ""
        self._confirmed = False
        self._waits_for = ""
        self._live: deque[tuple[Array, Array, float]] = deque(maxlen=_MOST_LIVE_BLOCKS)
        self._disagrees = ""

    # -- inputs ------------------------------------------------------------------------------------

    def set_clock(self, item: WallClock) -> None:
        """Store the host's clocks."""
        self._clock = item

    def add_samples(self, item: EarlierSamples) -> None:
        """Take samples of an earlier run, oldest first."""
        if not self.refused and self._run is None and self._rows < MOST_ROWS:
            self._blocks.append(item.block)
            self._rows += len(item.block)

    def on_samples_complete(self, item: EarlierRun) -> str:
        """All samples have come; returns a sentence for the log if they are not used."""
        if self.refused or self._run is not None:
            return ""
        self._run = item
        if item.why or not self._blocks:
            return self._refuse(item.why or "there are no samples")
        return ""

    # -- for the core ------------------------------------------------------------------------------

    @property
    def pending(self) -> bool:
        """Whether there are samples that may still be used."""
        return self._run is not None and not self.refused and not self._used

    def take_due(self, present: Present, first_s: float) -> tuple[list[SampleBlock], str]:
        """Blocks for the calibrator before the block that begins at `first_s`; text for the log."""
        run = self._run
        if run is None or not self.pending or present.unit is None:
            return [], ""
        if reason := self._find_refusal(run, present):
            return [], self._refuse(reason)
        if run.compensated != present.compensated:
            self._waits_for = "the stream of this run does not give the same quantities"
            return [], ""
        self._waits_for = ""
        age_s = (self._stamp_at(present.host_s).boot_s or 0.0) - (run.boot_s or 0.0)
        minutes = f"{age_s / 60:.1f}"
        self._used = f"{counted(self._rows, 'sample')} up to {minutes} min old, from {run.source}"
        newest_s = float(self._blocks[-1].time_s[-1])
        shift_s = 0.0 if newest_s < first_s else first_s - age_s - newest_s - 1.0
        return [replace(b, time_s=b.time_s + shift_s) for b in self._blocks], (
            f"warm start: {self._used}; {self.holds}"
        )

    def _find_refusal(self, run: EarlierRun, present: Present) -> str:
        unit, then = present.unit, Unit(run.model, run.serial, run.firmware)
        if unit != then:
            return f"they are of another device: {then}"
        changed = [
            n
            for n in COMPENSATING
            if (n in run.registers) is not (n in present.registers)
            or (n in run.registers and not same(n, run.registers[n], present.registers[n]))
        ]
        if changed:
            return f"register {', '.join(map(str, changed))} held other values then"
        if reason := too_old(
            Stamp(run.wall_s, run.boot_id, run.boot_s), self._stamp_at(present.host_s), self.limit_s
        ):
            return reason
        if present.open:
            return "a write is under way or on trial: this run alone judges it"
        if present.terms:
            return "terms.model is set, and the columns that it needs are not known for that time"
        return "this run has a candidate of its own already" if present.candidate else ""

    def _stamp_at(self, host_s: float) -> Stamp:
        clock = self._clock
        if clock is None or clock.boot_s is None:
            return Stamp()
        since_s = host_s - clock.host_ns * 1e-9
        return Stamp(clock.wall_s + since_s, clock.boot_id, clock.boot_s + since_s)

    def _refuse(self, reason: str) -> str:
        self.refused = reason
        self._blocks = []
        return f"no warm start: {reason}"

    def reuse(self) -> None:
        """The calibrator restarted with other quantities: the samples may fit these."""
        if self._used and not self._confirmed and not self._ended:
            self._used = ""
            self.restart_confirmation()

    def end(self, reason: str) -> None:
        """The calibrator restarted without these samples."""
        if self._used and not self._ended:
            self._ended, self._blocks = reason, []
        elif self.pending:
            self._refuse(reason)

    # -- samples of this run -----------------------------------------------------------------------

    def restart_confirmation(self) -> None:
        """Samples of this run so far are from before a jump, or may be of another device."""
        self._live.clear()
        self._disagrees = ""

    def add_live_samples(self, block: SampleBlock) -> None:
        """Take samples of this run that the calibrator gets."""
        if self._used and not self._confirmed and not self._ended:
            dt_s = np.nan_to_num(block.dt_s)
            angle = (block.gyro_b_rad_s * dt_s[:, None]).sum(axis=0)
            self._live.append((block.raw_b_gauss.mean(axis=0), angle, float(dt_s.sum())))

    def confirms(self, estimate: Estimate) -> bool:
        """Whether a verdict may be used: no warm start, or this run agrees with the estimate."""
        if not self._used or self._ended or self._confirmed:
            return True
        if not self._has_enough_motion(estimate.gyro_bias_rad_s):
            return False
        field = np.array([raw for raw, _, _ in self._live])
        size = np.linalg.norm(estimate.correction.apply(field), axis=1)
        error = float(np.mean(np.abs(size / estimate.field_gauss - 1.0)))
        if not error <= AGREES:
            self._disagrees = f"its corrected field is {100 * error:.0f} % off"
            return False
        self._confirmed, self._blocks, self._disagrees = True, [], ""
        return True

    def _has_enough_motion(self, bias_b_rad_s: Array) -> bool:
        covered_s = self._covered_s
        turned = sum(float(np.linalg.norm(a - s * bias_b_rad_s)) for _, a, s in self._live)
        return covered_s >= CONFIRM_S and np.degrees(turned) >= CONFIRM_TURN_DEG

    @property
    def _covered_s(self) -> float:
        return sum(seconds for _, _, seconds in self._live)

    # -- texts -------------------------------------------------------------------------------------

    @property
    def holds(self) -> str:
        """Why no candidate is proposed yet; empty if the warm start is not the reason."""
        if not self._used or self._ended or self._confirmed:
            return ""
        if self._disagrees:
            return f"no candidate: this run does not agree: {self._disagrees}"
        return (
            f"no candidate before {CONFIRM_S:.0f} s and {CONFIRM_TURN_DEG:.0f} deg of turning of "
            f"this run agree (so far {self._covered_s:.0f} s)"
        )

    @property
    def text(self) -> str:
        """Status, for `status` and `explain`."""
        if self.off:
            return self.off
        if self.refused:
            return f"not used: {self.refused}"
        if self._ended:
            return f"over: {self._ended}"
        if self._used:
            return f"{self._used}; {self.holds or 'this run agrees'}"
        if self._run is None:
            return "no earlier capture was read yet"
        return f"waits: {self._waits_for or 'the device is being read'}"
