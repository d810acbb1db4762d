"""Tests have the size that they claim, under white and under red noise, and find what is there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal, stats

from ahrsd.diagnosis.innovation_filter.evidence import colour, log_bayes
from ahrsd.diagnosis.innovation_filter.score import score
from ahrsd.diagnosis.rules.gram import block_edges, gram
from ahrsd.diagnosis.rules.locate import log_bayes_walk
from ahrsd.diagnosis.rules.score import chi2_p, f_above, robust_p, shift_statistics

COUNT, RATE_HZ = 1600, 10.0


def regression(rng, share=0.0, theta=0.0, width=3):
    """Slow columns and noise of which `share` has a time constant of a second."""
    time_s = np.arange(COUNT) / RATE_HZ
    keep = np.exp(-1 / RATE_HZ)
    X = signal.lfilter([1.0], [1.0, -0.98], rng.standard_normal((COUNT, 3, width)), axis=0)
    red = signal.lfilter(
        [np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal((COUNT, 3)), axis=0
    )
    e = np.sqrt(1 - share) * rng.standard_normal((COUNT, 3)) + np.sqrt(share) * red
    e = e + X @ np.full(width, theta)
    whole = gram({"x": X}, e, time_s, block_edges(time_s, 2.0))
    return whole, e, X


def p_values(test, share, runs=250):
    rng = np.random.default_rng(5)
    return np.array([test(*regression(rng, share)) for _ in range(runs)])


def test_score_statistic_is_uniform_under_white_noise():
    p = p_values(lambda g, e, X: chi2_p(score(g, "x", np.ones(3))), 0.0)
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_robust_test_keeps_its_size_where_the_plain_one_does_not():
    plain = p_values(lambda g, e, X: chi2_p(score(g, "x", np.ones(3))), 0.2)
    robust = p_values(lambda g, e, X: robust_p(score(g, "x", np.ones(3))), 0.2)
    assert np.mean(plain < 0.01) > 0.15
    assert np.mean(robust < 0.01) < 0.04


def test_dividing_by_the_colour_keeps_the_size_too():
    p = p_values(lambda g, e, X: chi2_p(score(g, "x", np.ones(3)), colour(e, RATE_HZ)), 0.2)
    assert np.mean(p < 0.01) < 0.04


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_what_a_small_part_of_the_recording_shows_is_proved_by_it(share):
    """A bump of the field has seven blocks of eighty: they cannot vouch for each other's noise."""
    rng = np.random.default_rng(11)
    found, false = [], []
    for _ in range(40):
        _, e, X = regression(rng, share)
        X = X.copy()
        X[:640], X[840:] = 0.0, 0.0
        time_s = np.arange(COUNT) / RATE_HZ
        noise = colour(e, RATE_HZ)
        for theta, kept in ((0.3, found), (0.0, false)):
            whole = gram({"x": X}, e + X @ np.full(3, theta), time_s, block_edges(time_s, 2.0))
            kept.append(robust_p(score(whole, "x", np.ones(3)), noise))
    assert 5 < score(whole, "x", np.ones(3)).effective_blocks < 10
    assert np.median(found) < 1e-9
    assert np.mean(np.array(false) < 0.01) < 0.08


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_an_effect_is_found_and_its_value_is_right(share):
    whole, e, _ = regression(np.random.default_rng(2), share, theta=0.05)
    what = score(whole, "x", np.ones(3))
    assert chi2_p(what, colour(e, RATE_HZ)) < 1e-6
    assert robust_p(what) < 1e-6
    np.testing.assert_allclose(what.value, 0.05, atol=0.02)


def test_shifted_copies_do_not_reach_a_real_effect():
    _, e, X = regression(np.random.default_rng(3), theta=0.05)
    found, shifted = shift_statistics(X, e, 80)
    assert found > shifted.max()
    _, e, X = regression(np.random.default_rng(3), theta=0.0)
    found, shifted = shift_statistics(X, e, 80)
    assert np.mean(shifted < found) < 0.999


def test_directions_that_one_prior_deviation_would_not_show_are_left_out():
    whole, _, _ = regression(np.random.default_rng(4))
    assert score(whole, "x", np.array([1.0, 1.0, 1e-9])).rank == 2


def test_evidence_is_the_closed_form_of_one_size():
    whole, _, _ = regression(np.random.default_rng(6), theta=0.02, width=1)
    what = score(whole, "x", np.ones(1))
    information, s = float(what.information[0]), float(what.score[0])
    expected = 0.5 * s**2 / (information + 4.0) - 0.5 * np.log1p(information / 4.0)
    assert log_bayes(what, 1.0, (0.5,)) == pytest.approx(expected, rel=1e-12)


def test_a_smaller_family_wins_over_one_that_contains_it():
    _, _, X = regression(np.random.default_rng(7), theta=0.0, width=4)
    e = X[:, :, 0] * 0.05 + np.random.default_rng(8).standard_normal((COUNT, 3))
    time_s = np.arange(COUNT) / RATE_HZ
    both = gram({"one": X[:, :, :1], "all": X}, e, time_s, block_edges(time_s, 2.0))
    one = log_bayes(score(both.select(["one"]), "one", np.ones(1)))
    four = log_bayes(score(both.select(["all"]), "all", np.ones(4)))
    assert one > four + 3 > 20


def test_a_coefficient_pays_nothing_for_its_unit():
    """A field per ampere of a motor that draws fifty, and one per thousand turns of its shaft."""
    whole, _, _ = regression(np.random.default_rng(9), theta=0.03)
    small = score(whole, "x", np.full(3, 1.0))  # a value of 3 % of the usual one
    usual = score(whole, "x", np.full(3, 0.1))
    assert small.value == pytest.approx(usual.value)
    assert log_bayes(small) == pytest.approx(log_bayes(usual), abs=0.6)
    assert log_bayes(small, 1.0, (0.1, 0.33, 1.0, 3.0)) < log_bayes(usual) - 1.5


def test_a_wandering_course_is_likelier_as_a_walk_than_as_independent_segments():
    rng = np.random.default_rng(9)
    walk = np.cumsum(rng.standard_normal((30, 3)), axis=0) * 0.2
    G = np.eye(90) * 10.0
    s = 10.0 * (walk - walk.mean(0)).ravel() + np.sqrt(10.0) * rng.standard_normal(90)
    sizes = np.array([0.1, 0.3, 1.0])
    walked = log_bayes_walk(G, s, 3, sizes)
    shuffled = s.reshape(30, 3)[rng.permutation(30)].ravel()
    assert walked > log_bayes_walk(G, shuffled, 3, sizes) + 10


def test_f_s_tail_is_that_of_the_distribution():
    assert f_above(3.1, 3, 36.5) == pytest.approx(stats.f.sf(3.1, 3, 36.5), rel=1e-12)
