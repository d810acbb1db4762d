"""Posterior predictive checks: the truth is inside, what was left out is outside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_motion import moving

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer import predictive_checks
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.repaired_model import forward


def recorded(name=None, strength=1.0, seed=0, rows=3000):
    """The null that is fitted to a recording, with an effect or without."""
    context, _ = moving(11, rows=rows)
    truth = forward.noise_free_readings(context)
    terms = ()
    if name is not None:
        value, setting = EFFECTS[name].example(truth, strength)
        terms = (Term(name, value, 0.1 * np.abs(value), setting),)
    made = forward.simulate_readings(truth, terms, forward.model_noise(context.model), seed)
    track = forward.track_from_readings(made)
    model = replace(context.model, gyro_walk_rad_s_sqrt_s=0.0)
    return fit_null(track, start=model, walk=False)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_recording_of_the_null_is_inside_all_itsbands(seed):
    null = recorded(seed=seed)
    found = predictive_checks.check_null(null)
    assert set(found) == {
        "normalised_innovation", "autocorrelation", "shift_sensor", "shift_world", "shift_turn",
        "field_size", "heading", "tail", "line", "covariates",
    }  # fmt: skip
    outside = [name for name, check in found.items() if not check.inside_before]
    assert outside == []
    assert all(c.band[0] < c.band[1] and c.inside_after == c.inside_before for c in found.values())


def test_a_line_that_was_left_out_is_outside():
    """What is slower is held as noise."""
    found = predictive_checks.check_null(recorded("ac_interference", seed=5))
    assert not found["line"].inside_before


@pytest.mark.parametrize(
    ("colour", "freedom", "read"), [((0.8,), np.inf, 1), ((), 3.5, 1), ((), np.inf, 3)]
)
def test_noise_of_any_colour_and_tail_is_inside_and_so_is_a_reading_now_and_then(
    colour, freedom, read
):
    context, _ = moving(11, rows=3000)
    model = replace(context.model, gyro_walk_rad_s_sqrt_s=0.0)
    noise = replace(forward.model_noise(model), colour=colour, freedom=freedom)
    track = forward.track_from_readings(
        forward.simulate_readings(forward.noise_free_readings(context), (), noise, 3)
    )
    mag = track.mag_b_gauss.copy()
    mag[np.arange(len(track)) % read != 0] = np.nan
    null = fit_null(replace(track, mag_b_gauss=mag), start=model, walk=False)
    found = predictive_checks.check_null(null)
    assert [name for name, check in found.items() if not check.inside_after] == []


def test_the_noise_is_as_loud_as_it_is_where_it_is_loud():
    context, _ = moving(11, rows=3000)
    model = replace(context.model, gyro_walk_rad_s_sqrt_s=0.0)
    time_s = context.track.time_s
    level = np.where((time_s > 30) & (time_s < 60), 3.0, 1.0)
    noise = replace(forward.model_noise(model), level=level)
    track = forward.track_from_readings(
        forward.simulate_readings(forward.noise_free_readings(context), (), noise, 3)
    )
    fit = fit_null(track, start=model, walk=False)
    law = predictive_checks.fit_noise_law(fit, [(30.0, 60.0)])
    loud = law.level[(time_s > 31) & (time_s < 59)]
    assert loud.min() / law.level[time_s < 29].max() == pytest.approx(3.0, rel=0.1)
    assert law.freedom > 30  # one level taken for all, the tails would be heavy


@pytest.mark.parametrize(
    "step_gauss",
    [
        pytest.param(2e-3, marks=pytest.mark.slow),
        pytest.param(6e-3, marks=pytest.mark.slow),
        1.5e-2,
    ],
)
def test_readings_in_coarse_steps_are_simulated_so_and_their_noise_is_what_was_there_before(
    step_gauss,
):
    context, _ = moving(11, rows=3000)
    model = replace(context.model, gyro_walk_rad_s_sqrt_s=0.0)
    steps = Term("mag_quantisation", np.array([step_gauss]), np.array([1e-6]))
    noise = forward.model_noise(model)
    track = forward.track_from_readings(
        forward.simulate_readings(forward.noise_free_readings(context), [steps], noise, 3)
    )
    fit = fit_null(track, start=model, walk=False)
    law = predictive_checks.constant_level_noise(fit, terms=[steps])
    assert law.mag_gauss == pytest.approx(model.sigma_mag_gauss, rel=0.1)


def test_the_largest_of_many_differences_may_be_as_small_as_it_likes():
    null = recorded(rows=600)
    bands = {name: check.band[0] for name, check in predictive_checks.check_null(null).items()}
    assert {name for name, low in bands.items() if low > 0} == {
        "normalised_innovation", "autocorrelation", "tail",
    }  # fmt: skip


def test_the_same_question_has_the_same_answer():
    null = recorded(rows=600)
    assert predictive_checks.check_null(null) == predictive_checks.check_null(null)


def test_statistics_of_white_noise_are_what_they_say():
    context, _ = moving(12, rows=4000)
    e = np.random.default_rng(0).standard_normal((4000, 3))
    found = predictive_checks.residual_statistics(e, predictive_checks.build_scene(context))
    assert found["normalised_innovation"] == pytest.approx(1.0, abs=0.05)
    assert found["autocorrelation"] == pytest.approx(1.0, abs=0.6)
    assert found["tail"] == pytest.approx(3.29, abs=0.2)
    assert 1.5 < found["shift_sensor"] < 4.5
    shifted = e + np.where(context.track.time_s > 100, 0.5, 0.0)[:, None]
    assert (
        predictive_checks.residual_statistics(shifted, predictive_checks.build_scene(context))[
            "shift_sensor"
        ]
        > 8
    )


def test_without_columns_nothing_is_said_of_them():
    context, _ = moving(12, rows=400)
    still = {"throttle": np.full(400, 0.3), "x": np.full(400, np.nan)}
    bare = replace(context, track=replace(context.track, covariates=still))
    e = np.random.default_rng(0).standard_normal((400, 3))
    assert "covariates" not in predictive_checks.residual_statistics(
        e, predictive_checks.build_scene(bare)
    )


def test_simulations_lose_the_turns_that_nobody_saw():
    context, _ = moving(11, rows=4000)
    expected = np.where(np.arange(4000) < 3000, 0.05, 0.0)
    track = replace(context.track, lost_turns=expected, step_share=0.5)
    made = replace(context.track, gyro_b_rad_s=np.ones((4000, 3)))
    assert predictive_checks._lose_turns(context.track, made, 1) is made
    gyro = predictive_checks._lose_turns(track, made, 1).gyro_b_rad_s[:, 0]
    assert np.all(gyro[3000:] == 1.0)
    lost = (1.0 + 0.5 * 0.05 - gyro[:3000]) / 0.5
    assert np.all(np.abs(lost - np.round(lost)) < 1e-9)
    assert lost.mean() == pytest.approx(0.05, abs=0.015)
    assert gyro.mean() == pytest.approx(1.0, abs=0.006)
    assert not np.array_equal(
        gyro, predictive_checks._lose_turns(track, made, 2).gyro_b_rad_s[:, 0]
    )


def test_a_recording_that_lost_turns_looks_like_its_simulations():
    """What is lost unseen jumps by a few deviations of a reading: here by 2, at 3 rows in 100."""
    context, _ = moving(11, rows=4000)
    model = replace(context.model, gyro_walk_rad_s_sqrt_s=0.0)
    truth = forward.noise_free_readings(context)
    made = forward.track_from_readings(
        forward.simulate_readings(truth, (), forward.model_noise(model), 5)
    )
    told = replace(made, lost_turns=np.full(4000, 0.03), step_share=0.15)
    track = replace(told, gyro_b_rad_s=predictive_checks._lose_turns(told, made, 77).gyro_b_rad_s)
    fit = fit_null(track, start=model, walk=False)
    found = predictive_checks.check_null(fit)
    assert [name for name, check in found.items() if not check.inside_after] == []


def test_the_largest_of_many_is_below_its_band_as_often_as_is_said():
    """One more largest value beyond 16: at most once in 1,000 by Gumbel's law, in 10 statistics."""
    drawn = np.random.default_rng(5).gumbel(size=(200_000, predictive_checks.COPIES + 1))
    known, other = drawn[:, :-1], drawn[:, -1]
    beyond = other > known.mean(axis=1) + priors.CHECKS_LARGEST_REACH * known.std(axis=1, ddof=1)
    assert np.mean(beyond) == pytest.approx(1e-3, rel=0.1)
    for size in (60, 5000):  # segments in three axes; lines of a periodogram
        share = np.random.default_rng(size).random((8_000, predictive_checks.COPIES + 1))
        drawn = -np.log1p(-(share ** (1 / size)))  # of so many powers, by their distribution
        bands = [
            predictive_checks.predictive_bands([{"line": float(x)} for x in row[:-1]])
            for row in drawn
        ]
        outside = [not b["line"][0] <= row[-1] <= b["line"][1] for b, row in zip(bands, drawn)]
        assert np.mean(outside) < 3e-3
