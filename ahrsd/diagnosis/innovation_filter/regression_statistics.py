"""Statistics of a regression on innovations: tail probabilities, scores, Bayes factors.

The tail probabilities use special functions, because importing scipy.stats takes more time than
the effect search of a short recording.

A score (`Score`) is that of one group of columns, all others projected out.  In units of one prior
deviation per parameter (theta = scale * phi) the projected information is diagonalised, G = V
diag(l) V^T.  Directions that one prior deviation would not show (l < 1) are left out, so that the
degrees of freedom are those that the motion makes observable.

A Bayes factor (`log_bayes_factor`) is relative to the calibration alone.  A group with information
l_i and score s_i in its observable directions, in prior deviations, and prior N(0, k^2) has

    log BF(k) = 1/2 sum_i s_i^2 / (l_i + k^-2) - 1/2 sum_i log(1 + k^2 l_i)

averaged over the sizes k of `priors.EFFECT_GRID`: how large an effect is on a given vehicle is
hardly known.  The same field may be a hundredth of a usual coefficient per ampere (the motor draws
fifty) and a third of one per turn of its shaft.  The grid reaches far enough down that neither is
penalised for its unit. The second sum is the Occam penalty of the parameters, by which the
one-parameter time lag wins over nine eddy-current coefficients that contain it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import special

from ahrsd.diagnosis import priors
from ahrsd.samples import Array

#: directions with less than this share of the group's own information count as not observable
_RANK_SHARE = 1e-7


def chi2_above(value: float, freedom: float) -> float:
    """Probability that a chi-square of `freedom` exceeds the value."""
    return float(special.chdtrc(freedom, value))


def chi2_below(value: float, freedom: float) -> float:
    """Probability that a chi-square of `freedom` is below the value."""
    return float(special.chdtr(freedom, value))


def kolmogorov_above(value: float) -> float:
    """Probability that Kolmogorov's distance times the root of the count exceeds the value."""
    return float(special.kolmogorov(value))


def student_quantile(share: float, freedom: float) -> float:
    """The quantile of a Student-t of `freedom` at probability `share`."""
    return float(special.stdtrit(freedom, share))


def student_log_density(values: Array, freedom: float) -> Array:
    """Log density of a Student-t that is scaled to variance 1; freedom > 2."""
    scale2 = freedom - 2.0
    half = (freedom + 1) / 2
    constant = special.gammaln(half) - special.gammaln(freedom / 2) - 0.5 * np.log(np.pi * scale2)
    return np.asarray(constant - half * np.log1p(values**2 / scale2))


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Score of one group of columns; r observable directions of its p parameters.

    basis:       (p, r) theta = basis @ z, z in prior deviations
    information: (r,) of z;  score: (r,)
    """

    basis: Array
    information: Array
    score: Array

    @property
    def rank(self) -> int:
        """Number of observable directions."""
        return len(self.information)

    @property
    def value(self) -> Array:
        """(p,) least-squares parameters, zero in unobservable directions."""
        return np.asarray(self.basis @ (self.score / self.information))


def projected_score(G: Array, s: Array, information: Array, scale: Array) -> Score:
    """The score of one group from its projected information (p, p) and score (p,).

    information: (p,) before anything was projected out
    """
    whole = G * scale[:, None] * scale
    values, vectors = np.linalg.eigh((whole + whole.T) / 2)
    before = float(np.sum(information * scale**2))
    kept = values > max(1.0, _RANK_SHARE * before)
    V = vectors[:, kept]
    return Score(scale[:, None] * V, values[kept], (s * scale) @ V)


def solve_semidefinite(G: Array, right: Array) -> Array:
    """G^+ right for a positive semi-definite G, columns scaled to unit information."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(G * scale[:, None] * scale)
    kept = values > _RANK_SHARE * 1e-3 * len(values)
    basis = vectors[:, kept]
    inner = (basis.T @ (scale[:, None] * right)) / values[kept][:, None]
    return np.asarray(scale[:, None] * (basis @ inner))


def log_bayes_factor(what: Score) -> float:
    """Log Bayes factor of the group against its absence, nats."""
    if what.rank == 0:
        return 0.0
    l, s = what.information, what.score  # noqa: E741
    k2 = np.square(np.asarray(priors.EFFECT_GRID))[:, None]
    terms = 0.5 * np.sum(s**2 / (l + 1.0 / k2), axis=1) - 0.5 * np.sum(np.log1p(k2 * l), axis=1)
    return float(np.logaddexp.reduce(terms) - np.log(len(priors.EFFECT_GRID)))


def posterior_probabilities(
    log_evidence: Mapping[str, float], log_prior: Mapping[str, float]
) -> dict[str, float]:
    """Probabilities of the hypotheses; they sum to 1.  A missing prior is log 1."""
    hypotheses = list(log_evidence)
    values = np.array(
        [log_evidence[hypothesis] + log_prior.get(hypothesis, 0.0) for hypothesis in hypotheses]
    )
    share = np.exp(values - np.max(values, initial=-np.inf))
    return dict(zip(hypotheses, (share / share.sum()).tolist(), strict=True))


#: lower peaks of the smoothed spectrum are its own scatter
CLEAR_PEAK = 1.35


def spectral_peak(innovation: Array, rate_hz: float, reach_s: float = 3.0) -> float:
    """Largest power density of whitened innovations (N, 3), relative to white noise.

    Bartlett's spectrum over `reach_s`, averaged over the axes, at least 1.  Noise correlated over
    about a second counts in full; the slow and small traces of an effect near its detection limit
    hardly do. The filter takes the slowest noise away, so the peak is seldom at zero frequency.
    """
    reach = min(max(1, round(reach_s * rate_hz)), len(innovation) // 4)
    size = 1 << (len(innovation) + reach).bit_length()
    spectrum = np.abs(np.fft.rfft(innovation - innovation.mean(axis=0), n=size, axis=0)) ** 2
    lags = np.fft.irfft(spectrum.mean(axis=1), n=size)[: reach + 1] / len(innovation)
    tapered = lags * (1.0 - np.arange(reach + 1) / (reach + 1))
    density = np.fft.rfft(np.concatenate([tapered, tapered[:0:-1]])).real
    peak = float(density.max())
    return max(1.0, float(density[0]), peak if peak > CLEAR_PEAK else 1.0)
