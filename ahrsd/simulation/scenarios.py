"""The experiments of [R] chapter 5: WAM, MAM, LAM, in "slow" and in "rov" motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ahrsd.simulation import motion
from ahrsd.simulation.disturbance import Disturbances, disturbed
from ahrsd.simulation.experiment import Experiment, measured
from ahrsd.simulation.truth import Iron, Truth


@dataclass(frozen=True, slots=True)
class ScenarioSettings:
    """One experiment. The same settings give the same samples, bit by bit, on one machine.

    scenario: "wam", "mam" or "lam"; motion: "slow" or "rov"
    seed:     chooses frequencies and phases, and, each from a generator of its own, the noises: a
              sweep over noise or bias keeps the trajectory
    """

    scenario: str = "wam"
    motion: str = "slow"
    seed: int = 0
    samples: int = 10_000
    rate_hz: float = 25.0
    noise_mag_gauss: float = 1e-3
    noise_gyro_rad_s: float = 5e-3
    iron: Iron = field(default_factory=Iron)
    disturbances: Disturbances = field(default_factory=Disturbances)

    def __post_init__(self) -> None:
        """Raises ValueError naming the setting that cannot be."""
        for name, known in (("scenario", motion.SCENARIOS), ("motion", motion.MOTIONS)):
            value = getattr(self, name)
            if value not in known:
                raise ValueError(f"no {name} {value!r}; there are {', '.join(known)}")
        if self.samples < 2:
            raise ValueError(f"samples is {self.samples}: at least 2")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}: it must not be negative")
        for name in ("rate_hz", "noise_mag_gauss", "noise_gyro_rad_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0 and (value > 0 or name != "rate_hz")):
                raise ValueError(f"{name} is {value}: it must be a positive number")

    @property
    def truth(self) -> Truth:
        """What is hidden, before any disturbance."""
        return self.iron.truth(self.noise_mag_gauss, self.noise_gyro_rad_s)


def generator(seed: int, purpose: int) -> np.random.Generator:
    """A generator of its own for each purpose (0 motion, 1 field, 2 gyro, 3 disturbances)."""
    return np.random.default_rng([seed, purpose])


def simulate(settings: ScenarioSettings) -> Experiment:
    """Make the experiment."""
    s = settings
    fine = motion.sinusoids(s.scenario, s.motion, generator(s.seed, 0), s.samples, s.rate_hz)
    made = measured(
        f"{s.scenario} {s.motion}, seed {s.seed}",
        s.iron,
        fine[:: motion.SUBSTEPS],
        motion.mean_rate(fine, motion.SUBSTEPS, 1.0 / s.rate_hz),
        np.arange(1, s.samples + 1) / s.rate_hz,
        (s.noise_mag_gauss, s.noise_gyro_rad_s),
        (generator(s.seed, 1), generator(s.seed, 2)),
    )
    return disturbed(made, s.disturbances, generator(s.seed, 3))
