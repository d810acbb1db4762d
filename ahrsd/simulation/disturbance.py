"""What goes wrong on real streams, kept simple: outliers, a magnet passing by, a step, a gap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ahrsd.samples import Array
from ahrsd.simulation.experiment import Experiment

_STEP_AXIS = np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)
_MAGNET_AXIS = np.array([0.6, 0.0, 0.8])


@dataclass(frozen=True, slots=True)
class Disturbances:
    """None of them by default. Times are seconds after the first sample.

    outlier_fraction: of the samples, each off by `outlier_gauss` in a random direction
    magnet_at_s:      a magnet passes: a bump of `magnet_gauss`, `magnet_length_s` long (raised
                      cosine), along a fixed axis of the sensor
    step_at_s:        the hard iron steps by `step_gauss` and stays; `Truth` has the last value
    gap_at_s:         no samples for `gap_length_s`
    """

    outlier_fraction: float = 0.0
    outlier_gauss: float = 0.1
    magnet_at_s: float | None = None
    magnet_length_s: float = 10.0
    magnet_gauss: float = 0.1
    step_at_s: float | None = None
    step_gauss: float = 0.03
    gap_at_s: float | None = None
    gap_length_s: float = 2.0

    def __post_init__(self) -> None:
        """Raises ValueError where the fraction of outliers is no fraction."""
        if not 0.0 <= self.outlier_fraction <= 1.0:
            raise ValueError(f"outlier_fraction is {self.outlier_fraction}: it must be in 0..1")


def disturbed(experiment: Experiment, wanted: Disturbances, rng: np.random.Generator) -> Experiment:
    """The experiment with what is wanted added; the very same object where nothing is."""
    if wanted == Disturbances():
        return experiment
    time_s = experiment.samples.time_s - experiment.samples.time_s[0]
    raw = experiment.samples.raw_b_gauss.copy()
    truth = experiment.truth
    if wanted.outlier_fraction > 0:
        raw += _outliers(len(raw), wanted, rng)
    if wanted.magnet_at_s is not None:
        phase = np.clip((time_s - wanted.magnet_at_s) / wanted.magnet_length_s, 0.0, 1.0)
        bump = wanted.magnet_gauss * (1 - np.cos(2 * np.pi * phase)) / 2
        raw += bump[:, None] * _MAGNET_AXIS
    if wanted.step_at_s is not None:
        step = wanted.step_gauss * _STEP_AXIS
        raw[time_s >= wanted.step_at_s] += step
        truth = replace(truth, hard_iron_gauss=truth.hard_iron_gauss + step)
    samples = replace(experiment.samples, raw_b_gauss=raw)
    changed = replace(experiment, samples=samples, truth=truth)
    if wanted.gap_at_s is None:
        return changed
    inside = (time_s > wanted.gap_at_s) & (time_s < wanted.gap_at_s + wanted.gap_length_s)
    return changed.taken(~inside)


def _outliers(count: int, wanted: Disturbances, rng: np.random.Generator) -> Array:
    hit = rng.random(count) < wanted.outlier_fraction
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(wanted.outlier_gauss * hit[:, None] * direction)
