"""Switching sources: states of a Markov chain, change points, and the law of an interval."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.search.search_space import build_search_space
from ahrsd.diagnosis.inference.search.switching_sources import (
    IntervalLaw,
    change_points,
    find_switching_sources,
    most_probable_states,
)
from ahrsd.diagnosis.track import Spec

PIECE_S, ROWS = 0.2, 5


def squares(left: np.ndarray) -> np.ndarray:
    """Squared sums of the rows of each piece."""
    return np.sum(left.reshape(-1, ROWS, 3).sum(axis=1) ** 2, axis=1)


def test_most_probable_states_have_the_prior_odds_of_their_chain():
    left = np.random.default_rng(1).standard_normal((600 * ROWS, 3))
    on = np.zeros(600, dtype=bool)
    on[100:110] = on[400:407] = True
    left += np.repeat(on, ROWS)[:, None] * [4.0, 0.0, -3.0]
    found, log_odds = most_probable_states(squares(left), np.full(600, float(ROWS)), PIECE_S)
    np.testing.assert_array_equal(found, on)
    stays_on, stays_off = np.exp(-PIECE_S / priors.SPELL_S), np.exp(-PIECE_S / priors.BETWEEN_S)
    chain = 581 * np.log(stays_off) + 15 * np.log(stays_on)
    chain += 2 * np.log((1 - stays_on) * (1 - stays_off))
    assert log_odds == pytest.approx(chain, abs=1e-9)


def test_noise_has_no_on_state_and_no_change_points():
    left = np.random.default_rng(2).standard_normal((3000, 3))
    found, _ = most_probable_states(squares(left), np.full(600, float(ROWS)), PIECE_S)
    assert not found.any()
    assert change_points(left, 10) == []


def test_pieces_below_the_noise_level_are_off():
    found, log_odds = most_probable_states(np.zeros(50), np.full(50, float(ROWS)), PIECE_S)
    assert not found.any()
    assert log_odds == pytest.approx(-50 * PIECE_S / priors.BETWEEN_S)


def test_change_points_are_found_at_their_rows():
    left = np.random.default_rng(3).standard_normal((2000, 3))
    for row, change in ((400, 6.0), (700, -6.0), (705, 0.0), (1500, 5.0)):
        left[row:, 1] += change
    found = np.array(change_points(left, 10))
    assert len(found) == 3
    assert np.abs(found - [400, 700, 1500]).max() <= 1


def test_slopes_of_the_interval_law_agree_with_finite_differences():
    law = IntervalLaw(np.array([0.0, 0.5, 1.0, 3.0]), 1e-3)
    psi = np.array([0.4, 0.7])
    assert law.log_variance(psi)[0] == pytest.approx(2 * np.log(1e-3) + 0.8)
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        ahead, behind = law.log_variance(psi + step), law.log_variance(psi - step)
        np.testing.assert_allclose(law.slope(psi)[:, k], (ahead - behind) / 2e-6, atol=1e-6)
    volume = np.prod(law.high - law.low)
    assert law.log_prior(psi)[0] == pytest.approx(-np.log(volume))
    np.testing.assert_array_equal(law.log_prior(psi)[1], [0.0, 0.0])


@pytest.mark.slow
def test_intervals_are_found_within_a_second_and_trials_are_not_kept():
    track = replace(track_of(experiment("wam", seed=22, samples=3000)), accel_b_m_s2=None)
    since_s = track.time_s - track.time_s[0]
    true = [(20.0, 22.0), (50.0, 51.5), (80.0, 83.0)]
    on = np.any([(since_s >= a) & (since_s < b) for a, b in true], axis=0)
    lamp = on[:, None] * np.array([0.02, -0.015, 0.01])
    track = replace(track, mag_b_gauss=track.mag_b_gauss + lamp)
    problem, cold = build_problem(track, Spec())
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    all_sets, _ = build_search_space(
        richest_model.fit_richest_model(problem, fit.filtered, EFFECTS), EFFECTS, ()
    )
    nothing = all_sets.judge(())
    known = set(all_sets.made.seen)
    comes = [one for one in find_switching_sources(all_sets, nothing) if "spans_s" in one.setting]
    assert [one.frame for one in comes] == ["sensor", "world"]
    assert all_sets.made.seen.keys() == known
    told = np.array(comes[0].setting["spans_s"]) - track.time_s[0]
    assert told.shape == (3, 2)
    np.testing.assert_allclose(told, true, atol=1.0)
    assert comes[0].columns.mag is not None
    outside = ~np.any([(since_s >= a - 1.0) & (since_s < b + 1.0) for a, b in true], axis=0)
    at_rows = np.interp(problem.track.time_s, track.time_s, outside) > 0.5
    assert not np.any(comes[0].columns.mag[at_rows])


def runs_once(begin_s: float, end_s: float, gauss: float):
    """A recording with iron that oscillates up to twice a second in one interval, and its field."""
    track = replace(track_of(experiment("wam", seed=23, samples=3000)), accel_b_m_s2=None)
    since_s = track.time_s - track.time_s[0]
    turned = np.random.default_rng(4).standard_normal((len(track), 3))
    turned = np.apply_along_axis(np.convolve, 0, turned, np.hanning(13) / 2.0, "same")
    added = gauss * ((since_s >= begin_s) & (since_s < end_s))[:, None] * turned
    return replace(track, mag_b_gauss=track.mag_b_gauss + added), added


@pytest.mark.slow
def test_source_that_is_on_once_for_seven_seconds_is_unknown_in_its_interval():
    """A single interval is a source."""
    track, _ = runs_once(56.0, 63.0, 0.005)
    found = diagnose(track)
    left = found.unexplained
    assert found.findings == ()
    assert left.detected
    assert left.where.frame == "sensor"
    assert left.evidence_nats > 30.0
    told_s = np.array(left.where.intervals_s) - track.time_s[0]
    np.testing.assert_allclose([told_s.min(), told_s.max()], [56.0, 63.0], atol=1.0)


@pytest.mark.slow
def test_short_interval_has_the_true_size_and_direction():
    """Size and direction are taken within the interval; time segments of the whole recording
    would miss it.
    """
    track, added = runs_once(60.0, 62.0, 0.01)
    left = diagnose(track).unexplained
    assert left.detected
    (span,) = np.array(left.where.intervals_s) - track.time_s[0]
    np.testing.assert_allclose(span, [60.0, 62.0], atol=1.0)
    along = added @ np.array(left.where.direction)
    assert left.size == pytest.approx(np.ptp(along), rel=0.4)
    assert along.std() > 0.8 * np.linalg.norm(added.std(axis=0)) / np.sqrt(3)
