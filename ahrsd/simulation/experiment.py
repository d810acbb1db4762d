"""An experiment: the samples that a sensor would have sent, and the truth behind every one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array, SampleBlock
from ahrsd.simulation.truth import Iron, Truth

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """N samples with their truth.

    name:         says what it is, for people
    samples:      what the sensor sent; `dt_s` is nan in the first row and behind each gap
    R_nb:         (N, 3, 3) attitude
    field_b:      (N, 3) true field in gauss in the units of det A = 1, so |field_b| is constant
    rate_b_rad_s: (N, 3) true mean rate over the step that ends at the sample
    """

    name: str
    samples: SampleBlock
    truth: Truth
    R_nb: Array
    field_b: Array
    rate_b_rad_s: Array

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def starts(self) -> list[int]:
        """Row 0 and every row behind a gap."""
        return [0, *(np.flatnonzero(np.isnan(self.samples.dt_s[1:])) + 1).tolist()]

    def first(self, count: int) -> Experiment:
        """The first `count` samples."""
        return self.taken(np.arange(len(self)) < count)

    def taken(self, rows: NDArray[np.bool]) -> Experiment:
        """The rows for which `rows` (N,) bool is true; steps over left-out rows become unknown."""
        index = np.flatnonzero(rows)
        new = index[np.flatnonzero(np.diff(index) > 1) + 1]
        s = self.samples
        dt_s = s.dt_s.copy()
        dt_s[new] = np.nan
        dt_s[index[:1]] = np.nan
        kept = SampleBlock(
            time_s=s.time_s[index],
            dt_s=dt_s[index],
            host_s=s.host_s[index],
            raw_b_gauss=s.raw_b_gauss[index],
            gyro_b_rad_s=s.gyro_b_rad_s[index],
            accel_b_m_s2=s.accel_b_m_s2[index],
            gap_before=True,
        )
        return Experiment(
            self.name,
            kept,
            self.truth,
            self.R_nb[index],
            self.field_b[index],
            self.rate_b_rad_s[index],
        )

    def blocks(self, rows: int) -> Iterator[SampleBlock]:
        """Blocks of at most `rows` rows, none of which spans a gap."""
        starts = self.starts
        for start, end in zip(starts, [*starts[1:], len(self)], strict=True):
            for at in range(start, end, rows):
                yield _cut(self.samples, slice(at, min(at + rows, end)), at == start)


def _cut(s: SampleBlock, rows: slice, gap_before: bool) -> SampleBlock:
    return SampleBlock(
        time_s=s.time_s[rows],
        dt_s=s.dt_s[rows],
        host_s=s.host_s[rows],
        raw_b_gauss=s.raw_b_gauss[rows],
        gyro_b_rad_s=s.gyro_b_rad_s[rows],
        accel_b_m_s2=s.accel_b_m_s2[rows],
        gap_before=gap_before,
    )


def measured(
    name: str,
    iron: Iron,
    R_nb: Array,
    rate_b_rad_s: Array,
    time_s: Array,
    noise: tuple[float, float],
    rng: tuple[np.random.Generator, np.random.Generator],
) -> Experiment:
    """What the sensor reads on a trajectory: m = A h + b + noise, w + w_b + noise, gravity.

    R_nb (N, 3, 3), rate_b_rad_s (N, 3), row 0 nan (before the first sample nothing is known; its
    reading repeats the next one); noise and rng: of the magnetometer (gauss), the gyro (rad/s).
    """
    truth = iron.truth(*noise)
    size = float(np.linalg.norm(iron.field_n_gauss))
    field_b = np.einsum("nji,j->ni", R_nb, iron.field_n_gauss * (truth.field_gauss / size))
    count = len(R_nb)
    raw = field_b @ truth.soft_iron.T + truth.hard_iron_gauss
    raw += noise[0] * rng[0].standard_normal((count, 3))
    rate = rate_b_rad_s.copy()
    rate[0] = rate[1]
    gyro = rate + truth.gyro_bias_rad_s + noise[1] * rng[1].standard_normal((count, 3))
    block = SampleBlock(
        time_s=time_s,
        dt_s=np.concatenate([[np.nan], np.diff(time_s)]),
        host_s=time_s,
        raw_b_gauss=raw,
        gyro_b_rad_s=gyro,
        accel_b_m_s2=R_nb[:, 2, :] * -GRAVITY_M_S2,
        gap_before=True,
    )
    return Experiment(name, block, truth, R_nb, field_b, rate)
