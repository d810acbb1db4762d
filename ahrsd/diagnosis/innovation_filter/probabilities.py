"""Tail probabilities of the usual distributions, as special functions.

(Importing scipy's statistics costs more time than a short recording's search for names.)
"""

from __future__ import annotations

import numpy as np
from scipy import special

from ahrsd.samples import Array


def chi2_above(value: float, freedom: float) -> float:
    """Probability that a chi-square of `freedom` is larger."""
    return float(special.chdtrc(freedom, value))


def chi2_below(value: float, freedom: float) -> float:
    """Probability that a chi-square of `freedom` is smaller."""
    return float(special.chdtr(freedom, value))


def kolmogorov_above(value: float) -> float:
    """Probability that Kolmogorov's distance, times the root of the number, is larger."""
    return float(special.kolmogorov(value))


def student_quantile(share: float, freedom: float) -> float:
    """What a Student-t of `freedom` is below with this probability."""
    return float(special.stdtrit(freedom, share))


def student_log_density(values: Array, freedom: float) -> Array:
    """Log density of a Student-t that is scaled to variance 1; freedom > 2."""
    scale2 = freedom - 2.0
    half = (freedom + 1) / 2
    constant = special.gammaln(half) - special.gammaln(freedom / 2) - 0.5 * np.log(np.pi * scale2)
    return np.asarray(constant - half * np.log1p(values**2 / scale2))
