"""Noise levels by innovation likelihood, on pieces of the track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ahrsd.mismatch.coarse import group_size, noise_of, thinned
from ahrsd.mismatch.innovation import Filtered, run_filter
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import NullModel
from ahrsd.samples import Array

#: times the gyro's differenced noise that its noise may be at most
CAP = 1.5
#: random walk of the bias beyond which it is no longer noise: 50 deg/h after 400 s
WALK_CAP_RAD_S_SQRT_S = 1.2e-5
_WALK_GAIN = 6.0  # nats that a wandering bias must gain: two standard deviations are not enough
_FLOOR_MAG_GAUSS, _FLOOR_GYRO_RAD_S = 2e-5, 1e-5
_PIECES, _PIECE_ROWS = 8, 500
_SAME = 0.05  # relative change of a noise level that changes nothing


def first_guess(track: Track, spec: Spec) -> NullModel:
    """Unit soft iron, and noise from differences where the spec does not say."""
    mag, gyro = noise_of(track)
    return NullModel(
        np.eye(3),
        np.zeros(3),
        np.zeros(3),
        spec.sigma_mag_gauss or max(mag, _FLOOR_MAG_GAUSS),
        spec.sigma_gyro_rad_s or max(gyro, _FLOOR_GYRO_RAD_S),
    )


def alike(a: NullModel, b: NullModel) -> bool:
    """Whether two models have the same noise for every purpose."""
    levels = [
        (a.sigma_mag_gauss, b.sigma_mag_gauss),
        (a.sigma_gyro_rad_s, b.sigma_gyro_rad_s),
    ]
    walk = max(a.gyro_walk_rad_s_sqrt_s, b.gyro_walk_rad_s_sqrt_s)
    same_walk = abs(a.gyro_walk_rad_s_sqrt_s - b.gyro_walk_rad_s_sqrt_s) <= 0.2 * walk
    return same_walk and all(abs(np.log(x / y)) < _SAME for x, y in levels)


def estimated(
    filtered: Filtered,
    spec: Spec,
    terms_mag: Array | None,
    terms_gyro: Array | None,
    *,
    walk: bool = True,
) -> NullModel:
    """The model of a filter run with its noise estimated anew; what the spec says stays."""
    clean = cleaned(filtered.track, terms_mag, terms_gyro)
    model = _white(pieces(clean), filtered.model, spec, CAP * noise_of(filtered.track)[1])
    return _walking(clean, model) if walk else replace(model, gyro_walk_rad_s_sqrt_s=0.0)


def cleaned(track: Track, terms_mag: Array | None, terms_gyro: Array | None) -> Track:
    """The track without the contributions of its terms."""
    mag = track.mag_b_gauss if terms_mag is None else track.mag_b_gauss - terms_mag
    gyro = track.gyro_b_rad_s if terms_gyro is None else track.gyro_b_rad_s - terms_gyro
    return replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro)


def pieces(track: Track) -> Track:
    """Up to 4,000 rows of a track: pieces spread over it evenly, each a run of its own."""
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
    )


def _white(track: Track, model: NullModel, spec: Spec, cap: float) -> NullModel:
    """Both levels: free by their ratio, then within the cap."""
    cap = max(cap, _FLOOR_GYRO_RAD_S)
    base = replace(model, gyro_walk_rad_s_sqrt_s=0.0)
    if spec.sigma_mag_gauss and spec.sigma_gyro_rad_s:
        return replace(
            base,
            sigma_mag_gauss=spec.sigma_mag_gauss,
            sigma_gyro_rad_s=spec.sigma_gyro_rad_s,
        )
    if spec.sigma_gyro_rad_s:
        return _mag_alone(track, replace(base, sigma_gyro_rad_s=spec.sigma_gyro_rad_s))
    if spec.sigma_mag_gauss:
        fixed = replace(base, sigma_mag_gauss=spec.sigma_mag_gauss)

        def of_gyro(level: float) -> float:
            return _likelihood(track, replace(fixed, sigma_gyro_rad_s=np.exp(level)))

        best = _highest(of_gyro, np.log(min(model.sigma_gyro_rad_s, cap)))
        found = float(np.clip(np.exp(best), _FLOOR_GYRO_RAD_S, cap))
        return replace(fixed, sigma_gyro_rad_s=found)
    free = _by_ratio(track, base)
    if free.sigma_gyro_rad_s <= cap:
        return replace(free, sigma_gyro_rad_s=max(free.sigma_gyro_rad_s, _FLOOR_GYRO_RAD_S))
    return _mag_alone(track, replace(free, sigma_gyro_rad_s=cap))


def _by_ratio(track: Track, model: NullModel) -> NullModel:
    def scaled(level: float) -> tuple[NullModel, float]:
        tried = replace(model, sigma_gyro_rad_s=model.sigma_mag_gauss * np.exp(level))
        done = run_filter(track, tried)
        scale = max(done.normalised_innovation, 1e-12)
        count = 3 * int(np.count_nonzero(done.used))
        # with the scale at its best the squares sum to their number
        value = float(np.sum(done.log_likelihood)) + 0.5 * count * (scale - 1 - np.log(scale))
        root = float(np.sqrt(scale))
        fitted = replace(
            tried,
            sigma_mag_gauss=tried.sigma_mag_gauss * root,
            sigma_gyro_rad_s=tried.sigma_gyro_rad_s * root,
        )
        return fitted, value

    start = np.log(model.sigma_gyro_rad_s / model.sigma_mag_gauss)
    return scaled(_highest(lambda level: scaled(level)[1], start))[0]


def _mag_alone(track: Track, model: NullModel) -> NullModel:
    def of_mag(level: float) -> float:
        return _likelihood(track, replace(model, sigma_mag_gauss=np.exp(level)))

    best = _highest(of_mag, np.log(model.sigma_mag_gauss))
    return replace(model, sigma_mag_gauss=max(float(np.exp(best)), _FLOOR_MAG_GAUSS))


def _walking(track: Track, model: NullModel) -> NullModel:
    """With a random walk of the gyro's bias if that is far more likely than none."""
    size = group_size(track)
    coarse = thinned(track, size)
    rate = replace(model, sigma_gyro_rad_s=model.sigma_gyro_rad_s / np.sqrt(size))
    still = _likelihood(coarse, rate)
    top = np.log(WALK_CAP_RAD_S_SQRT_S)

    def of_walk(level: float) -> float:
        return _likelihood(coarse, replace(rate, gyro_walk_rad_s_sqrt_s=np.exp(level)))

    tried = [(of_walk(level), level) for level in (top - 3.0, top - 1.5, top)]
    value, best = max(tried)
    if value < still + _WALK_GAIN:
        return model
    return replace(model, gyro_walk_rad_s_sqrt_s=float(np.exp(min(_highest(of_walk, best), top))))


def _likelihood(track: Track, model: NullModel) -> float:
    return float(np.sum(run_filter(track, model).log_likelihood))


def _highest(function: Callable[[float], float], start: float) -> float:
    """Where a smooth function of one number is highest: climb in steps of 0.7, then a parabola."""
    step = 0.7
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
    bend = left - 2 * value + right
    if bend >= 0:
        return middle
    return middle + float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) * step
