"""An experiment: the samples that a sensor would have sent, and the truth behind every one.

What a simulation hides is given in the two conventions of the theses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array, SampleBlock


def _constant(*rows: object) -> Array:
    value = np.array(rows, dtype=np.float64)
    value.flags.writeable = False
    return value


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The hidden values in this project's convention, m = A h + b.

    soft_iron:       A (3, 3), symmetric, det A = 1
    hard_iron_gauss: b (3,), at the end of the experiment where it steps
    gyro_bias_rad_s: (3,)
    field_gauss:     |h|, the field's magnitude in the units that det A = 1 leaves
    noise_mag_gauss, noise_gyro_rad_s: standard deviations per sample and axis
    """

    soft_iron: Array
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array
    field_gauss: float
    noise_mag_gauss: float
    noise_gyro_rad_s: float

    @property
    def parameters(self) -> Array:
        """(12,) in the order of `Estimate.covariance`: A's upper triangle by rows, b, w_b."""
        triangle = self.soft_iron[np.triu_indices(3)]
        return np.concatenate([triangle, self.hard_iron_gauss, self.gyro_bias_rad_s])

    def json(self) -> dict[str, object]:
        """The values as calibration.json names them."""
        return {
            "soft_iron": self.soft_iron.tolist(),
            "hard_iron_gauss": self.hard_iron_gauss.tolist(),
            "gyro_bias_rad_s": self.gyro_bias_rad_s.tolist(),
            "field_gauss": self.field_gauss,
            "noise_mag_gauss": self.noise_mag_gauss,
            "noise_gyro_rad_s": self.noise_gyro_rad_s,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Iron:
    """The theses' description of a sensor: A of any volume and the pseudo hard iron m_b.

    [R] (3.1) writes m = A (m_t + m_b), so b = A m_b (the default). The figures of its Table 5.1
    were made with m = A m_t + m_b whatever (3.1) says: `offset_behind_iron` gives b = m_b.
    Defaults: [R]'s sensor, mG and mrad/s divided by 1000.
    """

    soft_iron: Array = field(
        default_factory=lambda: _constant(
            (1.10, 0.10, 0.04), (0.10, 0.88, 0.02), (0.04, 0.02, 1.22)
        )
    )
    pseudo_hard_iron_gauss: Array = field(default_factory=lambda: _constant(0.020, 0.120, 0.090))
    gyro_bias_rad_s: Array = field(default_factory=lambda: _constant(4e-3, -5e-3, 2e-3))
    field_n_gauss: Array = field(default_factory=lambda: _constant(0.227, 0.052, 0.412))
    offset_behind_iron: bool = False

    @property
    def hard_iron_gauss(self) -> Array:
        """b (3,) of m = A h + b."""
        if self.offset_behind_iron:
            return self.pseudo_hard_iron_gauss
        return np.asarray(self.soft_iron @ self.pseudo_hard_iron_gauss)

    def scaled(self, scale: float) -> Iron:
        """The same sensor with `scale` times the hard iron ([L]'s range of biases)."""
        return replace(self, pseudo_hard_iron_gauss=scale * self.pseudo_hard_iron_gauss)

    def truth(self, noise_mag_gauss: float, noise_gyro_rad_s: float) -> Truth:
        """The same sensor with det A = 1: the field's magnitude takes the volume."""
        volume = float(np.cbrt(np.linalg.det(self.soft_iron)))
        return Truth(
            soft_iron=self.soft_iron / volume,
            hard_iron_gauss=self.hard_iron_gauss,
            gyro_bias_rad_s=self.gyro_bias_rad_s,
            field_gauss=float(np.linalg.norm(self.field_n_gauss)) * volume,
            noise_mag_gauss=noise_mag_gauss,
            noise_gyro_rad_s=noise_gyro_rad_s,
        )


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
        dt_s = self.samples.dt_s.copy()
        dt_s[new] = np.nan
        dt_s[index[:1]] = np.nan
        kept = replace(self.samples, dt_s=dt_s).part(index, gap_before=True)
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
                yield self.samples.part(slice(at, min(at + rows, end)), gap_before=at == start)


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
