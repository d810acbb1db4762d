"""Gyro values that are means of the rate, where the turn of a step is not the mean times the step.

The axis of a turn moves within a step (coning): to second order the rotation vector of step k is
w_k dt + (w_(k-1) dt) x (w_k dt) / 12 with w the mean rates, and w_k dt for a gyro whose values are
its delta angles over dt.  Both are the mean rate to a person, devices send either, and neither is
physics left out: the recording itself says which it is, by the part f of that product in it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.calibration_fit.null import fit_null, unusable
from ahrsd.diagnosis.calibration_fit.shaken import carrying
from ahrsd.diagnosis.calibration_fit.thin import thinned, working_factor
from ahrsd.diagnosis.innovation_filter.innovation import nuisance_columns, sensitivities
from ahrsd.diagnosis.model import Columns, NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

#: a gyro's noise per sample, rad/s, below which none is: coning that is lost even in this is left
_QUIETEST_RAD_S, _LOST = 1e-4, 10.0
_RESOLVED = 3.0  # deviations that 0 and 1 must be apart to be told
_OFF = 4.0  # deviations from 1 beyond which f is something else
#: change of the rate from step to step over the rate, root mean squares, beyond which the product
#: of neighbours says nothing of what was between them
_UNRESOLVED = 0.5


def with_delta_angles(track: Track, model: NullModel) -> Track:
    """The track with each mean rate as the rotation vector of its step over dt.

    As it is where its rates are that, or where the motion does not tell and it makes no difference.
    model: a calibration to start from.
    """
    if not _resolved(track.gyro_b_rad_s - model.gyro_bias_rad_s):
        return track
    product = _half_turns(track, model.gyro_bias_rad_s)
    if float(np.sum((product - product.mean(axis=0)) ** 2)) < _LOST * _QUIETEST_RAD_S**2:
        return track
    mended = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + product)
    part, deviation = _part(track, mended, model)
    if deviation * _RESOLVED > 1.0 or part < 0.5 or part > 1.0 + _OFF * deviation + 0.5:
        return track
    return mended


def _resolved(rate_b_rad_s: Array) -> bool:
    """Whether the samples follow the motion."""
    change = np.diff(rate_b_rad_s, axis=0)
    return bool(np.mean(change**2) < _UNRESOLVED**2 * np.mean(rate_b_rad_s**2))


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
