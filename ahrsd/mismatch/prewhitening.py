"""Coloured innovations made white: generalised least squares for what lives in brisk turns.

The filter whitens what its noise model explains.  What is left (red magnetometer noise, the
field of a building) makes the innovations e~ correlated, and evidence is divided by their power at
low frequency.  That is right for slow effects and far too much for a delay, which shows itself in
brisk turns only.  The prediction-error filter of the autocorrelation, tapered to REACH_S, applied
to e~ and to the columns alike keeps the regression and makes its noise white, so that a delay is
weighed against the noise of brisk turns.
"""

from __future__ import annotations

import numpy as np
from scipy import fft, linalg

from ahrsd.samples import Array

REACH_S = 3.0
#: autocorrelations below this many deviations of their own are none
SIGNIFICANT = 4.5


def prediction_error_filter(innovation: Array, rate_hz: float) -> Array:
    """Taps (k,) that make (N, 3) innovations white, of variance 1; one tap where they are white."""
    lags = _autocorrelation(innovation, rate_hz)
    level = SIGNIFICANT * lags[0] / np.sqrt(3.0 * len(innovation))
    if lags[0] <= 0.0:
        return np.ones(1)
    if np.all(np.abs(lags[1:]) < level):
        return np.array([1.0 / float(np.sqrt(lags[0]))])
    taps = np.concatenate([[1.0], -_predictor(lags)])
    return np.asarray(taps / float(np.std(prewhitened(taps, innovation))), float)


def _autocorrelation(innovation: Array, rate_hz: float) -> Array:
    """Lags 0 ... REACH_S, mean over the axes."""
    count = len(innovation)
    reach = min(max(1, round(REACH_S * rate_hz)), count // 8)
    size = fft.next_fast_len(count + reach + 1, real=True)
    spectrum = (np.abs(fft.rfft(innovation, n=size, axis=0)) ** 2).sum(axis=1)
    return np.asarray(fft.irfft(spectrum, n=size)[: reach + 1] / (3 * count), float)


def _predictor(lags: Array) -> Array:
    """Coefficients of the best linear prediction from the tapered lags."""
    tapered = lags * (1.0 - np.arange(len(lags)) / len(lags))
    return np.asarray(linalg.solve_toeplitz(tapered[:-1], tapered[1:]), float)


def prewhitened(taps: Array, values: Array) -> Array:
    """(N, ...) values convolved with the taps along time, causal."""
    if len(taps) == 1:
        return np.asarray(values * taps[0], float)
    count = len(values)
    flat = np.ascontiguousarray(values.reshape(count, -1).T)
    size = fft.next_fast_len(count + len(taps) - 1, real=True)
    product = fft.rfft(flat, n=size, axis=1) * fft.rfft(taps, n=size)
    out = fft.irfft(product, n=size, axis=1)[:, :count]
    return np.asarray(np.ascontiguousarray(out.T).reshape(values.shape), float)
