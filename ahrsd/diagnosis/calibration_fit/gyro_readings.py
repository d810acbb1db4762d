"""What a gyro's readings are: mean rates or delta angles, and how much of them is noise.

If they are means of the rate, the turn of a step is not the mean times the step, because the axis
of the turn moves within a step (coning).  To second order the rotation vector of step k is
w_k dt + (w_(k-1) dt) x (w_k dt) / 12 with w the mean rates; it is w_k dt for a gyro whose values
are its delta angles over dt.  Both are called the mean rate, devices send either, and neither is an
unmodelled effect.  The recording itself shows which it is, by the fraction f of that product in it.

Differences of a gyro's values are its noise if the motion is smooth.  If a hand, a road or a
propeller shakes the sensor, they are due to the motion, and may be fifty times the noise.  A filter
that takes them for noise forgets the attitude within seconds; along one recorded motion two of
three simulated sensors with no effect left out showed an unknown source.

If nothing else is wrong, the likelihood of the innovations finds the noise, alternating with the
calibration, which is poor as long as the noise is too large.  If something is wrong, that counts as
noise, and the differences are the only estimate.  The magnetometer decides which is the case: its
noise must be as low as its own differences show.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null, unusable_reason
from ahrsd.diagnosis.calibration_fit.resampling import average_groups, working_factor
from ahrsd.diagnosis.innovation_filter.innovation import nuisance_columns, run_filter, sensitivities
from ahrsd.diagnosis.model import Columns, NullModel
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array

_FEWEST_SAMPLES = 25  # of a block whose variance is compared with that of others
_MOST_ROUNDS = 4  # of estimating noise and calibration in turn


def with_delta_angles(track: Track, model: NullModel) -> Track:
    """The track with each mean rate replaced by the rotation vector of its step over dt.

    Unchanged if its rates are that already, or if the motion does not show it and it does not
    matter.
    model: a calibration to start from
    """
    if not _samples_resolve_motion(track.gyro_b_rad_s - model.gyro_bias_rad_s):
        return track
    product = _coning_rate(track, model.gyro_bias_rad_s)
    if (
        float(np.sum((product - product.mean(axis=0)) ** 2))
        < priors.CONING_LOST * priors.CONING_QUIETEST_RAD_S**2
    ):
        return track
    corrected = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + product)
    part, deviation = _fit_coning_share(track, corrected, model)
    if (
        deviation * priors.CONING_RESOLVED > 1.0
        or part < 0.5
        or part > 1.0 + priors.CONING_OFF * deviation + 0.5
    ):
        return track
    return corrected


def _samples_resolve_motion(rate_b_rad_s: Array) -> bool:
    """Whether the sampling rate is high enough for the motion."""
    change = np.diff(rate_b_rad_s, axis=0)
    return bool(np.mean(change**2) < priors.CONING_UNRESOLVED**2 * np.mean(rate_b_rad_s**2))


def _coning_rate(track: Track, bias_rad_s: Array) -> Array:
    """(N, 3) rad/s that coning adds to a mean rate; 0 if the step before is unknown."""
    rate = track.gyro_b_rad_s - bias_rad_s
    turn = rate * np.nan_to_num(track.dt_s)[:, None]
    out = np.zeros_like(rate)
    out[1:] = np.cross(turn[:-1], rate[1:]) / 12.0
    return np.where(np.isfinite(track.dt_s)[:, None], out, 0.0)


def _fit_coning_share(track: Track, corrected: Track, model: NullModel) -> tuple[float, float]:
    """f and its standard deviation; f = 0 with an infinite deviation if it is not observable.

    Estimated jointly with the calibration and with large errors of the gyro's axes, scale and time.
    """
    m = working_factor(track, averaging_model(track, model))
    work, other = average_groups(track, m, model), average_groups(corrected, m, model)
    if unusable_reason(work):
        return 0.0, np.inf
    fit = fit_null(work, start=model)
    column = Columns(gyro=(other.gyro_b_rad_s - work.gyro_b_rad_s)[:, :, None])
    nuisances = (
        nuisance_columns(fit.filtered),
        _gyro_error_columns(work, fit.model.gyro_bias_rad_s),
    )
    X = np.concatenate([sensitivities(fit.filtered, one) for one in nuisances], axis=2)
    X = X.reshape(-1, X.shape[2])
    x = sensitivities(fit.filtered, column).ravel()
    x = x - X @ np.linalg.lstsq(X, x, rcond=None)[0]
    information = float(x @ x)
    if information <= 0.0:
        return 0.0, np.inf
    noise = fit.filtered.normalised_innovation
    # negative: the readings lack the coning
    part = -float(x @ fit.filtered.whitened.ravel()) / information
    return part, float(np.sqrt(noise / information))


def _gyro_error_columns(track: Track, bias_rad_s: Array) -> Columns:
    """Ten columns: the nine of a matrix on the rate, and the rate's derivative for a delay."""
    rate = track.gyro_b_rad_s - bias_rad_s
    out = np.zeros((len(track), 3, 10))
    for axis in range(3):
        out[:, axis, 3 * axis : 3 * axis + 3] = rate
    out[:, :, 9] = time_series.derivative(rate, track.time_s, track.dt_s)
    return Columns(gyro=out)


def find_lower_gyro_noise(
    recorded: Track, work: Track, spec: Spec, model: NullModel
) -> tuple[Spec, NullModel] | None:
    """Spec and model with less gyro noise than its differences show; None if it is not less.

    work: the recording at the working rate;  spec, model: of its rows, noise from differences
    """
    most_gauss = priors.SHAKEN_WRONG * noise_of_differences(work)[0]
    if spec.sigma_gyro_rad_s is not None or unusable_reason(work) or not is_shaken(recorded):
        return None
    level = model.sigma_gyro_rad_s
    known = replace(spec, shaken_gyro_rad_s=level)
    for turn in range(_MOST_ROUNDS):
        again = noise_fit.estimate_noise(
            run_filter(work, model, with_sensitivities=False), known, walk=False
        )
        if noise_fit.same_noise(again, model):
            break
        if turn > 0 and again.sigma_mag_gauss > most_gauss:
            return None
        model = fit_null(work, known, again, noise=False).model
    found = model.sigma_gyro_rad_s < priors.SHAKEN_QUIETER * level
    return (known, model) if found else None


def averaging_model(track: Track, model: NullModel) -> NullModel:
    """The model by whose noise readings are averaged.

    The noise of a shaken gyro is unknown and taken as none.
    """
    return replace(model, sigma_gyro_rad_s=0.0) if is_shaken(track) else model


def is_shaken(track: Track) -> bool:
    """Whether the differences of the gyro's values are mostly motion, not noise.

    Noise has the same level in every second, and contains nothing that is smooth over seven
    samples.  A hand and a road shake with a changing level: in eleven of twelve real recordings a
    tenth of the seconds is below .67 of the usual level, in none of 120 simulated motions below
    .76.
    """
    third, sixth = (_variance_per_second(track, order) for order in (3, 6))
    if not len(third):
        return False
    return bool(np.quantile(sixth, 0.1) < priors.SHAKEN_STEADY**2 * np.median(third))


def _variance_per_second(track: Track, order: int) -> Array:
    """Variance of the gyro per second, at least 25 samples, if its differences were white.

    order: of the differences
    """
    found: list[Array] = []
    block = max(_FEWEST_SAMPLES, round(1.0 / track.step_s))
    for run in track.runs or (slice(0, len(track)),):
        differences = np.diff(track.gyro_b_rad_s[run], order, axis=0)
        differences = differences[np.isfinite(differences).all(axis=1)]
        whole = len(differences) // block * block
        if whole:
            square = np.square(differences[:whole]).reshape(-1, block, 3)
            found.append(np.mean(square, axis=(1, 2)) / comb(2 * order, order))
    return np.concatenate(found) if found else np.zeros(0)
