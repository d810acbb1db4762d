"""A recording as arrays for judging: what the sensor read, and what the device made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.counting import counted
from ahrsd.errors import AhrsdError
from ahrsd.samples import Array, SampleBlock

MINIMUM_SAMPLES = 20
_DEVICE = ("yaw", "pitch", "roll")


class EvaluationError(AhrsdError):
    """What cannot be judged: one line that says what is missing or wrong, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class EvaluationTrack:
    """N samples.

    time_s:         (N,) ascending
    raw_b_gauss:    (N, 3) as the sensor read it, register 23 undone
    before_b_gauss: (N, 3) with the device's present values; those are the identity where the
                    registers are not known
    gyro_b_rad_s:   (N, 3)
    accel_b_m_s2:   (N, 3) specific force, nan where there is none
    starts:         first row of each stretch without a gap, beginning with 0
    covariates:     further columns, (N,) each
    """

    time_s: Array
    raw_b_gauss: Array
    before_b_gauss: Array
    gyro_b_rad_s: Array
    accel_b_m_s2: Array
    starts: tuple[int, ...] = (0,)
    covariates: dict[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def has_accel(self) -> bool:
        """Whether every sample has a specific force."""
        return bool(np.isfinite(self.accel_b_m_s2).all())

    def ends(self) -> tuple[int, ...]:
        """The row behind the last one of each stretch."""
        return (*self.starts[1:], len(self))

    def device_attitude(self) -> tuple[Array, Array, Array] | None:
        """Yaw, pitch, roll (N,) in rad as the device says them; None without."""
        for suffix, scale in (("_deg", np.pi / 180.0), ("_rad", 1.0)):
            for prefix in ("vn_", ""):
                names = [f"{prefix}{name}{suffix}" for name in _DEVICE]
                if all(name in self.covariates for name in names):
                    yaw, pitch, roll = (self.covariates[name] * scale for name in names)
                    return yaw, pitch, roll
        return None


def tracked(pieces: Sequence[tuple[SampleBlock, Affine]]) -> EvaluationTrack:
    """Blocks in order, each with the correction of its time.  EvaluationError if too few."""
    kept = [(block, present) for block, present in pieces if len(block)]
    blocks = [block for block, _ in kept]
    if (count := sum(map(len, blocks))) < MINIMUM_SAMPLES:
        raise EvaluationError(
            f"{counted(count, 'sample')}, {MINIMUM_SAMPLES} are needed: record longer"
        )
    time_s = np.concatenate([block.time_s for block in blocks])
    if not np.all(np.diff(time_s) > 0):
        raise EvaluationError("the time of the recording goes backwards: split it at that place")
    begins = np.cumsum([0, *(len(block) for block in blocks[:-1])])
    starts = {int(k) for k, block in zip(begins, blocks, strict=True) if block.gap_before}
    shared = set.intersection(*(set(block.covariates) for block in blocks))
    return EvaluationTrack(
        time_s=time_s,
        raw_b_gauss=np.vstack([block.raw_b_gauss for block in blocks]),
        before_b_gauss=np.vstack([present.apply(block.raw_b_gauss) for block, present in kept]),
        gyro_b_rad_s=np.vstack([block.gyro_b_rad_s for block in blocks]),
        accel_b_m_s2=np.vstack([block.accel_b_m_s2 for block in blocks]),
        starts=tuple(sorted({0, *starts})),
        covariates={
            name: np.concatenate([block.covariates[name] for block in blocks])
            for name in sorted(shared)
        },
    )
