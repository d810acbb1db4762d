"""A gyro whose differences are the motion's, not its noise: a hand's, a road's, a propeller's.

Differences of a gyro's values are its noise where the motion is smooth.  Where something shakes
they may be fifty times that.  A filter that takes them for noise forgets the attitude within
seconds, and along the motion of `broad/01` two of three simulated sensors with nothing left out had
an unknown.  Readings that are as quiet as their own differences say decide: where nothing else is
wrong the likelihood of the innovations finds the noise, in turn with the calibration, which is poor
as long as there is too much of it.  Where something is wrong that counts as noise, and nothing is
found: differences are all there is.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np

from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.coarse import noise_of
from ahrsd.diagnosis.calibration_fit.null import fit_null, unusable
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array

_FEWEST = 25  # samples whose scatter is compared with that of others
_STEADY = 0.7  # of the usual level, what the quiet seconds of noise are at least
_TURNS = 4  # of noise and calibration, found one after the other
#: noise of the magnetometer over its differences beyond which something else is wrong, and of the
#: gyro below which its differences were the motion's
_WRONG, QUIETER = 1.5, 0.7


def quieter(
    recorded: Track, work: Track, spec: Spec, model: NullModel
) -> tuple[Spec, NullModel] | None:
    """The spec and the model with less noise of the gyro than its differences; None for no less.

    work: the recording at the working rate;  spec, model: of its rows, noise from differences
    """
    most_gauss = _WRONG * noise_of(work)[0]
    if spec.sigma_gyro_rad_s is not None or unusable(work) or not shaken(recorded):
        return None
    level = model.sigma_gyro_rad_s
    known = replace(spec, shaken_gyro_rad_s=level)
    for turn in range(_TURNS):
        again = noise_fit.estimated(run_filter(work, model, sensitive=False), known, walk=False)
        if noise_fit.alike(again, model):
            break
        if turn > 0 and again.sigma_mag_gauss > most_gauss:
            return None
        model = fit_null(work, known, again, noise=False).model
    found = model.sigma_gyro_rad_s < QUIETER * level
    return (known, model) if found else None


def carrying(track: Track, model: NullModel) -> NullModel:
    """The model by whose noise readings are averaged: a shaken gyro's is not known, and taken for
    none."""
    return replace(model, sigma_gyro_rad_s=0.0) if shaken(track) else model


def shaken(track: Track) -> bool:
    """Whether what the gyro's differences are is the motion's for the most part, not noise.

    Noise is as loud in one second as in the next, and what is smooth over seven samples is none.
    A hand and a road shake now more, now less: of twelve real recordings eleven have a tenth of
    their seconds below .67 of the usual level, of 120 simulated motions none below .76.
    """
    third, sixth = (_per_second(track, order) for order in (3, 6))
    if not len(third):
        return False
    return bool(np.quantile(sixth, 0.1) < _STEADY**2 * np.median(third))


def _per_second(track: Track, order: int) -> Array:
    """Variance of the gyro per second or 25 samples, were its differences of that order white."""
    found: list[Array] = []
    block = max(_FEWEST, round(1.0 / track.step_s))
    for run in track.runs or (slice(0, len(track)),):
        differences = np.diff(track.gyro_b_rad_s[run], order, axis=0)
        differences = differences[np.isfinite(differences).all(axis=1)]
        whole = len(differences) // block * block
        if whole:
            square = np.square(differences[:whole]).reshape(-1, block, 3)
            found.append(np.mean(square, axis=(1, 2)) / comb(2 * order, order))
    return np.concatenate(found) if found else np.zeros(0)
