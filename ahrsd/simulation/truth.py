"""What a simulation hides, and the two conventions in which the theses give it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ahrsd.samples import Array


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
