"""The noise law of the whitened innovations: colour, tails, and when it changed.

Colour: autoregression over time, the same on the three axes; its order by the Bayesian criterion.
It is simulated with the repaired model, so that its bands are as wide as the recording's noise.

Level: half the mean square of successive differences per block, which no slow misfit enters, so a
field that the model does not know is not called noise.
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

_MOST = 12  # order of the autoregression
_FREQUENCIES = 4096  # of a spectrum
_FLOOR = 1e-6  # white part of a colour, at least
_BLOCK_S = 2.0
_FINE_S, _PASSES = 1.0, 4  # in which bursts are told apart


@dataclass(frozen=True, slots=True, eq=False)
class Colour:
    """e_k = sum_j coefficients_j e_(k-j) + white of `variance`; no coefficients: white."""

    coefficients: Array
    variance: float

    @property
    def order(self) -> int:
        """How many samples back it reaches."""
        return len(self.coefficients)

    @property
    def power(self) -> Array:
        """(_FREQUENCIES / 2 + 1,) spectral density, per row."""
        taps = np.concatenate([[1.0], -self.coefficients])
        return np.asarray(self.variance / np.abs(np.fft.rfft(taps, _FREQUENCIES)) ** 2)


def colour_of(done: Filtered) -> Colour:
    """Autoregression of the whitened innovations."""
    rows = _centred(done)
    count = max(float(np.count_nonzero(done.used)) * 3, 1.0)
    r = np.array(
        [float(np.sum(rows[lag:] * rows[: len(rows) - lag])) / count for lag in range(_MOST + 1)]
    )
    if r[0] < 1e-18:
        return Colour(np.zeros(0), 1.0)
    best, best_value, variance = np.zeros(0), count * np.log(max(r[0], 1e-300)), r[0]
    for order in range(1, min(_MOST, int(count) // 60) + 1):
        a = solve_toeplitz(r[:order], r[1 : order + 1])
        left = float(r[0] - a @ r[1 : order + 1])
        value = count * np.log(max(left, 1e-300)) + order * np.log(count)
        if value < best_value - 2.0:
            best, best_value, variance = np.asarray(a), value, left
    return Colour(best, float(variance))


def colour_before_filter(wanted: Colour, found: Colour) -> tuple[Colour, float]:
    """The colour that becomes `wanted` where `wanted` became `found`, and its relative deviation.

    A filter takes a part of slow noise for motion, so that innovations are whiter than the noise.
    """
    r = np.fft.irfft(wanted.power**2 / found.power)[: _MOST + 1]
    r[0] *= 1.0 + _FLOOR
    a = np.asarray(solve_toeplitz(r[:-1], r[1:]))
    whole = float(np.fft.irfft(wanted.power)[0])
    return Colour(a, float(r[0] - a @ r[1:])), float(np.sqrt(r[0] / whole))


def freedom_of(done: Filtered) -> float:
    """Of the likeliest Student-t of the innovations' white part, all axes; inf for no tails."""
    e = done.whitened[done.used].ravel()
    if len(e) < 30:
        return float("inf")
    z = (e - e.mean()) / max(float(e.std()), 1e-300)
    kurtosis = float(np.mean(z**4) - 3.0)
    deviation = float(np.sqrt(24.0 / len(z)))
    return _freedom(z) if kurtosis > 3 * deviation else float("inf")


def _freedom(z: Array) -> float:
    """Most likely freedom of the Student-t of values of variance 1; kurtosis says little of it."""
    tried = np.exp(np.linspace(np.log(2.2), np.log(60.0), 34))
    nats = [float(np.sum(student_log_density(z, v))) for v in tried]
    return float(tried[int(np.argmax(nats))])


def levels(
    done: Filtered, block_s: float = _BLOCK_S, most: float = np.inf
) -> tuple[Array, Array, Array]:
    """Middle (B,), white variance of the whitened innovations (B,), and their number (B,).

    most: square of a difference beyond which it counts as that much
    """
    track = done.track
    pairs = done.used[1:] & done.used[:-1]
    squares = np.minimum(np.diff(done.whitened, axis=0) ** 2, most)
    half = np.where(pairs, np.sum(squares, axis=1) / 2, 0.0)
    block = ((track.time_s[1:] - track.time_s[0]) / block_s).astype(int)
    size = np.asarray(np.bincount(block, weights=3.0 * pairs), dtype=np.float64)
    total = np.bincount(block, weights=half, minlength=len(size))
    kept = size >= 15
    middle = track.time_s[0] + (np.arange(len(size)) + 0.5) * block_s
    return middle[kept], total[kept] / size[kept], size[kept]


@dataclass(frozen=True, slots=True)
class Louder:
    """Noise at two levels: seconds at the louder one, white variances of the whitened innovations.

    burst: it comes and goes; else it changed once
    """

    spans_s: tuple[tuple[float, float], ...]
    loud: float
    quiet: float
    burst: bool


def louder(done: Filtered) -> Louder | None:
    """Where the noise is at a louder level than elsewhere; None where it has one level."""
    middle, variance, size = levels(done)
    if len(middle) < 10 or not np.any(variance > 1e-18):
        return None
    # one reading far out is no louder noise
    most = priors.LOUDER_OUTLIER**2 * 2.0 * _middle_variance(done) or np.inf
    clipped = levels(done, most=most)[1]
    first, last, gain = _loudest(clipped, size / _worth(done, most))
    inside = np.zeros(len(middle), dtype=bool)
    inside[first:last] = True
    sides = loud, quiet = _sides(variance, size, inside)
    if (
        gain <= priors.LOUDER_NATS
        or loud <= priors.LOUDER_RATIO * quiet
        or not _is_noise(done, middle[inside])
    ):
        return None
    stretch = (float(middle[first] - _BLOCK_S / 2), float(middle[last - 1] + _BLOCK_S / 2))
    spans, loud, quiet = _loud_spans(done, *_sides(clipped, size, inside), most)
    filled = sum(b - a for a, b in spans) / (stretch[1] - stretch[0])
    # what lasts from the beginning or to the end changed once
    amid = first > 0 and last < len(middle)
    short = amid and last - first <= priors.BURST_SHARE * len(middle)
    if loud < priors.LOUDER_RATIO * quiet:  # not two levels that come and go: the one stretch alone
        spans, loud, quiet = [], *sides
    if short or (len(spans) > 1 and filled < priors.BURST_FILLED):
        return Louder(tuple(spans or [stretch]), loud, quiet, burst=True)
    return Louder((stretch,), loud, quiet, burst=False)


def level_facts(done: Filtered, *, spec_given: bool = False) -> list[Fact]:
    """A burst, or a level that changed or is above the spec's."""
    if found := louder(done):
        return [(_burst if found.burst else _level)(done, found)]
    middle, variance, size = levels(done)
    if not spec_given or len(middle) < 10 or not _is_noise(done, middle):
        return []
    # a few outliers are the power of a louder noise, but the level of most readings is the spec's
    overall = min(float(np.average(variance, weights=size)), _middle_variance(done))
    if overall > priors.LEVEL_RATIO and overall > 1 + 6 * np.sqrt(2 * _worth(done) / size.sum()):
        whole = (float(middle[0] - _BLOCK_S / 2), float(middle[-1] + _BLOCK_S / 2))
        return [_level(done, Louder((whole,), overall, 1.0, burst=False))]
    return []


def _worth(done: Filtered, most: float = np.inf) -> float:
    """How many squared differences, each at most `most`, tell as much as one Gaussian reading.

    Neighbouring differences share a sample; heavy tails scatter more than Gaussian ones; what is
    far out on one axis may be on all.
    """
    pairs = done.used[1:] & done.used[:-1]
    rows = np.sum(np.minimum(np.diff(done.whitened, axis=0)[pairs] ** 2, most), axis=1)
    scatter = float(np.var(rows) / np.mean(rows) ** 2)
    return 1.5 * max(scatter / (2.0 / 3.0), 1.0)


def _middle_variance(done: Filtered) -> float:
    """White variance of the whitened innovations from the middle of their differences."""
    d = np.diff(done.whitened, axis=0)[done.used[1:] & done.used[:-1]]
    return float((1.4826 * np.median(np.abs(d))) ** 2 / 2) if len(d) else 0.0


def _is_noise(done: Filtered, blocks: Array) -> bool:
    """Whether what is loud there jumps to and fro, as noise does, or moves, as a misfit does.

    Successive differences of white noise are correlated by -1/2.
    """
    time_s = done.track.time_s
    later = np.searchsorted(blocks, time_s).clip(1, len(blocks) - 1)
    away_s = np.minimum(np.abs(time_s - blocks[later - 1]), np.abs(time_s - blocks[later]))
    near = away_s <= _BLOCK_S / 2
    d = np.diff(done.whitened, axis=0)
    kept = (done.used & near)[2:] & done.used[1:-1] & done.used[:-2]
    square = float(np.sum(d[1:][kept] ** 2))
    return square > 0 and float(np.sum((d[1:] * d[:-1])[kept])) / square < priors.NOISE_OPPOSED


def _loudest(variance: Array, weight: Array) -> tuple[int, int, float]:
    """The stretch of blocks whose own level is most likely: first, behind the last, nats."""
    squares = np.concatenate([[0.0], np.cumsum(variance * weight)])
    weights = np.concatenate([[0.0], np.cumsum(weight)])
    base = weights[-1] * np.log(squares[-1] / weights[-1])
    a, b = np.triu_indices(len(squares), k=1)
    mine, rest = weights[b] - weights[a], weights[-1] - weights[b] + weights[a]
    loud, quiet = squares[b] - squares[a], squares[-1] - squares[b] + squares[a]
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = mine * np.log(loud / mine)
        outer = np.where(rest > 0.5, rest * np.log(quiet / rest), 0.0)
        gain = 0.5 * (base - inner - outer)
        gain[(rest > 0.5) & (loud * rest < quiet * mine)] = 0.0
    best = int(np.nanargmax(gain))
    return int(a[best]), int(b[best]), float(gain[best])


def _sides(variance: Array, size: Array, inside: NDArray[np.bool]) -> tuple[float, float]:
    """Mean of (B,) variances inside and outside; 1 of none."""
    loud, quiet = (
        float(np.average(variance[part], weights=size[part])) if part.any() else 1.0
        for part in (inside, ~inside)
    )
    return loud, quiet


def _loud_spans(
    done: Filtered, loud: float, quiet: float, most: float
) -> tuple[list[tuple[float, float]], float, float]:
    """Where the noise is at the louder of two levels rather than the other; the levels.

    loud, quiet, most: of squares that count as `most` at most
    """
    middle, clipped, size = levels(done, _FINE_S, most)
    weight = size / _worth(done, most)
    on = np.zeros(len(middle), dtype=bool)
    for _ in range(_PASSES):
        nats = 0.5 * weight * (np.log(quiet / loud) + clipped * (1 / quiet - 1 / loud))
        on = nats > 0
        if on.all() or not on.any():
            break
        loud, quiet = _sides(clipped, size, on)
    # a spell may begin in any of the blocks
    price = float(np.log(max(len(middle), 1)))
    kept = [(a, b) for a, b in row_intervals(on, 1) if float(np.sum(nats[a:b])) > price]
    on = np.zeros(len(middle), dtype=bool)
    for a, b in kept:
        on[a:b] = True
    found = [(float(middle[a] - _FINE_S / 2), float(middle[b - 1] + _FINE_S / 2)) for a, b in kept]
    return found, *_sides(levels(done, _FINE_S)[1], size, on)


def _burst(done: Filtered, found: Louder) -> Fact:
    loud, quiet = found.loud, found.quiet
    sigma = done.model.sigma_mag_gauss * float(np.sqrt(max(loud - quiet, 0.0)))
    times = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in found.spans_s)
    words = f"from {times} s the noise is {np.sqrt(loud / quiet):.2g} times its usual level"
    begin, end = found.spans_s[0]
    return Fact(
        "noise_burst",
        words,
        Where(found.spans_s, ("x", "y", "z"), "noise"),
        priors.SURE_OF_NOISE,
        (Value("burst", sigma, sigma * 0.1, "gauss"),),
        {"onset_s": begin, "length_s": end - begin},
    )


def _level(done: Filtered, found: Louder) -> Fact:
    (stretch,), loud, quiet = found.spans_s, found.loud, found.quiet
    begin, end = stretch[0], min(stretch[1], float(done.track.time_s[-1]))
    sigma = done.model.sigma_mag_gauss * float(np.sqrt(max(loud - quiet, 0.0)))
    ratio = float(np.sqrt(loud / quiet))
    words = f"from {begin:.0f} to {end:.0f} s the noise is {ratio:.2g} times its usual level"
    where = Where(((begin, end),), ("x", "y", "z"), "noise")
    parameters = (Value("mag", sigma, sigma * 0.1, "gauss"),)
    falls = begin < done.track.time_s[0] + _BLOCK_S / 2 and end < done.track.time_s[-1]
    setting = {"onset_s": end if falls else begin}
    return Fact("noise_level", words, where, priors.SURE_OF_NOISE, parameters, setting)


def _centred(done: Filtered) -> Array:
    rows = np.where(done.used[:, None], done.whitened, 0.0)
    mean = done.whitened[done.used].mean(axis=0) if done.used.any() else np.zeros(3)
    return np.asarray(np.where(done.used[:, None], rows - mean, 0.0))
