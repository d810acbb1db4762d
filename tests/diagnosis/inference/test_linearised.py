"""Linearisation of a recording: candidates given a model, contained delays, intervals without
readings.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.components.component import Component, FixedLaw
from ahrsd.diagnosis.inference.components.effect_components import (
    LAG,
    LAG_FORM,
    contains_component,
    library_components,
    project_out,
)
from ahrsd.diagnosis.inference.components.ordinary_remainder import (
    ordinary_remainder,
    still_intervals,
)
from ahrsd.diagnosis.inference.diagnose import split_at_large_turns
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.likelihood.evidence import evaluate
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    CALIBRATION,
    coefficients_by_key,
    initial_point,
    omit_readings,
    step_to_maximum,
)
from ahrsd.diagnosis.inference.likelihood.linearisation import total_contribution as added_by
from ahrsd.diagnosis.innovation_filter.context import build_context
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.model import Columns
from ahrsd.diagnosis.track import Spec, Track


def richest(track: Track) -> richest_model.FittedPoint:
    problem, cold = build_problem(track, Spec())
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    return richest_model.fit_richest_model(problem, fit.filtered, EFFECTS)


def delayed(track: Track, lag_s: float) -> Track:
    """The magnetometer's readings delayed by `lag_s`."""
    t, m = track.time_s, track.mag_b_gauss
    late = [np.interp(t - lag_s, t, m[:, axis]) for axis in range(3)]
    return replace(track, mag_b_gauss=np.column_stack(late))


@pytest.fixture(scope="module")
def bare() -> richest_model.FittedPoint:
    """A simulated recording without an accelerometer."""
    return richest(replace(track_of(experiment("wam", seed=8, samples=3000)), accel_b_m_s2=None))


def test_remainder_has_no_parts_by_force_without_an_accelerometer(bare):
    assert np.isfinite(bare.nats)
    assert {"by_force", "bending"}.isdisjoint(bare.base.remainder)
    assert "by_direction" in bare.base.remainder


def test_log_bayes_factor_of_a_candidate_equals_its_gain_in_evidence(bare):
    made, keys = bare.base.made, (CALIBRATION, "gyro_matrix")
    laws = [made.seen[key].component.law for key in keys]
    noise = np.linspace(-0.3, 0.4, len(made.edges) - 1)
    step = priors.NOISE_STEP_REAL
    without = evaluate(made.products(keys, step), laws, noise, np.zeros(0))
    both = (*keys, LAG)
    laws.append(made.seen[LAG].component.law)
    with_it = evaluate(made.products(both, step), laws, noise, np.zeros(0))
    worth = candidate_scan(made, keys, without).log_bayes_factors([LAG])
    assert worth[LAG] == pytest.approx(with_it.nats - without.nats, abs=1e-5)


@pytest.mark.slow
def test_long_delay_is_found_from_zero():
    found = richest(delayed(track_of(experiment("wam", seed=9, samples=4000)), 0.11))
    value = coefficients_by_key(found.base.made, found.base.whole, found.at)[LAG]
    assert value[0] == pytest.approx(0.11, abs=0.006)


def test_only_eddy_currents_contain_a_delay(bare):
    delay = bare.base.made.seen[LAG].component
    parts = dict(library_components(bare.base.made.context, EFFECTS))
    assert [name for name, some in parts.items() if contains_component(some[0], delay)] == [
        "eddy_current"
    ]
    eddy = project_out(parts["eddy_current"][0], delay)
    assert eddy.beside == LAG
    assert eddy.key != parts["eddy_current"][0].key
    assert not contains_component(eddy, delay)
    shared = np.einsum("nia,ni->a", eddy.columns.mag, delay.columns.mag[:, :, 0])
    np.testing.assert_allclose(shared, 0.0, atol=1e-9)


def test_component_contains_linear_combinations_of_its_columns():
    rng = np.random.default_rng(1)
    X = rng.normal(size=(50, 3, 4))
    law = FixedLaw(np.ones(4))
    whole = Component("whole", "sensor", Columns(mag=X), law)
    part = Component("part", "sensor", Columns(mag=X @ np.array([[1.0], [2], [0], [-1]])), law)
    other = Component("other", "sensor", Columns(mag=rng.normal(size=(50, 3, 1))), law)
    assert contains_component(whole, part)
    assert not contains_component(whole, other)
    assert not contains_component(part, whole)


def test_still_intervals_are_those_with_small_rates():
    t = np.arange(0.0, 100.0, 0.1)
    gyro = np.zeros((len(t), 3))
    moving = (t >= 20.0) & (t < 60.0)
    gyro[moving, 2] = 1.0
    gyro[(t >= 80.0) & (t < 81.0), 0] = 1.0
    found = still_intervals(t, gyro)
    expected = [(0.0, 19.7), (60.2, 79.7), (81.2, 99.9)]
    np.testing.assert_allclose(found, expected, atol=0.31)


def test_no_still_intervals_when_the_recording_is_mostly_still():
    t = np.arange(0.0, 100.0, 0.1)
    gyro = np.zeros((len(t), 3))
    gyro[:100, 2] = 1.0
    assert still_intervals(t, gyro) == []


def test_logged_cause_is_the_same_component_at_every_linearisation_point():
    """Its reference follows the readings, and what it subtracted must be added again."""
    track = track_of(experiment("wam", seed=4, samples=3000))
    warm = 15.0 + np.cumsum(np.random.default_rng(2).normal(size=len(track))) / 500.0
    track = replace(track, covariates={"temperature_c": warm})
    problem, cold = build_problem(track, Spec())
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    keys = []
    for one in (problem, problem.with_lag(0.03)):
        start = initial_point(one, run_filter(one.track, fit.filtered.model), (LAG,))
        keys.append(richest_model.build_base(start, EFFECTS, (), whole=False).whole)
    assert "gyro_bias_temperature as logged" in keys[0]
    assert set(keys[1]) - set(keys[0]) == {LAG_FORM}


def test_terms_subtracted_at_a_linearisation_point_are_added_again():
    """A field of 40 mG on the sensor: with all terms added, the readings are the original ones."""
    track = track_of(experiment("wam", seed=11, samples=3000))
    t = track.time_s - track.time_s[0]
    added = 0.04 * np.sin(2 * np.pi * t / 31.0)[:, None] * np.array([0.6, -0.7, 0.39])
    track = replace(track, mag_b_gauss=track.mag_b_gauss + added)
    problem, cold = build_problem(track, Spec())
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    here = richest_model.fit_at_point(initial_point(problem, fit.filtered, (LAG,)), EFFECTS, ())
    there = richest_model.fit_at_point(
        step_to_maximum(here.base.made, here.base.whole, here.at, delayed=False), EFFECTS, ()
    )
    made, values = there.base.made, there.base.made.point.values
    known = {key: made.seen[key].component for key in values if key != LAG}
    taken, _ = added_by(len(made.context.track), known, {key: values[key] for key in known})
    assert np.max(np.abs(taken)) > 0.02
    np.testing.assert_allclose(made.point.terms_mag, taken, atol=1e-12)
    assert there.nats > here.nats


def test_run_ends_at_a_step_with_too_large_a_turn():
    track = track_of(experiment("wam", seed=8, samples=400))
    gyro = track.gyro_b_rad_s.copy()
    gyro[250] = [0.0, 20.0, 5.0]
    broken = split_at_large_turns(replace(track, gyro_b_rad_s=gyro))
    assert [(run.start, run.stop) for run in broken.runs] == [(0, 250), (250, 400)]
    assert np.isnan(broken.dt_s[250])
    assert split_at_large_turns(track) is track


def test_gyro_bridges_the_field_over_omitted_readings():
    track = track_of(experiment("wam", seed=8, samples=3000))
    problem, cold = build_problem(track, Spec())
    point = initial_point(problem, fit_null(problem.track, problem.spec, cold).filtered, (LAG,))
    middle_s = float(np.median(track.time_s))
    silent = omit_readings(point, [(middle_s, middle_s + 6.0)])
    at_s = silent.filtered.track.time_s
    inside = (at_s > middle_s + 1.0) & (at_s < middle_s + 5.0)
    assert not silent.filtered.used[inside].any()
    assert silent.filtered.used[at_s > middle_s + 7.0].all()
    assert np.isfinite(silent.filtered.whitened).all()
    assert silent.problem.recorded.mag_b_gauss.shape == track.mag_b_gauss.shape


@pytest.mark.parametrize("name", ["by_direction", "viscous_magnetisation", "hysteresis"])
def test_columns_made_of_the_field_do_not_depend_on_the_reading_of_their_row(name):
    """With a noisy gyro the smoothed field is nearly the reading, which would then explain
    itself.
    """
    loud = track_of(experiment("wam", seed=31, samples=600, rate_hz=10.0, sigma_gyro=0.03))
    problem, cold = build_problem(loud, Spec())
    model = fit_null(problem.track, problem.spec, cold, walk=False).model
    row, off_gauss = 300, 1e-3

    def columns(track: Track) -> np.ndarray:
        fit = SimpleNamespace(filtered=run_filter(track, model), terms_gyro=None)
        context = build_context(track, fit)
        known = {one.key: one for one in ordinary_remainder(context)}
        made = (
            known[name] if name in known else dict(library_components(context, EFFECTS))[name][-1]
        )
        assert made.columns.mag is not None
        return made.columns.mag[row]

    mag = problem.track.mag_b_gauss.copy()
    mag[row] += off_gauss
    moved = columns(replace(problem.track, mag_b_gauss=mag)) - columns(problem.track)
    assert np.max(np.abs(moved)) < 0.01 * off_gauss


def test_tentative_components_are_forgotten_beyond_a_limit_and_can_be_added_again(bare):
    """The rows of 4,000 columns are more numbers than the limit, those of 2,000 are not."""
    made, rng = bare.base.made.copy(), np.random.default_rng(1)
    width, samples = 2000, len(made.context.track)
    law = FixedLaw(np.ones(width))
    first, second, third = (
        Component(key, "sensor", Columns(mag=rng.normal(size=(samples, 3, width))), law)
        for key in ("first", "second", "third")
    )
    made.add_tentatively([first])
    product = made.component_products(CALIBRATION, "first").copy()
    made.keep([])
    assert "first" in made.seen  # there is room
    made.add_tentatively([second, third])
    made.keep(["second"])
    assert "second" in made.seen
    assert made.seen.keys().isdisjoint({"first", "third"})
    assert np.isfinite(made.component_products(CALIBRATION, "second")).all()
    made.add([first])
    np.testing.assert_array_equal(made.component_products(CALIBRATION, "first"), product)
    made.add_tentatively([third])
    made.keep([])
    assert {"first", "second"} <= made.seen.keys()  # one was added for good, the other is kept
