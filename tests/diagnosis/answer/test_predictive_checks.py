"""Posterior predictive checks: statistics of the null are within their bands, omitted effects are
not.
"""

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
    """The null model fitted to a simulated recording, with or without one effect."""
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
def test_all_statistics_of_a_null_recording_are_within_their_bands(seed):
    null = recorded(seed=seed)
    found = predictive_checks.check_null(null)
    assert set(found) == {
        "normalised_innovation", "autocorrelation", "shift_sensor", "shift_world", "shift_turn",
        "field_size", "heading", "tail", "line", "covariates",
    }  # fmt: skip
    outside = [name for name, check in found.items() if not check.inside_before]
    assert outside == []
    assert all(c.band[0] < c.band[1] and c.inside_after == c.inside_before for c in found.values())


def test_line_statistic_is_outside_its_band_when_a_line_is_omitted():
    """A slower disturbance would be taken for noise."""
    found = predictive_checks.check_null(recorded("ac_interference", seed=5))
    assert not found["line"].inside_before


@pytest.mark.parametrize(
    ("colour", "freedom", "read"), [((0.8,), np.inf, 1), ((), 3.5, 1), ((), np.inf, 3)]
)
def test_coloured_or_heavy_tailed_noise_and_sparse_readings_are_within_the_bands(
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


def test_noise_law_has_the_higher_level_within_its_interval():
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
    assert law.freedom > 30  # with one level for all rows the tails would look heavy


@pytest.mark.parametrize(
    "step_gauss",
    [
        pytest.param(2e-3, marks=pytest.mark.slow),
        pytest.param(6e-3, marks=pytest.mark.slow),
        1.5e-2,
    ],
)
def test_noise_level_is_recovered_from_quantised_readings(
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


def test_bands_of_largest_differences_have_no_lower_limit():
    null = recorded(rows=600)
    bands = {name: check.band[0] for name, check in predictive_checks.check_null(null).items()}
    assert {name for name, low in bands.items() if low > 0} == {
        "normalised_innovation", "autocorrelation", "tail",
    }  # fmt: skip


def test_predictive_checks_are_deterministic():
    null = recorded(rows=600)
    assert predictive_checks.check_null(null) == predictive_checks.check_null(null)


def test_statistics_of_white_noise_have_their_expected_values():
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


def test_no_covariate_statistic_when_no_column_varies():
    context, _ = moving(12, rows=400)
    still = {"throttle": np.full(400, 0.3), "x": np.full(400, np.nan)}
    bare = replace(context, track=replace(context.track, covariates=still))
    e = np.random.default_rng(0).standard_normal((400, 3))
    assert "covariates" not in predictive_checks.residual_statistics(
        e, predictive_checks.build_scene(bare)
    )


def test_simulated_copies_lose_the_expected_number_of_turns():
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


def test_recording_with_lost_turns_is_within_its_bands():
    """A turn that is lost undetected jumps by a few standard deviations of a reading: here by 2, in
    3 rows of 100.
    """
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


def test_band_of_the_largest_value_has_the_stated_coverage():
    """A 17th largest value is outside at most once in 1,000 by Gumbel's law, in 10 statistics."""
    drawn = np.random.default_rng(5).gumbel(size=(200_000, predictive_checks.COPIES + 1))
    known, other = drawn[:, :-1], drawn[:, -1]
    beyond = other > known.mean(axis=1) + priors.CHECKS_LARGEST_REACH * known.std(axis=1, ddof=1)
    assert np.mean(beyond) == pytest.approx(1e-3, rel=0.1)
    for size in (60, 5000):  # segments in three axes; lines of a periodogram
        share = np.random.default_rng(size).random((8_000, predictive_checks.COPIES + 1))
        drawn = -np.log1p(
            -(share ** (1 / size))
        )  # the largest of this many powers, by their distribution
        bands = [
            predictive_checks.predictive_bands([{"line": float(x)} for x in row[:-1]])
            for row in drawn
        ]
        outside = [not b["line"][0] <= row[-1] <= b["line"][1] for b, row in zip(bands, drawn)]
        assert np.mean(outside) < 3e-3
