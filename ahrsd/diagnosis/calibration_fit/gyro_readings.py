"""What a gyro's readings are: mean rates or delta angles, and how much of them is noise.

Where they are means of the rate the turn of a step is not the mean times the step.  The axis of a
turn moves within a step (coning): to second order the rotation vector of step k is
w_k dt + (w_(k-1) dt) x (w_k dt) / 12 with w the mean rates, and w_k dt for a gyro whose values are
its delta angles over dt.  Both are the mean rate to a person, devices send either, and neither is
physics left out: the recording itself says which it is, by the part f of that product in it.

Differences of a gyro's values are its noise where the motion is smooth.  Where a hand, a road, a
propeller shakes the sensor they are the motion's, and may be fifty times that.  A filter that takes
them for noise forgets the attitude within seconds, and along the motion of `broad/01` two of three
simulated sensors with nothing left out had an unknown.  Readings that are as quiet as their own
differences say decide: where nothing else is wrong the likelihood of the innovations finds the
noise, in turn with the calibration, which is poor as long as there is too much of it.  Where
something is wrong that counts as noise, and nothing is found: differences are all there is.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null, unusable
from ahrsd.diagnosis.calibration_fit.resampling import thinned, working_factor
from ahrsd.diagnosis.innovation_filter.innovation import nuisance_columns, run_filter, sensitivities
from ahrsd.diagnosis.model import Columns, NullModel
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array

_FEWEST = 25  # samples whose scatter is compared with that of others
_TURNS = 4  # of noise and calibration, found one after the other


def with_delta_angles(track: Track, model: NullModel) -> Track:
    """The track with each mean rate as the rotation vector of its step over dt.

    As it is where its rates are that, or where the motion does not tell and it makes no difference.
    model: a calibration to start from.
    """
    if not _resolved(track.gyro_b_rad_s - model.gyro_bias_rad_s):
        return track
    product = _half_turns(track, model.gyro_bias_rad_s)
    if (
        float(np.sum((product - product.mean(axis=0)) ** 2))
        < priors.CONING_LOST * priors.CONING_QUIETEST_RAD_S**2
    ):
        return track
    mended = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + product)
    part, deviation = _part(track, mended, model)
    if (
        deviation * priors.CONING_RESOLVED > 1.0
        or part < 0.5
        or part > 1.0 + priors.CONING_OFF * deviation + 0.5
    ):
        return track
    return mended


def _resolved(rate_b_rad_s: Array) -> bool:
    """Whether the samples follow the motion."""
    change = np.diff(rate_b_rad_s, axis=0)
    return bool(np.mean(change**2) < priors.CONING_UNRESOLVED**2 * np.mean(rate_b_rad_s**2))


def _half_turns(track: Track, bias_rad_s: Array) -> Array:
    """(N, 3) rad/s that coning adds to a mean rate; 0 where the step before is not known."""
    rate = track.gyro_b_rad_s - bias_rad_s
    turn = rate * np.nan_to_num(track.dt_s)[:, None]
    out = np.zeros_like(rate)
    out[1:] = np.cross(turn[:-1], rate[1:]) / 12.0
    return np.where(np.isfinite(track.dt_s)[:, None], out, 0.0)


def _part(track: Track, mended: Track, model: NullModel) -> tuple[float, float]:
    """f and its standard deviation; f = 0, without bound, if unseen.

    Beside the calibration and what a large error of the gyro's axes, scale or time would be.
    """
    m = working_factor(track, carrying(track, model))
    work, other = thinned(track, m, model), thinned(mended, m, model)
    if unusable(work):
        return 0.0, np.inf
    fit = fit_null(work, start=model)
    column = Columns(gyro=(other.gyro_b_rad_s - work.gyro_b_rad_s)[:, :, None])
    beside = (nuisance_columns(fit.filtered), _of_the_rate(work, fit.model.gyro_bias_rad_s))
    X = np.concatenate([sensitivities(fit.filtered, one) for one in beside], axis=2)
    X = X.reshape(-1, X.shape[2])
    x = sensitivities(fit.filtered, column).ravel()
    x = x - X @ np.linalg.lstsq(X, x, rcond=None)[0]
    information = float(x @ x)
    if information <= 0.0:
        return 0.0, np.inf
    noise = fit.filtered.normalised_innovation
    part = -float(x @ fit.filtered.whitened.ravel()) / information  # the reading lacks it
    return part, float(np.sqrt(noise / information))


def _of_the_rate(track: Track, bias_rad_s: Array) -> Columns:
    """The nine of a matrix on the rate, and its derivative: what is late."""
    rate = track.gyro_b_rad_s - bias_rad_s
    out = np.zeros((len(track), 3, 10))
    for axis in range(3):
        out[:, axis, 3 * axis : 3 * axis + 3] = rate
    out[:, :, 9] = time_series.derivative(rate, track.time_s, track.dt_s)
    return Columns(gyro=out)


def quieter(
    recorded: Track, work: Track, spec: Spec, model: NullModel
) -> tuple[Spec, NullModel] | None:
    """The spec and the model with less noise of the gyro than its differences; None for no less.

    work: the recording at the working rate;  spec, model: of its rows, noise from differences
    """
    most_gauss = priors.SHAKEN_WRONG * noise_of_differences(work)[0]
    if spec.sigma_gyro_rad_s is not None or unusable(work) or not shaken(recorded):
        return None
    level = model.sigma_gyro_rad_s
    known = replace(spec, shaken_gyro_rad_s=level)
    for turn in range(_TURNS):
        again = noise_fit.estimated(
            run_filter(work, model, with_sensitivities=False), known, walk=False
        )
        if noise_fit.alike(again, model):
            break
        if turn > 0 and again.sigma_mag_gauss > most_gauss:
            return None
        model = fit_null(work, known, again, noise=False).model
    found = model.sigma_gyro_rad_s < priors.SHAKEN_QUIETER * level
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
    return bool(np.quantile(sixth, 0.1) < priors.SHAKEN_STEADY**2 * np.median(third))


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
