"""Noise levels from differences of readings, and from the likelihood of innovations on pieces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.resampling import decimate, decimation_factor
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array

#: logarithms below the differenced noise, from which a shaken gyro's noise is maximised
_SHAKEN_STARTS = (0.0, 1.4, 2.8, 4.2, 5.6)
_WALK_LEVELS = (-3.6, -2.4, -1.2, 0.0)  # levels tried, in logarithms relative to the cap
_PIECES, _PIECE_ROWS = 6, 400
_FINE_STEP = 0.1  # of a logarithm: no common scale corrects the error of a coarse parabola there
SAME_LEVEL = 0.02  # relative change of a noise level below which it is the same


def first_guess(track: Track, spec: Spec) -> NullModel:
    """Unit soft iron, and noise from differences if the spec does not give it."""
    mag, gyro = noise_of_differences(track)
    return NullModel(
        np.eye(3),
        np.zeros(3),
        np.zeros(3),
        spec.sigma_mag_gauss
        or (max(mag, priors.FLOOR_MAG_GAUSS) if mag else priors.USUAL_MAG_GAUSS),
        spec.sigma_gyro_rad_s or max(gyro, priors.FLOOR_GYRO_RAD_S),
    )


def same_noise(a: NullModel, b: NullModel) -> bool:
    """Whether two models have the same noise for every purpose."""
    levels = [
        (a.sigma_mag_gauss, b.sigma_mag_gauss),
        (a.sigma_gyro_rad_s, b.sigma_gyro_rad_s),
    ]
    walk = max(a.gyro_walk_rad_s_sqrt_s, b.gyro_walk_rad_s_sqrt_s)
    same_walk = abs(a.gyro_walk_rad_s_sqrt_s - b.gyro_walk_rad_s_sqrt_s) <= 0.2 * walk
    return same_walk and all(abs(np.log(x / y)) < SAME_LEVEL for x, y in levels)


def estimate_noise(
    filtered: Filtered,
    spec: Spec,
    terms_mag: Array | None = None,
    terms_gyro: Array | None = None,
    *,
    walk: bool = True,
) -> NullModel:
    """The model of a filter run with its noise estimated anew; levels in the spec are kept.

    terms_mag, terms_gyro: (N, 3) terms to subtract from the readings;  walk: allow a random walk of
    the gyro's bias
    """
    clean = without_terms(filtered.track, terms_mag, terms_gyro)
    differenced = spec.shaken_gyro_rad_s or max(noise_of_differences(filtered.track)[1], 1e-9)
    model = _fit_white_noise(cut_pieces(clean), filtered.model, spec, differenced)
    return _with_bias_walk(clean, model) if walk else replace(model, gyro_walk_rad_s_sqrt_s=0.0)


def rescale_noise(filtered: Filtered, spec: Spec) -> NullModel:
    """The noise scaled so that the normalised innovation of the whole track, not its pieces, is 1.

    Both levels are scaled together; sigma_mag alone if the gyro's is given or at its cap; neither
    if sigma_mag would fall below its floor.  Any remaining difference from 1 is the magnetometer's.
    """
    model, factor = filtered.model, float(np.sqrt(filtered.normalised_innovation))
    if spec.sigma_mag_gauss or not np.isfinite(factor) or factor == 0.0:
        return model
    mag = model.sigma_mag_gauss * factor
    if mag < priors.FLOOR_MAG_GAUSS:
        return replace(model, sigma_mag_gauss=priors.FLOOR_MAG_GAUSS)
    gyro = model.sigma_gyro_rad_s
    if not spec.sigma_gyro_rad_s:
        differenced = spec.shaken_gyro_rad_s or noise_of_differences(filtered.track)[1]
        gyro = float(np.clip(gyro * factor, priors.FLOOR_GYRO_RAD_S, _gyro_noise_cap(differenced)))
    return replace(model, sigma_mag_gauss=mag, sigma_gyro_rad_s=gyro)


def without_terms(track: Track, terms_mag: Array | None, terms_gyro: Array | None) -> Track:
    """The track without the contributions of its terms."""
    mag = track.mag_b_gauss if terms_mag is None else track.mag_b_gauss - terms_mag
    gyro = track.gyro_b_rad_s if terms_gyro is None else track.gyro_b_rad_s - terms_gyro
    return replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro)


def cut_pieces(track: Track) -> Track:
    """Up to 2,400 rows of a track: pieces spread over it evenly, each a run of its own."""
    if len(track) <= _PIECES * _PIECE_ROWS:
        return track
    starts = np.linspace(0, len(track) - _PIECE_ROWS, _PIECES).round().astype(int)
    keep: list[int] = []
    runs: list[slice] = []
    for start in starts:
        for run in track.runs:
            first, last = max(run.start, int(start)), min(run.stop, int(start) + _PIECE_ROWS)
            if last - first >= 50:
                runs.append(slice(len(keep), len(keep) + last - first))
                keep.extend(range(first, last))
    if not runs:
        return track
    rows = np.array(keep)
    dt = track.dt_s[rows].copy()
    dt[[run.start for run in runs]] = np.nan
    accel = None if track.accel_b_m_s2 is None else track.accel_b_m_s2[rows]
    return Track(
        track.time_s[rows],
        dt,
        track.mag_b_gauss[rows],
        track.gyro_b_rad_s[rows],
        accel,
        {},
        tuple(runs),
        None if track.lost_turns is None else track.lost_turns[rows],
        track.step_share,
    )


def _gyro_noise_cap(differenced: float) -> float:
    """The largest sigma_gyro that is allowed."""
    return max(priors.GYRO_NOISE_CAP * differenced, priors.FLOOR_GYRO_RAD_S)


def _fit_white_noise(track: Track, model: NullModel, spec: Spec, differenced: float) -> NullModel:
    """Both levels; sigma_gyro has a prior at the gyro's differenced noise, and a cap."""
    base = replace(model, gyro_walk_rad_s_sqrt_s=0.0)
    given_mag, given_gyro = spec.sigma_mag_gauss, spec.sigma_gyro_rad_s
    below = priors.SHAKEN_TRUST if spec.shaken_gyro_rad_s else priors.GYRO_NOISE_TRUST
    if given_mag and given_gyro:
        return replace(base, sigma_mag_gauss=given_mag, sigma_gyro_rad_s=given_gyro)
    if given_gyro:
        return _fit_mag_level(track, replace(base, sigma_gyro_rad_s=given_gyro))
    if given_mag:
        return _fit_gyro_level(track, replace(base, sigma_mag_gauss=given_mag), differenced, below)
    free = _fit_both_levels(track, base, differenced, below)
    if free.sigma_mag_gauss < priors.FLOOR_MAG_GAUSS:
        at_floor = replace(base, sigma_mag_gauss=priors.FLOOR_MAG_GAUSS)
        return _fit_gyro_level(track, at_floor, differenced, below)
    if free.sigma_gyro_rad_s <= _gyro_noise_cap(differenced):
        return replace(free, sigma_gyro_rad_s=max(free.sigma_gyro_rad_s, priors.FLOOR_GYRO_RAD_S))
    return _fit_mag_level(track, replace(free, sigma_gyro_rad_s=_gyro_noise_cap(differenced)))


def _log_prior(sigma_gyro: float, differenced: float, below: float) -> float:
    """Log prior of sigma_gyro.  below: width, in logarithms, below the differenced noise."""
    trust = below if sigma_gyro < differenced else priors.GYRO_NOISE_TRUST
    return -0.5 * float(np.square(np.log(sigma_gyro / differenced) / trust))


def _fit_both_levels(track: Track, model: NullModel, differenced: float, below: float) -> NullModel:
    """Both levels free: the maximum over their ratio, with the scale solved for."""
    most = np.log(_gyro_noise_cap(differenced) / priors.FLOOR_MAG_GAUSS)

    def scaled(level: float) -> tuple[NullModel, float]:
        ratio = float(np.exp(min(level, most)))
        tried = replace(model, sigma_gyro_rad_s=model.sigma_mag_gauss * ratio)
        done = run_filter(track, tried, with_sensitivities=False)
        scale = max(done.normalised_innovation, 1e-12)
        count = 3 * int(np.count_nonzero(done.used))
        root = float(np.sqrt(scale))
        fitted = replace(
            tried,
            sigma_mag_gauss=tried.sigma_mag_gauss * root,
            sigma_gyro_rad_s=tried.sigma_gyro_rad_s * root,
        )
        # at the maximum-likelihood scale the sum of squares equals their number
        value = float(np.sum(done.log_likelihood)) + 0.5 * count * (scale - 1 - np.log(scale))
        return fitted, value + _log_prior(fitted.sigma_gyro_rad_s, differenced, below)

    start = np.log(model.sigma_gyro_rad_s / model.sigma_mag_gauss)
    if below > priors.GYRO_NOISE_TRUST:  # another maximum may be far below
        start = max((start - down for down in _SHAKEN_STARTS), key=lambda level: scaled(level)[1])
    return scaled(_maximise(lambda level: scaled(level)[1], start))[0]


def _fit_mag_level(track: Track, model: NullModel) -> NullModel:
    """sigma_mag alone."""

    def of_mag(level: float) -> float:
        return _log_likelihood(track, replace(model, sigma_mag_gauss=float(np.exp(level))))

    best = _maximise(of_mag, np.log(model.sigma_mag_gauss))
    return replace(model, sigma_mag_gauss=max(float(np.exp(best)), priors.FLOOR_MAG_GAUSS))


def _fit_gyro_level(track: Track, model: NullModel, differenced: float, below: float) -> NullModel:
    """sigma_gyro alone."""

    def of_gyro(level: float) -> float:
        tried = replace(model, sigma_gyro_rad_s=float(np.exp(level)))
        return _log_likelihood(track, tried) + _log_prior(float(np.exp(level)), differenced, below)

    rough = _maximise(of_gyro, np.log(differenced))
    best = float(np.exp(_maximise(of_gyro, rough, _FINE_STEP)))
    return replace(
        model,
        sigma_gyro_rad_s=float(
            np.clip(best, priors.FLOOR_GYRO_RAD_S, _gyro_noise_cap(differenced))
        ),
    )


def _with_bias_walk(track: Track, model: NullModel) -> NullModel:
    """The model with a random walk of the gyro's bias if that is far more likely than none."""
    size = decimation_factor(track)
    coarse = decimate(track, size)
    rate = replace(model, sigma_gyro_rad_s=model.sigma_gyro_rad_s / np.sqrt(size))
    without_walk = _log_likelihood(coarse, rate)
    top = np.log(priors.WALK_CAP_RAD_S_SQRT_S)

    def of_walk(level: float) -> float:
        return _log_likelihood(coarse, replace(rate, gyro_walk_rad_s_sqrt_s=float(np.exp(level))))

    tried = [of_walk(top + level) for level in _WALK_LEVELS]
    at = int(np.argmax(tried))
    if tried[at] < without_walk + priors.WALK_NATS:
        return model
    level = _WALK_LEVELS[at]
    if 0 < at < len(_WALK_LEVELS) - 1:
        level += _parabola_maximum(tried[at - 1], tried[at], tried[at + 1]) * (
            _WALK_LEVELS[1] - _WALK_LEVELS[0]
        )
    return replace(model, gyro_walk_rad_s_sqrt_s=float(np.exp(top + level)))


def _log_likelihood(track: Track, model: NullModel) -> float:
    """Log likelihood of the innovations."""
    return float(np.sum(run_filter(track, model, with_sensitivities=False).log_likelihood))


def _maximise(function: Callable[[float], float], start: float, step: float = 0.7) -> float:
    """Argument that maximises a smooth function of one variable: steps uphill, then a parabola."""
    middle, value = start, function(start)
    left, right = function(start - step), function(start + step)
    for _ in range(12):
        if left > value and left >= right:
            middle, right, value = middle - step, value, left
            left = function(middle - step)
        elif right > value:
            middle, left, value = middle + step, value, right
            right = function(middle + step)
        else:
            break
    return middle + _parabola_maximum(left, value, right) * step


def _parabola_maximum(left: float, middle: float, right: float) -> float:
    """Maximum of the parabola through values at -1, 0, 1, at most 1 away."""
    bend = left - 2 * middle + right
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0))


def noise_of_differences(track: Track) -> tuple[float, float]:
    """White noise of one reading, (gauss, rad/s), from third differences.

    The median over seconds and axes: a jolt is short, a propeller shakes one axis.  Third
    differences of white noise have 20 times its variance and remove what is smooth over four
    samples.  Remaining motion makes both values too large, never too small.
    """
    return _noise_of_third_differences(track, track.mag_b_gauss), _noise_of_third_differences(
        track, track.gyro_b_rad_s
    )


def _noise_of_third_differences(track: Track, values: Array) -> float:
    """Standard deviation of white noise in values (N, 3); 0 if there are too few."""
    found: list[Array] = []
    known = track.dt_s[np.isfinite(track.dt_s)]
    block = max(8, round(1.0 / float(np.median(known)))) if len(known) else 8
    for run in track.runs or (slice(0, len(track)),):
        third = np.diff(values[run], 3, axis=0)
        third = third[np.isfinite(third).all(axis=1)]
        whole = len(third) // block * block
        if whole:
            square = np.mean(np.square(third[:whole]).reshape(-1, block, 3), axis=1)
            found.append(square / 20.0)
    if not found:
        return 0.0
    return float(np.sqrt(np.median(np.median(np.concatenate(found), axis=0))))


def check_spec_noise(track: Track, spec: Spec) -> tuple[Spec, list[str]]:
    """The spec without a noise that its readings contradict, and one line on each that they do.

    A gyro may scatter by far more than its noise, which is its motion.
    """
    names = "sigma_mag_gauss", "sigma_gyro_rad_s"
    notes = []
    if spec.field_gauss is not None:
        notes.append("the spec's field_gauss changes nothing: the field's strength is not judged")
    for key, scatter in zip(names, noise_of_differences(track), strict=True):
        given = getattr(spec, key)
        if given is None or scatter == 0.0 or not np.isfinite(scatter):
            continue
        words = f"the spec says {key} = {given:g}, but successive readings scatter by {scatter:.2g}"
        if given > priors.NOISE_AGREES * scatter:
            notes.append(f"{words}: check its unit; only noise that is slow scatters so little")
        elif key == "sigma_mag_gauss" and scatter > priors.NOISE_IMPOSSIBLE * given:
            spec = replace(spec, sigma_mag_gauss=None)
            notes.append(f"{words}: it was left out; check its unit, or the sensor")
        elif key == "sigma_mag_gauss" and scatter > priors.NOISE_AGREES * given:
            notes.append(f"{words}: check its unit; what the spec does not explain is a mismatch")
    return spec, notes
