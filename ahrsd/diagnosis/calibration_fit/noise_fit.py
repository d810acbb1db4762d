"""Noise levels by differences of readings, and by innovation likelihood on pieces of the track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.resampling import decimated, decimation
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array

#: logarithms below its differences from which a shaken gyro's noise is sought
_SHAKEN_STARTS = (0.0, 1.4, 2.8, 4.2, 5.6)
_WALKS = (-3.6, -2.4, -1.2, 0.0)  # levels tried, log below the cap
_PIECES, _PIECE_ROWS = 6, 400
_FINE = 0.1  # of a logarithm: where no common scale puts right by how much a coarse parabola is off
SAME = 0.02  # relative change of a noise level that changes nothing


def first_guess(track: Track, spec: Spec) -> NullModel:
    """Unit soft iron, and noise from differences where the spec does not say."""
    mag, gyro = noise_of_differences(track)
    return NullModel(
        np.eye(3),
        np.zeros(3),
        np.zeros(3),
        spec.sigma_mag_gauss
        or (max(mag, priors.FLOOR_MAG_GAUSS) if mag else priors.USUAL_MAG_GAUSS),
        spec.sigma_gyro_rad_s or max(gyro, priors.FLOOR_GYRO_RAD_S),
    )


def alike(a: NullModel, b: NullModel) -> bool:
    """Whether two models have the same noise for every purpose."""
    levels = [
        (a.sigma_mag_gauss, b.sigma_mag_gauss),
        (a.sigma_gyro_rad_s, b.sigma_gyro_rad_s),
    ]
    walk = max(a.gyro_walk_rad_s_sqrt_s, b.gyro_walk_rad_s_sqrt_s)
    same_walk = abs(a.gyro_walk_rad_s_sqrt_s - b.gyro_walk_rad_s_sqrt_s) <= 0.2 * walk
    return same_walk and all(abs(np.log(x / y)) < SAME for x, y in levels)


def estimated(
    filtered: Filtered,
    spec: Spec,
    terms_mag: Array | None = None,
    terms_gyro: Array | None = None,
    *,
    walk: bool = True,
) -> NullModel:
    """The model of a filter run with its noise estimated anew; what the spec says stays."""
    clean = cleaned(filtered.track, terms_mag, terms_gyro)
    differenced = spec.shaken_gyro_rad_s or max(noise_of_differences(filtered.track)[1], 1e-9)
    model = _white(pieces(clean), filtered.model, spec, differenced)
    return _walking(clean, model) if walk else replace(model, gyro_walk_rad_s_sqrt_s=0.0)


def rescaled(filtered: Filtered, spec: Spec) -> NullModel:
    """The noise scaled so that the whole track's normalised innovation becomes 1, not its pieces'.

    Both levels together; sigma_mag alone where the gyro's is given or at its cap, and neither where
    sigma_mag would be below its floor: what is missing to 1 is the magnetometer's.
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
        gyro = float(np.clip(gyro * factor, priors.FLOOR_GYRO_RAD_S, _cap(differenced)))
    return replace(model, sigma_mag_gauss=mag, sigma_gyro_rad_s=gyro)


def cleaned(track: Track, terms_mag: Array | None, terms_gyro: Array | None) -> Track:
    """The track without the contributions of its terms."""
    mag = track.mag_b_gauss if terms_mag is None else track.mag_b_gauss - terms_mag
    gyro = track.gyro_b_rad_s if terms_gyro is None else track.gyro_b_rad_s - terms_gyro
    return replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro)


def pieces(track: Track) -> Track:
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


def _cap(differenced: float) -> float:
    return max(priors.GYRO_NOISE_CAP * differenced, priors.FLOOR_GYRO_RAD_S)


def _white(track: Track, model: NullModel, spec: Spec, differenced: float) -> NullModel:
    """Both levels, sigma_gyro drawn to the gyro's differenced noise and within its cap."""
    base = replace(model, gyro_walk_rad_s_sqrt_s=0.0)
    given_mag, given_gyro = spec.sigma_mag_gauss, spec.sigma_gyro_rad_s
    below = priors.SHAKEN_TRUST if spec.shaken_gyro_rad_s else priors.GYRO_NOISE_TRUST
    if given_mag and given_gyro:
        return replace(base, sigma_mag_gauss=given_mag, sigma_gyro_rad_s=given_gyro)
    if given_gyro:
        return _mag_alone(track, replace(base, sigma_gyro_rad_s=given_gyro))
    if given_mag:
        return _gyro_alone(track, replace(base, sigma_mag_gauss=given_mag), differenced, below)
    free = _by_ratio(track, base, differenced, below)
    if free.sigma_mag_gauss < priors.FLOOR_MAG_GAUSS:
        at_floor = replace(base, sigma_mag_gauss=priors.FLOOR_MAG_GAUSS)
        return _gyro_alone(track, at_floor, differenced, below)
    if free.sigma_gyro_rad_s <= _cap(differenced):
        return replace(free, sigma_gyro_rad_s=max(free.sigma_gyro_rad_s, priors.FLOOR_GYRO_RAD_S))
    return _mag_alone(track, replace(free, sigma_gyro_rad_s=_cap(differenced)))


def _prior(sigma_gyro: float, differenced: float, below: float) -> float:
    trust = below if sigma_gyro < differenced else priors.GYRO_NOISE_TRUST
    return -0.5 * float(np.square(np.log(sigma_gyro / differenced) / trust))


def _by_ratio(track: Track, model: NullModel, differenced: float, below: float) -> NullModel:
    most = np.log(_cap(differenced) / priors.FLOOR_MAG_GAUSS)

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
        # with the scale at its best the squares sum to their number
        value = float(np.sum(done.log_likelihood)) + 0.5 * count * (scale - 1 - np.log(scale))
        return fitted, value + _prior(fitted.sigma_gyro_rad_s, differenced, below)

    start = np.log(model.sigma_gyro_rad_s / model.sigma_mag_gauss)
    if below > priors.GYRO_NOISE_TRUST:  # far below there may be another maximum
        start = max((start - down for down in _SHAKEN_STARTS), key=lambda level: scaled(level)[1])
    return scaled(_highest(lambda level: scaled(level)[1], start))[0]


def _mag_alone(track: Track, model: NullModel) -> NullModel:
    def of_mag(level: float) -> float:
        return _likelihood(track, replace(model, sigma_mag_gauss=float(np.exp(level))))

    best = _highest(of_mag, np.log(model.sigma_mag_gauss))
    return replace(model, sigma_mag_gauss=max(float(np.exp(best)), priors.FLOOR_MAG_GAUSS))


def _gyro_alone(track: Track, model: NullModel, differenced: float, below: float) -> NullModel:
    def of_gyro(level: float) -> float:
        tried = replace(model, sigma_gyro_rad_s=float(np.exp(level)))
        return _likelihood(track, tried) + _prior(float(np.exp(level)), differenced, below)

    rough = _highest(of_gyro, np.log(differenced))
    best = float(np.exp(_highest(of_gyro, rough, _FINE)))
    return replace(
        model, sigma_gyro_rad_s=float(np.clip(best, priors.FLOOR_GYRO_RAD_S, _cap(differenced)))
    )


def _walking(track: Track, model: NullModel) -> NullModel:
    """With a random walk of the gyro's bias if that is far more likely than none."""
    size = decimation(track)
    coarse = decimated(track, size)
    rate = replace(model, sigma_gyro_rad_s=model.sigma_gyro_rad_s / np.sqrt(size))
    still = _likelihood(coarse, rate)
    top = np.log(priors.WALK_CAP_RAD_S_SQRT_S)

    def of_walk(level: float) -> float:
        return _likelihood(coarse, replace(rate, gyro_walk_rad_s_sqrt_s=float(np.exp(level))))

    tried = [of_walk(top + level) for level in _WALKS]
    at = int(np.argmax(tried))
    if tried[at] < still + priors.WALK_NATS:
        return model
    level = _WALKS[at]
    if 0 < at < len(_WALKS) - 1:
        level += _parabola(tried[at - 1], tried[at], tried[at + 1]) * (_WALKS[1] - _WALKS[0])
    return replace(model, gyro_walk_rad_s_sqrt_s=float(np.exp(top + level)))


def _likelihood(track: Track, model: NullModel) -> float:
    return float(np.sum(run_filter(track, model, with_sensitivities=False).log_likelihood))


def _highest(function: Callable[[float], float], start: float, step: float = 0.7) -> float:
    """Where a smooth function of one number is highest: climb in steps, then a parabola."""
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
    return middle + _parabola(left, value, right) * step


def _parabola(left: float, middle: float, right: float) -> float:
    """Where the parabola through values at -1, 0, 1 is highest, at most 1 away."""
    bend = left - 2 * middle + right
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0))


def noise_of_differences(track: Track) -> tuple[float, float]:
    """White noise of one reading, (gauss, rad/s), from third differences.

    Of the middle second and the middle axis: a jolt is short, a propeller shakes one axis.
    Third differences of white noise have 20 times its variance and take out what is smooth over
    four samples; what motion is left makes both values too large, never too small.
    """
    return _of_differences(track, track.mag_b_gauss), _of_differences(track, track.gyro_b_rad_s)


def _of_differences(track: Track, values: Array) -> float:
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
