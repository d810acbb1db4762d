"""Filters by banded systems and tails by special functions agree with scipy's own."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import ndimage, signal, stats

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.innovation_filter import regression_statistics

VALUES = np.random.default_rng(0).standard_normal((500, 3))


def test_one_constant_is_lfilter():
    found = time_series.first_order(VALUES, 0.93)
    np.testing.assert_allclose(found, signal.lfilter([1.0], [1.0, -0.93], VALUES, axis=0))
    assert np.array_equal(time_series.first_order(VALUES[:1], 0.93), VALUES[:1])


def test_a_constant_that_changes_is_the_loop():
    keep = np.linspace(0.1, 0.99, len(VALUES) - 1)
    expected = VALUES.copy()
    for k in range(1, len(expected)):
        expected[k] += keep[k - 1] * expected[k - 1]
    np.testing.assert_allclose(time_series.first_order(VALUES, keep), expected, rtol=1e-12)


def test_autoregression_is_lfilter():
    taps = np.array([0.5, -0.2, 0.3])
    found = time_series.autoregression(VALUES, taps[:, None])
    np.testing.assert_allclose(found, signal.lfilter([1.0], [1.0, *-taps], VALUES, axis=0))


def test_both_ways_weighs_by_distance():
    keep = 0.8
    weight = keep ** np.abs(np.subtract.outer(np.arange(500), np.arange(500)))
    np.testing.assert_allclose(time_series.both_ways(VALUES, keep), weight @ VALUES, rtol=1e-9)


@pytest.mark.parametrize("width", [0.4, 3.0, 200.0])
def test_gaussian_is_mirrored_at_the_ends(width):
    expected = ndimage.gaussian_filter1d(VALUES, width, axis=0, mode="reflect")
    np.testing.assert_allclose(time_series.gaussian(VALUES, width), expected, atol=1e-12)


def test_probabilities_are_those_of_the_distributions():
    assert regression_statistics.chi2_above(7.3, 4) == pytest.approx(
        stats.chi2.sf(7.3, 4), rel=1e-12
    )
    assert regression_statistics.chi2_below(7.3, 4) == pytest.approx(
        stats.chi2.cdf(7.3, 4), rel=1e-12
    )
    above = stats.kstwobign.sf(1.1)
    assert regression_statistics.kolmogorov_above(1.1) == pytest.approx(above, rel=1e-9)
    quantile = stats.t.ppf(0.9995, 15)
    assert regression_statistics.student_quantile(0.9995, 15) == pytest.approx(quantile, rel=1e-9)


def test_student_of_variance_one():
    for freedom in (2.2, 5.0, 60.0):
        scale = np.sqrt((freedom - 2) / freedom)
        expected = stats.t.logpdf(VALUES, freedom, scale=scale)
        found = regression_statistics.student_log_density(VALUES, freedom)
        np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_a_diagnosis_of_a_table_loads_neither_the_daemon_nor_what_draws():
    heavy = ("gtsam", "rerun", "matplotlib", "pydantic", "scipy.stats", "scipy.signal", "serial")
    script = f"import sys, ahrsd.offline.diagnose; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
