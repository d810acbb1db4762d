"""Tests of the whitened innovations without an alternative hypothesis: is there any mismatch?

Each gives its statistic and its p-value under the null (Gaussian, white, variance 1), which
`tests/diagnosis/answer/test_omnibus.py` checks to be uniform on simulated nulls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.innovation_filter.innovation import Filtered
from ahrsd.diagnosis.innovation_filter.regression_statistics import (
    chi2_above,
    chi2_below,
    kolmogorov_above,
)
from ahrsd.diagnosis.model import Context
from ahrsd.samples import Array

LAGS = 20


@dataclass(frozen=True, slots=True)
class Test:
    """One test.  expected: the statistic's mean under the null."""

    __test__ = False  # not one of pytest's

    name: str
    value: float
    expected: float
    p_value: float
    words: str


def omnibus_tests(filtered: Filtered, context: Context | None = None) -> tuple[Test, ...]:
    """All tests; those of the variance only with a context.

    None below 100 innovations, where an axis does not vary at all, and where the magnetometer has
    less noise than the fit assumes at least: then the assumed noise along the field is absent, and
    the tests would show nothing else.
    """
    rows = filtered.whitened[filtered.used]
    if len(rows) < 100 or np.any(np.std(rows, axis=0) < 1e-9):
        return ()
    assumed = filtered.model.sigma_mag_gauss <= priors.FLOOR_MAG_GAUSS
    if assumed and np.mean(rows**2) < priors.ABSENT_NOISE:
        return ()
    out = [
        _level_test(rows),
        _ljung_box_test(filtered),
        _periodogram_test(filtered),
        _normality_test(rows),
    ]
    if context is not None:
        out.append(variance_test(filtered, variance_covariates(context)))
    return tuple(out)


def _level_test(rows: Array) -> Test:
    """Normalised innovation squared; 1 by construction where the noise was estimated."""
    total, freedom = float(np.sum(rows**2)), rows.size
    tail = min(chi2_above(total, freedom), chi2_below(total, freedom))
    return Test("normalised_innovation", total / freedom, 1.0, float(min(1.0, 2 * tail)), "level")


def _ljung_box_test(filtered: Filtered) -> Test:
    """Autocorrelation to lag 20 of the three axes together; rows without a reading count as 0."""
    rows = np.where(filtered.used[:, None], filtered.whitened, 0.0)
    count = int(np.count_nonzero(filtered.used))
    power = np.sum(rows**2, axis=0)
    q = 0.0
    for lag in range(1, LAGS + 1):
        rho = np.sum(rows[lag:] * rows[:-lag], axis=0) / power
        q += float(np.sum(rho**2)) * count * (count + 2) / (count - lag)
    freedom = 3 * LAGS
    return Test("ljung_box", q, freedom, chi2_above(q, freedom), "whiteness over time")


def _periodogram_test(filtered: Filtered) -> Test:
    """Bartlett's test: largest distance of the cumulative periodogram from the diagonal."""
    rows = np.where(filtered.used[:, None], filtered.whitened, 0.0)
    power = np.abs(np.fft.rfft(rows - rows.mean(axis=0), axis=0))[1:-1] ** 2
    share = np.cumsum(power, axis=0) / np.sum(power, axis=0)
    count = len(share)
    straight = np.arange(1, count + 1)[:, None] / count
    distance = float(np.max(np.abs(share - straight))) * np.sqrt(count)
    p_value = min(1.0, 3 * kolmogorov_above(distance))
    return Test("cumulative_periodogram", distance, 0.87, p_value, "whiteness over frequency")


def _normality_test(rows: Array) -> Test:
    """Jarque-Bera of the three axes together, each by its own mean and deviation."""
    z = (rows - rows.mean(axis=0)) / rows.std(axis=0)
    skewness = np.mean(z**3, axis=0)
    kurtosis = np.mean(z**4, axis=0) - 3
    value = float(len(rows) * np.sum(skewness**2 / 6 + kurtosis**2 / 24))
    return Test("normality", value, 6.0, chi2_above(value, 6), "tails and skewness")


def variance_covariates(context: Context) -> dict[str, Array]:
    """What the variance may follow: turn rate, change of the field, time, and the covariates."""
    out = {
        "rate": np.linalg.norm(context.rate_b_rad_s, axis=1),
        "field_change": np.sum(context.field_dot_b**2, axis=1),
        "time": context.track.time_s,
    }
    if context.track.accel_b_m_s2 is not None:
        out["acceleration"] = np.linalg.norm(context.track.accel_b_m_s2, axis=1)
    out.update(context.track.covariates)
    return out


def variance_test(filtered: Filtered, columns: Mapping[str, Array]) -> Test:
    """Do the squared innovations depend on any column?  Koenker's n R^2, robust to heavy tails.

    words: the column of largest correlation.
    """
    square = np.sum(filtered.whitened[filtered.used] ** 2, axis=1)
    names, kept = [], []
    for name, values in columns.items():
        used = values[filtered.used]
        if np.isfinite(used).all() and np.std(used) > 1e-9 * (np.abs(used).max() + 1e-300):
            names.append(name)
            kept.append((used - used.mean()) / used.std())
    if not kept:
        return Test("variance", 0.0, 0.0, 1.0, "no column to test")
    X = np.column_stack(kept)
    y = square - square.mean()
    solution, _, rank, _ = np.linalg.lstsq(X, y, rcond=1e-8)
    residual = y - X @ solution
    value = float(len(y) * (1.0 - (residual @ residual) / (y @ y)))
    alone = np.abs(X.T @ y)
    p_value = chi2_above(value, int(rank))
    most = names[int(np.argmax(alone))]
    return Test("variance", value, float(rank), p_value, f"variance, most with {most}")
