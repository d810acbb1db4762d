"""Checks of an answer on recordings whose correct answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtri
from search_spaces import middle_setting, sets_of
from tracks import experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.added_field import (
    calibration_basis,
    project_out_calibration,
    rms_about_mean,
)
from ahrsd.diagnosis.answer.diagnosis import (
    Assumed,
    Finding,
    Heldout,
    OnPriors,
    Unexplained,
    Where,
)
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.answer.held_out import HeldOut, assign_folds
from ahrsd.diagnosis.inference.answer.left_sizes import remainder_sizes
from ahrsd.diagnosis.inference.answer.prior_sensitivity import (
    COURSE,
    EFFECT,
    NOISE,
    ORDINARY,
    prior_sensitivity,
)
from ahrsd.diagnosis.inference.answer.residual_checks import (
    checks,
    fit_residuals,
    regime_maps,
    whiteness,
)
from ahrsd.diagnosis.inference.answer.support import doubts, nearest_effect
from ahrsd.diagnosis.inference.answer.visibility import effect_evidence, limits
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Space
from ahrsd.diagnosis.inference.search.search_space import build_search_space
from ahrsd.diagnosis.track import Spec, Track

CURRENT = np.array([5e-4, -7e-4, 3e-4])
NOTHING = frozenset()


def with_current(track: Track, *, field: bool) -> Track:
    """A logged current that varies at random; `field`: whether it causes a field."""
    seconds = np.arange(0.0, track.duration_s + 8.0, 7.0)
    levels = np.random.default_rng(4).uniform(0.0, 12.0, len(seconds))
    amps = np.interp(track.time_s - track.time_s[0], seconds, levels)
    mag = track.mag_b_gauss + (amps[:, None] * CURRENT if field else 0.0)
    return replace(track, mag_b_gauss=mag, covariates={"motor_current_a": amps})


@pytest.fixture(scope="module")
def track():
    return replace(track_of(experiment("wam", seed=21, samples=3000)), accel_b_m_s2=None)


@pytest.fixture(scope="module")
def idle(track):
    """A current without a field."""
    return sets_of(with_current(track, field=False))


@pytest.fixture(scope="module")
def driven(track):
    """A current with a field."""
    return sets_of(with_current(track, field=True))


def gains(found: tuple[Hypotheses, Space], name: str) -> tuple[float, float]:
    """Held-out gain, in nats over all readings, of an effect and of its best time-shifted copy."""
    all_sets, space = found
    key = middle_setting(space, name)
    held = HeldOut(all_sets, all_sets.judge({key}))
    told = held.held_out_gain((key,))
    return told.nll_gain_per_sample * held.samples, told.placebo_gain * held.samples


def test_nearest_effect_is_compared_with_an_unknown_cause_in_its_place(track):
    """As in the decision: compared with no effect it may exceed the required odds."""
    all_sets, space = sets_of(with_current(track, field=True))
    bare, key = all_sets.judge(()), middle_setting(space, "motor_current_field")
    answer = Answer(bare, (), (), {}, (), (), Unexplained(False), 0.0)
    named = all_sets.judge({key})
    (alone,) = nearest_effect(answer, all_sets)
    assert f"motor_current_field: {named.score - bare.score:+.1f} nats over no effect" in alone
    free = all_sets.judge({space.courses[0]})
    assert free.score > bare.score
    (beside,) = nearest_effect(answer, all_sets)
    assert f"motor_current_field: {named.score - free.score:+.1f} nats over an unknown" in beside


def test_set_with_too_many_coefficients_is_skipped_as_a_candidate(idle, monkeypatch):
    all_sets, space = idle
    key = middle_setting(space, "motor_current_field")
    bare, course = all_sets.judge(()), space.courses[0]
    width = all_sets.component(course).width
    monkeypatch.setattr(priors, "WIDEST", width)  # with the calibration there is less room
    before = all_sets.too_wide
    assert all_sets.judge_above({course}, bare, -np.inf) is None
    assert all_sets.too_wide == before + 1
    assert all_sets.judge_above({key}, bare, -np.inf) is not None
    assert all_sets.judge({course}).names == {
        course
    }  # a set that is requested directly has a score


def test_absent_effects_have_no_held_out_gain(idle):
    """Over the library the mean gain is near zero, and none exceeds chance.

    Sizes and the noise spectrum are fitted to all readings, which gives half a nat.
    """
    found = {name: gains(idle, name)[0] for name in idle[1].effects}
    assert len(found) > 15
    assert np.mean(list(found.values())) < 0.5
    assert max(found.values()) < 3.0
    assert min(found.values()) > -8.0
    gain, copy = gains(idle, "motor_current_field")
    assert max(gain, copy) < 2.0


def test_true_effect_has_held_out_gain_and_its_shifted_copies_do_not(driven):
    gain, copy = gains(driven, "motor_current_field")
    assert gain > 200.0
    assert copy < 0.1 * gain
    all_sets, space = driven
    key = middle_setting(space, "motor_current_field")
    told = HeldOut(all_sets, all_sets.judge({key})).held_out_gain((key,))
    # the prediction error is the sensor's noise; a row is a mean of several readings
    noise = 1e-3 / np.sqrt(all_sets.made.point.problem.averaged)
    assert told.rms_after_gauss == pytest.approx(noise, rel=0.15)
    assert told.rms_before_gauss > 1.05 * told.rms_after_gauss


def test_superfluous_effect_has_no_held_out_gain(driven):
    """With the current's field in the model, a step has nothing left to explain."""
    all_sets, space = driven
    cause, step = (
        middle_setting(space, name) for name in ("motor_current_field", "hard_iron_step")
    )
    held = HeldOut(all_sets, all_sets.judge({cause, step}))
    assert held.gain(held.without((step,))) * held.samples < 0.5
    assert held.gain(held.without((cause,))) * held.samples > 200.0


def test_held_out_density_equals_that_of_the_dense_gaussian():
    short = replace(track_of(experiment("wam", seed=22, samples=900)), accel_b_m_s2=None)
    all_sets, space = sets_of(with_current(short, field=True))
    held = HeldOut(all_sets, all_sets.judge({middle_setting(space, "motor_current_field")}))
    rows = held.rows(held.best.names)
    part = np.repeat(assign_folds(rows), 3)
    X, y = rows.X.reshape(len(part), -1), rows.y.ravel()
    V = (X * np.exp(rows.phi)) @ X.T + np.eye(len(y))

    def density(mine: np.ndarray) -> float:
        own, seen = V[np.ix_(mine, mine)], y[mine]
        unit = len(seen) * (np.log(2 * np.pi) + rows.log_power)
        return -0.5 * (np.linalg.slogdet(own)[1] + seen @ np.linalg.solve(own, seen) + unit)

    whole = density(np.ones(len(y), dtype=bool))
    expected = sum(whole - density(part != k) for k in range(priors.PARTS))
    assert held.predict(held.best.names).nats == pytest.approx(expected, rel=1e-6)


def test_intervals_are_assigned_to_folds_in_turn(driven):
    rows = HeldOut(driven[0], driven[0].judge(NOTHING)).rows(NOTHING)
    track, part = rows.made.point.problem.track, assign_folds(rows)
    since_s = track.time_s[rows.rows] - track.time_s[0]
    np.testing.assert_array_equal(part, (since_s // 2.0).astype(int) % 5)


def test_free_process_gains_most_in_its_own_frame(track):
    t = track.time_s - track.time_s[0]
    level = np.sin(2 * np.pi * t / 31.0) + np.sin(2 * np.pi * t / 47.0)
    added = 4e-3 * level[:, None] * np.array([0.6, -0.7, 0.4])
    all_sets, _ = sets_of(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    held = HeldOut(all_sets, all_sets.judge({"free sensor"}))
    told = held.held_out_gain(("free sensor",))
    assert told.nll_gain_per_sample * held.samples > 200.0
    assert told.placebo_gain < 0.8 * told.nll_gain_per_sample


# -- priors -------------------------------------------------------------------------------------


def test_odds_change_by_the_logarithm_of_the_effect_prior(driven):
    all_sets, space = driven
    best = all_sets.judge({middle_setting(space, "motor_current_field")})
    found = prior_sensitivity(all_sets, best, all_sets.judge(NOTHING), required=3.0)
    (by_name,) = (one for one in found.assumed if one.what == EFFECT)
    assert found.log_odds == pytest.approx(best.score - all_sets.judge(NOTHING).score)
    assert by_name.half_nats == pytest.approx(found.log_odds - np.log(2.0))
    assert by_name.double_nats == pytest.approx(found.log_odds + np.log(2.0))
    assert found.stays
    assert not prior_sensitivity(all_sets, best, all_sets.judge(NOTHING), found.log_odds).stays


def test_odds_with_another_noise_prior_agree_with_a_refit(driven, monkeypatch):
    all_sets, space = driven
    names = frozenset({middle_setting(space, "motor_current_field")})
    found = prior_sensitivity(
        all_sets, all_sets.judge(names), all_sets.judge(NOTHING), required=3.0
    )
    (by_noise,) = (one for one in found.assumed if one.what == NOISE)
    monkeypatch.setattr(priors, "NOISE_STEP_CLEAN", 2.0 * priors.NOISE_STEP_CLEAN)
    anew = replace(all_sets, judged={})
    change = anew.judge(names).score - anew.judge(NOTHING).score - found.log_odds
    assert np.sign(by_noise.double_nats - found.log_odds) == np.sign(change)
    assert by_noise.double_nats - found.log_odds == pytest.approx(change, rel=0.5, abs=1.0)


def test_odds_over_a_free_process_change_by_its_assumed_prior(driven):
    all_sets, space = driven
    best = all_sets.judge({middle_setting(space, "motor_current_field")})
    rival = all_sets.judge({"free sensor"})
    by = {one.what: one for one in prior_sensitivity(all_sets, best, rival, 3.0).assumed}
    assert by[COURSE].double_nats - by[COURSE].half_nats == pytest.approx(-2 * np.log(2.0))
    assert ORDINARY not in by


# -- the residual -------------------------------------------------------------------------------


def test_residual_of_a_null_is_like_its_simulated_copies_in_every_bin(idle):
    all_sets, _ = idle
    held = HeldOut(all_sets, all_sets.judge(NOTHING))
    found = fit_residuals(held.rows(NOTHING))
    maps = regime_maps(found)
    seen = checks(found, maps)
    assert {"autocorrelation", "shift_sensor", "heading", "by_rate_rad_s", "tail"} <= seen.keys()
    assert [name for name, one in seen.items() if not one.inside_after] == []
    assert seen["normalised_innovation"].value == pytest.approx(1.0, abs=0.05)
    nats = np.concatenate([one.after for one in maps])
    assert np.mean(nats) == pytest.approx(1.5, abs=4.0 * 1.22 / np.sqrt(len(nats)))
    limit = seen["by_rate_rad_s"].band[1]
    bins = next(len(one.after) for one in maps if one.quantity == "rate_rad_s")
    assert limit == pytest.approx(chdtri(3.0, 0.01 / (len(maps) * bins)) / 2.0)


def test_check_by_column_fails_before_and_passes_with_the_effect(driven):
    all_sets, space = driven
    names = frozenset({middle_setting(space, "motor_current_field")})
    held = HeldOut(all_sets, all_sets.judge(names))
    found = fit_residuals(held.rows(names))
    maps = regime_maps(found)
    one = checks(found, maps)["by_motor_current_a"]
    assert not one.inside_before
    assert one.inside_after
    (current,) = (each for each in maps if each.quantity == "motor_current_a")
    assert max(current.before) > 100.0
    assert max(current.after) < 10.0


@pytest.mark.slow
def test_unmodelled_source_fails_the_checks_by_time_and_whiteness(track):
    t = track.time_s - track.time_s[0]
    pulse = ((t > 50.0) & (t < 75.0))[:, None] * np.array([4e-3, -3e-3, 2e-3])
    problem, cold = build_problem(replace(track, mag_b_gauss=track.mag_b_gauss + pulse), Spec())
    start = fit_null(problem.track, problem.spec, cold, walk=False)
    all_sets, _ = build_search_space(
        richest_model.fit_richest_model(problem, start.filtered, EFFECTS), EFFECTS, ()
    )
    quiet = all_sets.judge({"free sensor"})
    bare = replace(all_sets.judge(NOTHING), at=replace(
        all_sets.judge(NOTHING).at, log_noise=quiet.at.log_noise))  # fmt: skip
    all_sets.judged[NOTHING] = bare
    found = fit_residuals(HeldOut(all_sets, bare).rows(NOTHING))
    seen = checks(found, ())
    assert not seen["shift_sensor"].inside_after
    assert not seen["autocorrelation"].inside_after
    assert whiteness(start, found)["ljung_box"].p_after < 1e-4


@pytest.mark.slow
def test_sensitivity_limit_is_detectable_and_a_third_of_it_is_not(idle, track):
    all_sets, space = idle
    found = effect_evidence(all_sets, space, NOTHING)
    told = {(one.effect, one.parameter): one for one in limits(found)}
    limit = told["motor_current_field", "field_per_ampere_x"]
    assert limit.unit == "gauss/A"
    assert max(one.nats for one in found) < 6.0

    def odds(size: float) -> float:
        column = with_current(track, field=False)
        mag = column.mag_b_gauss.copy()
        mag[:, 0] += size * column.covariates["motor_current_a"]
        sets, asked = sets_of(replace(column, mag_b_gauss=mag))
        key = middle_setting(asked, "motor_current_field")
        return sets.judge({key}).score - sets.judge(NOTHING).score

    assert odds(1.2 * limit.smallest) > priors.NAME_ODDS  # at the actual noise
    assert odds(limit.smallest / 3.0) < priors.NAME_ODDS


def test_size_of_the_remaining_residual_is_that_of_the_added_field(track):
    rng = np.random.default_rng(5)
    t = (track.time_s - track.time_s[0]) / track.duration_s
    waves = np.cos(np.pi * np.outer(t, np.arange(2, 8)))
    field = 12e-3 * waves @ rng.normal(size=(6, 3)) / np.sqrt(6)
    truth = experiment("wam", seed=21, samples=3000).R_nb
    world = np.einsum("nji,nj->ni", truth, field)
    all_sets, _ = sets_of(replace(track, mag_b_gauss=track.mag_b_gauss + world))
    best = all_sets.judge(all_sets.remainder)
    found = remainder_sizes(all_sets, best, None, ())
    parts = {one.component: one for one in found.components}
    at_s, times = all_sets.made.context.track.time_s, track.time_s
    rows = np.column_stack([np.interp(at_s, times, column) for column in world.T])
    put_in = rms_about_mean(project_out_calibration(rows, calibration_basis(all_sets.made.context)))
    assert found.within
    # the filter follows slow changes: the most probable process is smaller than the true one
    assert 0.5 * put_in < parts["world_course"].size < 1.1 * put_in
    assert parts["world_course"].there
    assert parts["world_course"].up_to > 5.0 * parts["world_course"].size
    others = [one for name, one in parts.items() if name != "world_course"]
    assert max(one.size for one in others if one.unit == "gauss") < 0.3 * put_in
    assert found.heading_deg > 0.3


def test_doubt_is_noted_for_a_finding_without_held_out_gain_or_dependent_on_a_prior():
    held = Heldout(1e-3, 9e-4, 0.01, 0.001)
    sure = OnPriors(20.0, 3.0, True, (Assumed(EFFECT, 19.3, 20.7),))
    told = Finding(
        effect="hysteresis", confidence=1.0, alternatives=(), where=Where((), (), "sensor"),
        parameters=(), heldout=held, cost_if_left_out=None, separate_from=None, priors=sure,
    )  # fmt: skip
    assert doubts((told,)) == ()
    (copied,) = doubts((replace(told, heldout=replace(held, placebo_gain=0.02)),))
    assert copied.startswith(
        "doubt hysteresis: on readings that it was not fitted to it predicts no better"
    )
    owed = OnPriors(3.4, 3.0, False, (Assumed(EFFECT, 2.7, 4.1), Assumed(NOISE, 5.0, 1.2)))
    (note,) = doubts((replace(told, priors=owed),))
    assert note == (
        "hysteresis depends on a prior: with the noise steps between octaves doubled its evidence "
        "is 1 nats, and 3 are required"
    )
