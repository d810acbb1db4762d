"""A recording as arrays for evaluation: readings, the device's own values, and the vertical."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.signal import lfilter

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.errors import AhrsdError
from ahrsd.printable import counted
from ahrsd.samples import Array, SampleBlock

MINIMUM_SAMPLES = 20
_DEVICE = ("yaw", "pitch", "roll")


class EvaluationError(AhrsdError):
    """An evaluation that is not possible: one line that says what is missing or wrong, and what to
    do.
    """


@dataclass(frozen=True, slots=True, eq=False)
class EvaluationTrack:
    """N samples.

    time_s: (N,) ascending
    raw_b_gauss: (N, 3) as the sensor read it, without the correction of register 23
    before_b_gauss: (N, 3) with the device's present values; the identity if the registers are not
        known
    gyro_b_rad_s: (N, 3)
    accel_b_m_s2: (N, 3) specific force, nan if there is none
    starts: first row of each piece without a gap, beginning with 0
    covariates: further columns, (N,) each
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
        """One past the last row of each piece."""
        return (*self.starts[1:], len(self))

    def device_attitude(self) -> tuple[Array, Array, Array] | None:
        """Yaw, pitch, roll (N,) in rad by the device; None without."""
        for suffix, scale in (("_deg", np.pi / 180.0), ("_rad", 1.0)):
            for prefix in ("vn_", ""):
                names = [f"{prefix}{name}{suffix}" for name in _DEVICE]
                if all(name in self.covariates for name in names):
                    yaw, pitch, roll = (self.covariates[name] * scale for name in names)
                    return yaw, pitch, roll
        return None


def build_track(pieces: Sequence[tuple[SampleBlock, Affine]]) -> EvaluationTrack:
    """Blocks in order, each with the correction of its time. EvaluationError if there are too few
    samples.
    """
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


# -- Which way is up -------------------------------------------------------------------------------
#
# The vertical, in the sensor frame, at every sample.
#
# accelerometer: the specific force of the sample, as [R] 2.1; any acceleration tilts it. gravity:
# mean of the specific forces around the sample, rotated into its frame by the gyro and weighted by
# exp(-|dt| / 10 s), symmetrically before and after, so that a constant gyro bias cancels to first
# order. device: roll and pitch of the device.


Tilt = Literal["auto", "gravity", "accelerometer", "device"]
_MEMORY_S = 10.0


def up_directions(track: EvaluationTrack, tilt: Tilt) -> tuple[Array, str]:
    """(N, 3) vertical directions, of any length, and their source.

    auto: gravity, otherwise the device's. Raises EvaluationError if the recording does not have it.
    """
    if tilt == "auto":
        tilt = "gravity" if track.has_accel else "device"
    if tilt == "device":
        return _device_up(track), tilt
    if not track.has_accel:
        raise EvaluationError(f"--tilt {tilt}: not every sample has an acceleration; try device")
    return (_gravity_up(track) if tilt == "gravity" else track.accel_b_m_s2), tilt


def _device_up(track: EvaluationTrack) -> Array:
    """Up is -z_n: its sensor components by pitch and roll (3-2-1)."""
    attitude = track.device_attitude()
    if attitude is None:
        raise EvaluationError(
            "nothing says which way is up: neither accel_{x,y,z}_m_s2 nor vn_{yaw,pitch,roll}_deg"
        )
    _, pitch, roll = attitude
    return np.column_stack(
        [np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)]
    )


def _gravity_up(track: EvaluationTrack) -> Array:
    out = np.empty((len(track), 3))
    for a, b in zip(track.starts, track.ends(), strict=True):
        dt_s = np.diff(track.time_s[a:b], prepend=track.time_s[a])
        R_0b = so3.products(so3.exp(track.gyro_b_rad_s[a:b] * dt_s[:, None]))
        force_0 = np.einsum("kij,kj->ki", R_0b, track.accel_b_m_s2[a:b])
        step_s = float(np.median(dt_s[1:])) if b - a > 1 else 1.0
        out[a:b] = np.einsum("kji,kj->ki", R_0b, _two_sided_mean(force_0, step_s / _MEMORY_S))
    return out


def _two_sided_mean(values: Array, share: float) -> Array:
    """Exponential means (N, 3) over the past and the future, combined; the sample itself counts
    once.
    """
    keep = np.exp(-share)
    weight = lfilter([1.0], [1.0, -keep], np.ones(len(values)))
    past = lfilter([1.0], [1.0, -keep], values, axis=0)
    future = lfilter([1.0], [1.0, -keep], values[::-1], axis=0)[::-1]
    return np.asarray((past + future - values) / (weight + weight[::-1] - 1.0)[:, None])
