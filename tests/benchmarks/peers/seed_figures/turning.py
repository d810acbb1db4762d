"""Experiments of any half-ranges of roll, pitch and heading, for sets that are not [R]'s three."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array
from ahrsd.simulation import MOTIONS, Experiment, Iron
from ahrsd.simulation.scenarios import SUBSTEPS, generator, mean_rate, measured

#: the theses' sensor with b = m_b, as Table 5.1 was made
SENSOR = Iron(offset_behind_iron=True)


@dataclass(frozen=True, slots=True)
class Turning:
    """Sinusoids in roll, pitch and heading of these half-ranges, in `motion` of the simulation."""

    name: str
    half_range_deg: tuple[float, float, float]
    motion: str
    samples: int
    rate_hz: float
    noise_mag_gauss: float
    noise_gyro_rad_s: float

    def angles(self, seed: int, time_s: Array) -> Array:
        """Roll, pitch and heading (N, 3) in rad; frequencies and phases are the seed's."""
        kind, ranges = MOTIONS[self.motion]
        rng = generator(seed, 0)
        half_range = np.radians(self.half_range_deg)
        drawn = np.array([rng.uniform(*limits) for limits in ranges])
        frequency = drawn if kind == "frequency_hz" else drawn / (2 * np.pi * half_range)
        phase = rng.uniform(0.0, 2 * np.pi, 3)
        return np.asarray(half_range * np.sin(2 * np.pi * frequency * time_s[:, None] + phase))

    def experiment(self, seed: int, iron: Iron = SENSOR) -> Experiment:
        """What the sensor of this iron reads."""
        count = (self.samples - 1) * SUBSTEPS + 1
        time_s = np.arange(count) / (SUBSTEPS * self.rate_hz)
        return sensed(self, iron, self.angles(seed, time_s), SUBSTEPS, seed)


def sensed(source: Turning, iron: Iron, angles_rad: Array, substeps: int, seed: int) -> Experiment:
    """Roll, pitch, heading at the sub-steps as samples of the source's rate and noise."""
    whole = (len(angles_rad) - 1) // substeps * substeps + 1
    roll, pitch, heading = angles_rad[:whole].T
    fine = so3.from_yaw_pitch_roll(heading, pitch, roll)
    rows = fine[::substeps]
    return measured(
        f"{source.name}, seed {seed}",
        iron,
        rows,
        mean_rate(fine, substeps, 1.0 / source.rate_hz),
        np.arange(1, len(rows) + 1) / source.rate_hz,
        (source.noise_mag_gauss, source.noise_gyro_rad_s),
        (generator(seed, 1), generator(seed, 2)),
    )
