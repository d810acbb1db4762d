"""Statistics of a group of columns in a regression: score, evidence, and uninformative
directions.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter import regression_statistics
from ahrsd.diagnosis.innovation_filter.regression_statistics import (
    log_bayes_factor,
    posterior_probabilities,
    projected_score,
    solve_semidefinite,
)

VALUES = np.random.default_rng(0).standard_normal((500, 3))


def test_direction_counts_if_one_prior_deviation_is_detectable():
    effect = EFFECTS["mag_bias_temperature"]
    assert effect.least_information == pytest.approx((3 / 50) ** 2)
    scale = np.array([one.scale for one in effect.parameters])
    G = np.diag([0.1, 0.1, 1e-4]) / np.outer(scale, scale)
    s = np.array([3.0, 0.0, 0.0]) / scale
    assert projected_score(G, s, np.diag(G), scale).rank == 0
    what = projected_score(100 * G, 100 * s, np.diag(G), scale)
    assert what.rank == 2
    np.testing.assert_allclose(what.value, [30 * scale[0], 0.0, 0.0], atol=1e-12)


def test_posterior_probabilities_sum_to_one_and_follow_the_odds():
    found = posterior_probabilities({"a": 3.0, "b": 0.0, "c": 0.0}, {"c": -1.0})
    assert sum(found.values()) == pytest.approx(1.0, abs=1e-12)
    assert found["a"] / found["b"] == pytest.approx(np.exp(3.0))
    assert found["b"] / found["c"] == pytest.approx(np.e)


def test_direction_without_information_is_zero():
    G = np.diag([4.0, 1.0, 0.0]) + 0.0
    np.testing.assert_allclose(
        solve_semidefinite(G, np.array([[8.0], [3.0], [0.0]]))[:, 0], [2.0, 3.0, 0.0]
    )


def scored(X, e, scale):
    """The score of columns (n, p) in unit noise (n,)."""
    return projected_score(X.T @ X, X.T @ e, np.einsum("ij,ij->j", X, X), np.asarray(scale))


def slow(rng, width):
    """(4800, width) slow columns."""
    return lfilter([1.0], [1.0, -0.98], rng.standard_normal((4800, width)), axis=0)


def test_log_bayes_factor_equals_the_closed_form_for_one_column():
    rng = np.random.default_rng(6)
    X = slow(rng, 1)
    what = scored(X, 0.02 * X[:, 0] + rng.standard_normal(4800), [1.0])
    information, s = float(what.information[0]), float(what.score[0])
    sized = [
        0.5 * s**2 / (information + k**-2) - 0.5 * np.log1p(information * k**2)
        for k in priors.EFFECT_GRID
    ]
    expected = np.logaddexp.reduce(sized) - np.log(len(priors.EFFECT_GRID))
    assert log_bayes_factor(what) == pytest.approx(expected, rel=1e-12)


def test_smaller_model_has_more_evidence_than_one_that_contains_it():
    rng = np.random.default_rng(7)
    X = slow(rng, 4)
    e = 0.05 * X[:, 0] + rng.standard_normal(4800)
    one = log_bayes_factor(scored(X[:, :1], e, np.ones(1)))
    four = log_bayes_factor(scored(X, e, np.ones(4)))
    assert one > four + 3 > 20


def test_evidence_hardly_depends_on_the_scale_of_a_coefficient():
    """A field per ampere of a motor that draws fifty, and one per thousand turns of its shaft."""
    rng = np.random.default_rng(9)
    X = slow(rng, 3)
    e = X @ np.full(3, 0.03) + rng.standard_normal(4800)
    small = scored(X, e, np.full(3, 1.0))  # a value of 3 % of the usual scale
    usual = scored(X, e, np.full(3, 0.1))
    assert small.value == pytest.approx(usual.value)
    assert log_bayes_factor(small) == pytest.approx(log_bayes_factor(usual), abs=0.6)


def test_tail_probabilities_equal_those_of_scipy():
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


def test_student_density_of_unit_variance_equals_that_of_scipy():
    for freedom in (2.2, 5.0, 60.0):
        scale = np.sqrt((freedom - 2) / freedom)
        expected = stats.t.logpdf(VALUES, freedom, scale=scale)
        found = regression_statistics.student_log_density(VALUES, freedom)
        np.testing.assert_allclose(found, expected, rtol=1e-10)
