"""Noise of the whitened innovations: colour, heavy tails, and changes of level.

Colour: an autoregression in time, the same on the three axes, its order by the Bayesian
information criterion.  Simulations of the repaired model use it, so that their bands are as wide
as the recording's noise.

Level: half the mean square of successive differences per block.  No slow misfit enters these, so
that a field that is missing in the model does not count as noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.data_quality.facts import Fact, row_intervals
from ahrsd.diagnosis.innovation_filter.innovation import Filtered
from ahrsd.diagnosis.innovation_filter.regression_statistics import student_log_density
from ahrsd.samples import Array

_MAX_ORDER = 12  # order of the autoregression
_FREQUENCIES = 4096  # of a spectrum
_WHITE_FLOOR = 1e-6  # least white part of a colour
_BLOCK_S = 2.0
_FINE_BLOCK_S, _PASSES = 1.0, 4  # block length and iterations that delimit bursts


@dataclass(frozen=True, slots=True, eq=False)
class Colour:
    """e_k = sum_j coefficients_j e_(k-j) + white noise of `variance`; no coefficients: white."""

    coefficients: Array
    variance: float

    @property
    def order(self) -> int:
        """Order of the autoregression."""
        return len(self.coefficients)

    @property
    def power(self) -> Array:
        """(_FREQUENCIES / 2 + 1,) spectral density, per row."""
        taps = np.concatenate([[1.0], -self.coefficients])
        return np.asarray(self.variance / np.abs(np.fft.rfft(taps, _FREQUENCIES)) ** 2)


def fit_colour(filtered: Filtered) -> Colour:
    """Fit an autoregression to the whitened innovations."""
    rows = _centred_innovations(filtered)
    count = max(float(np.count_nonzero(filtered.used)) * 3, 1.0)
    r = np.array(
        [
            float(np.sum(rows[lag:] * rows[: len(rows) - lag])) / count
            for lag in range(_MAX_ORDER + 1)
        ]
    )
    if r[0] < 1e-18:
        return Colour(np.zeros(0), 1.0)
    best, best_value, variance = np.zeros(0), count * np.log(max(r[0], 1e-300)), r[0]
    for order in range(1, min(_MAX_ORDER, int(count) // 60) + 1):
        a = solve_toeplitz(r[:order], r[1 : order + 1])
        remaining = float(r[0] - a @ r[1 : order + 1])
        value = count * np.log(max(remaining, 1e-300)) + order * np.log(count)
        if value < best_value - 2.0:
            best, best_value, variance = np.asarray(a), value, remaining
    return Colour(best, float(variance))


def colour_before_filter(wanted: Colour, found: Colour) -> tuple[Colour, float]:
    """The noise colour that the filter turns into `wanted`, and its relative standard deviation.

    found: what the filter made of noise of the colour `wanted`
    The filter takes part of slow noise for motion, so that innovations are whiter than the noise.
    """
    r = np.fft.irfft(wanted.power**2 / found.power)[: _MAX_ORDER + 1]
    r[0] *= 1.0 + _WHITE_FLOOR
    a = np.asarray(solve_toeplitz(r[:-1], r[1:]))
    whole = float(np.fft.irfft(wanted.power)[0])
    return Colour(a, float(r[0] - a @ r[1:])), float(np.sqrt(r[0] / whole))


def tail_freedom(filtered: Filtered) -> float:
    """Freedom of the Student-t that fits the innovations of all axes; inf: no heavy tails."""
    e = filtered.whitened[filtered.used].ravel()
    if len(e) < 30:
        return float("inf")
    z = (e - e.mean()) / max(float(e.std()), 1e-300)
    kurtosis = float(np.mean(z**4) - 3.0)
    deviation = float(np.sqrt(24.0 / len(z)))
    return _maximum_likelihood_freedom(z) if kurtosis > 3 * deviation else float("inf")


def _maximum_likelihood_freedom(z: Array) -> float:
    """Freedom of the Student-t for values of variance 1; the kurtosis is a poor estimate of it."""
    tried = np.exp(np.linspace(np.log(2.2), np.log(60.0), 34))
    nats = [float(np.sum(student_log_density(z, v))) for v in tried]
    return float(tried[int(np.argmax(nats))])


def block_variances(
    filtered: Filtered, block_s: float = _BLOCK_S, limit: float = np.inf
) -> tuple[Array, Array, Array]:
    """Middle time (B,), white variance of the whitened innovations (B,), and their number (B,).

    limit: larger squares of a difference count as this
    """
    track = filtered.track
    pairs = filtered.used[1:] & filtered.used[:-1]
    squares = np.minimum(np.diff(filtered.whitened, axis=0) ** 2, limit)
    half = np.where(pairs, np.sum(squares, axis=1) / 2, 0.0)
    block = ((track.time_s[1:] - track.time_s[0]) / block_s).astype(int)
    size = np.asarray(np.bincount(block, weights=3.0 * pairs), dtype=np.float64)
    total = np.bincount(block, weights=half, minlength=len(size))
    kept = size >= 15
    middle = track.time_s[0] + (np.arange(len(size)) + 0.5) * block_s
    return middle[kept], total[kept] / size[kept], size[kept]


@dataclass(frozen=True, slots=True)
class TwoNoiseLevels:
    """Intervals in seconds of the higher noise level, and both white variances, whitened.

    burst: the level rises and falls again; else it changed once
    """

    spans_s: tuple[tuple[float, float], ...]
    high: float
    low: float
    burst: bool


def find_high_noise(filtered: Filtered) -> TwoNoiseLevels | None:
    """Where the noise level is higher than elsewhere; None where there is one level."""
    middle, variance, size = block_variances(filtered)
    if len(middle) < 10 or not np.any(variance > 1e-18):
        return None
    # a single outlier is no higher noise level
    limit = priors.LOUDER_OUTLIER**2 * 2.0 * _robust_variance(filtered) or np.inf
    clipped = block_variances(filtered, limit=limit)[1]
    first, last, gain = _maximum_likelihood_interval(
        clipped, size / _differences_per_reading(filtered, limit)
    )
    inside = np.zeros(len(middle), dtype=bool)
    inside[first:last] = True
    sides = high, low = _mean_inside_outside(variance, size, inside)
    if (
        gain <= priors.LOUDER_NATS
        or high <= priors.LOUDER_RATIO * low
        or not _is_noise(filtered, middle[inside])
    ):
        return None
    interval = (float(middle[first] - _BLOCK_S / 2), float(middle[last - 1] + _BLOCK_S / 2))
    spans, high, low = _high_noise_intervals(
        filtered, *_mean_inside_outside(clipped, size, inside), limit
    )
    filled = sum(b - a for a, b in spans) / (interval[1] - interval[0])
    # a level that lasts from the beginning or to the end changed once
    interior = first > 0 and last < len(middle)
    short = interior and last - first <= priors.BURST_SHARE * len(middle)
    if high < priors.LOUDER_RATIO * low:  # not two alternating levels: the one interval alone
        spans, high, low = [], *sides
    if short or (len(spans) > 1 and filled < priors.BURST_FILLED):
        return TwoNoiseLevels(tuple(spans or [interval]), high, low, burst=True)
    return TwoNoiseLevels((interval,), high, low, burst=False)


def level_facts(filtered: Filtered, *, spec_given: bool = False) -> list[Fact]:
    """A noise burst, or a noise level that changed or is above the specified one."""
    if found := find_high_noise(filtered):
        return [(_burst_fact if found.burst else _level_fact)(filtered, found)]
    middle, variance, size = block_variances(filtered)
    if not spec_given or len(middle) < 10 or not _is_noise(filtered, middle):
        return []
    # a few outliers raise the mean power, but most readings may be at the specified level
    overall = min(float(np.average(variance, weights=size)), _robust_variance(filtered))
    if overall > priors.LEVEL_RATIO and overall > 1 + 6 * np.sqrt(
        2 * _differences_per_reading(filtered) / size.sum()
    ):
        whole = (float(middle[0] - _BLOCK_S / 2), float(middle[-1] + _BLOCK_S / 2))
        return [_level_fact(filtered, TwoNoiseLevels((whole,), overall, 1.0, burst=False))]
    return []


def _differences_per_reading(filtered: Filtered, limit: float = np.inf) -> float:
    """How many squared differences, each at most `limit`, are worth one Gaussian reading.

    Neighbouring differences share a sample; heavy tails scatter more than a Gaussian; an outlier
    on one axis may be one on all.
    """
    pairs = filtered.used[1:] & filtered.used[:-1]
    rows = np.sum(np.minimum(np.diff(filtered.whitened, axis=0)[pairs] ** 2, limit), axis=1)
    scatter = float(np.var(rows) / np.mean(rows) ** 2)
    return 1.5 * max(scatter / (2.0 / 3.0), 1.0)


def _robust_variance(filtered: Filtered) -> float:
    """White variance of the whitened innovations from the median of their differences."""
    d = np.diff(filtered.whitened, axis=0)[filtered.used[1:] & filtered.used[:-1]]
    return float((1.4826 * np.median(np.abs(d))) ** 2 / 2) if len(d) else 0.0


def _is_noise(filtered: Filtered, blocks: Array) -> bool:
    """True if the power in these blocks alternates like noise and does not move like a misfit.

    Successive differences of white noise are correlated by -1/2.
    """
    time_s = filtered.track.time_s
    later = np.searchsorted(blocks, time_s).clip(1, len(blocks) - 1)
    away_s = np.minimum(np.abs(time_s - blocks[later - 1]), np.abs(time_s - blocks[later]))
    near = away_s <= _BLOCK_S / 2
    d = np.diff(filtered.whitened, axis=0)
    kept = (filtered.used & near)[2:] & filtered.used[1:-1] & filtered.used[:-2]
    square = float(np.sum(d[1:][kept] ** 2))
    return square > 0 and float(np.sum((d[1:] * d[:-1])[kept])) / square < priors.NOISE_OPPOSED


def _maximum_likelihood_interval(variance: Array, weight: Array) -> tuple[int, int, float]:
    """The interval of blocks whose own level is most likely: first, one behind the last, nats."""
    squares = np.concatenate([[0.0], np.cumsum(variance * weight)])
    weights = np.concatenate([[0.0], np.cumsum(weight)])
    base = weights[-1] * np.log(squares[-1] / weights[-1])
    a, b = np.triu_indices(len(squares), k=1)
    inside, outside = weights[b] - weights[a], weights[-1] - weights[b] + weights[a]
    high, low = squares[b] - squares[a], squares[-1] - squares[b] + squares[a]
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = inside * np.log(high / inside)
        outer = np.where(outside > 0.5, outside * np.log(low / outside), 0.0)
        gain = 0.5 * (base - inner - outer)
        gain[(outside > 0.5) & (high * outside < low * inside)] = 0.0
    best = int(np.nanargmax(gain))
    return int(a[best]), int(b[best]), float(gain[best])


def _mean_inside_outside(
    variance: Array, size: Array, inside: NDArray[np.bool]
) -> tuple[float, float]:
    """Mean of (B,) variances inside and outside; 1 for no blocks."""
    high, low = (
        float(np.average(variance[part], weights=size[part])) if part.any() else 1.0
        for part in (inside, ~inside)
    )
    return high, low


def _high_noise_intervals(
    filtered: Filtered, high: float, low: float, limit: float
) -> tuple[list[tuple[float, float]], float, float]:
    """Intervals in which the higher of two noise levels is the more likely, and both levels.

    high, low, limit: of squares that are limited to `limit`
    """
    middle, clipped, size = block_variances(filtered, _FINE_BLOCK_S, limit)
    weight = size / _differences_per_reading(filtered, limit)
    on = np.zeros(len(middle), dtype=bool)
    for _ in range(_PASSES):
        nats = 0.5 * weight * (np.log(low / high) + clipped * (1 / low - 1 / high))
        on = nats > 0
        if on.all() or not on.any():
            break
        high, low = _mean_inside_outside(clipped, size, on)
    # an interval may begin in any of the blocks
    price = float(np.log(max(len(middle), 1)))
    kept = [(a, b) for a, b in row_intervals(on, 1) if float(np.sum(nats[a:b])) > price]
    on = np.zeros(len(middle), dtype=bool)
    for a, b in kept:
        on[a:b] = True
    found = [
        (float(middle[a] - _FINE_BLOCK_S / 2), float(middle[b - 1] + _FINE_BLOCK_S / 2))
        for a, b in kept
    ]
    return found, *_mean_inside_outside(block_variances(filtered, _FINE_BLOCK_S)[1], size, on)


def _burst_fact(filtered: Filtered, found: TwoNoiseLevels) -> Fact:
    high, low = found.high, found.low
    sigma = filtered.model.sigma_mag_gauss * float(np.sqrt(max(high - low, 0.0)))
    times = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in found.spans_s)
    words = f"from {times} s the noise is {np.sqrt(high / low):.2g} times its usual level"
    begin, end = found.spans_s[0]
    return Fact(
        "noise_burst",
        words,
        Where(found.spans_s, ("x", "y", "z"), "noise"),
        priors.SURE_OF_NOISE,
        (Value("burst", sigma, sigma * 0.1, "gauss"),),
        {"onset_s": begin, "length_s": end - begin},
    )


def _level_fact(filtered: Filtered, found: TwoNoiseLevels) -> Fact:
    (interval,), high, low = found.spans_s, found.high, found.low
    begin, end = interval[0], min(interval[1], float(filtered.track.time_s[-1]))
    sigma = filtered.model.sigma_mag_gauss * float(np.sqrt(max(high - low, 0.0)))
    ratio = float(np.sqrt(high / low))
    words = f"from {begin:.0f} to {end:.0f} s the noise is {ratio:.2g} times its usual level"
    where = Where(((begin, end),), ("x", "y", "z"), "noise")
    parameters = (Value("mag", sigma, sigma * 0.1, "gauss"),)
    falls = begin < filtered.track.time_s[0] + _BLOCK_S / 2 and end < filtered.track.time_s[-1]
    setting = {"onset_s": end if falls else begin}
    return Fact("noise_level", words, where, priors.SURE_OF_NOISE, parameters, setting)


def _centred_innovations(filtered: Filtered) -> Array:
    rows = np.where(filtered.used[:, None], filtered.whitened, 0.0)
    mean = filtered.whitened[filtered.used].mean(axis=0) if filtered.used.any() else np.zeros(3)
    return np.asarray(np.where(filtered.used[:, None], rows - mean, 0.0))
