"""Bayes factors against the calibration alone, and what they say together.

A group with information l_i and score s_i in its observable directions, in prior deviations, and
prior N(0, k^2) has

    log BF(k) = 1/2 sum_i s_i^2 / (l_i + k^-2) - 1/2 sum_i log(1 + k^2 l_i)

averaged over the sizes k of `SIZES`: how large an effect is on a given vehicle is hardly known.
The same field may be a hundredth of a usual coefficient per ampere (the motor draws fifty) and a
third of one per turn of its shaft; the sizes reach far enough down that neither pays for its unit.
The second sum is the price of a parameter, by which the one-parameter time lag beats nine
eddy-current coefficients that contain it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.innovation_filter.score import Score
from ahrsd.samples import Array

SIZES = (0.01, 0.033, 0.1, 0.33, 1.0, 3.0)


def log_bayes(what: Score) -> float:
    """Log Bayes factor of the group against its absence, nats."""
    if what.rank == 0:
        return 0.0
    l, s = what.information, what.score  # noqa: E741
    k2 = np.square(np.asarray(SIZES))[:, None]
    terms = 0.5 * np.sum(s**2 / (l + 1.0 / k2), axis=1) - 0.5 * np.sum(np.log1p(k2 * l), axis=1)
    return float(np.logaddexp.reduce(terms) - np.log(len(SIZES)))


def posterior(
    log_evidence: Mapping[str, float], log_prior: Mapping[str, float]
) -> dict[str, float]:
    """Probabilities of the hypotheses; they sum to 1.  A missing prior is log 1."""
    names = list(log_evidence)
    values = np.array([log_evidence[name] + log_prior.get(name, 0.0) for name in names])
    share = np.exp(values - np.max(values, initial=-np.inf))
    return dict(zip(names, (share / share.sum()).tolist(), strict=True))


#: peaks of the smoothed spectrum below this are its own scatter
CLEAR_PEAK = 1.35


def colour(innovation: Array, rate_hz: float, reach_s: float = 3.0) -> float:
    """Power of whitened innovations (N, 3) where their spectrum is strongest over white noise's.

    Bartlett's spectrum over `reach_s`, averaged over the axes, at least 1: correlated noise of a
    second or so counts in full, the slow and small traces of an effect near its limit hardly do.
    The filter takes the slowest noise away, so the peak is seldom at zero frequency.
    """
    reach = min(max(1, round(reach_s * rate_hz)), len(innovation) // 4)
    size = 1 << (len(innovation) + reach).bit_length()
    spectrum = np.abs(np.fft.rfft(innovation - innovation.mean(axis=0), n=size, axis=0)) ** 2
    lags = np.fft.irfft(spectrum.mean(axis=1), n=size)[: reach + 1] / len(innovation)
    tapered = lags * (1.0 - np.arange(reach + 1) / (reach + 1))
    density = np.fft.rfft(np.concatenate([tapered, tapered[:0:-1]])).real
    peak = float(density.max())
    return max(1.0, float(density[0]), peak if peak > CLEAR_PEAK else 1.0)
