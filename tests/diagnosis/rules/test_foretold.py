"""Names that say nothing of what was held out, and those that are not asked."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.descent import FittedTerm
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import foretold, unknown
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.foretold import (
    FORETOLD,
    in_time_alone,
    part_of,
    share_foretold,
    without_unforetold,
)
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.often import changes
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, Survey, formed_basis_of, without_term
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.validate import Gain
from ahrsd.diagnosis.track import Spec

SAMPLES = 5000
SETTING = {"covariate": "motor_current_a", "reference": 0.0}
NAMED = "motor_current_field"


def of_current(strength):
    """A state with the field of a motor's current named, and its evidence.

    strength (SAMPLES,): gauss per ampere, as it is
    """
    rng = np.random.default_rng(5)
    current = np.repeat(rng.uniform(0.0, 10.0, SAMPLES // 50), 50)
    track = track_of(experiment("mam", samples=SAMPLES))
    mag = track.mag_b_gauss + (strength * current)[:, None] * np.array([1.0, 0.0, 0.0])
    track = replace(track, mag_b_gauss=mag, covariates={"motor_current_a": current})
    problem, start = problem_of(track, Spec(), EFFECTS, LIMITS)
    effect = EFFECTS[NAMED]
    candidate = Candidate(effect, SETTING, 1, 0.0)
    columns = partial(effect.columns, setting=SETTING)
    term = FittedTerm(NAMED, columns, np.zeros(3), 30 * candidate.scale, setting=SETTING)
    fit = fit_null(problem.track, problem.spec, start, (term,), walk=False)
    what = SimpleNamespace(value=fit.terms[0].value, effective_blocks=6.0)
    judged = Judged(candidate, what, 0.0, 0.0, 0.0, Gain(1.0, 1.0), 1.0, 0.0, ())
    state = State(problem, fit, (judged,))
    judged = replace(judged, evidence=evidence_of(without_term(state, 0), candidate))
    return replace(state, named=(judged,)), Survey(formed_basis_of(state), (), ())


@pytest.fixture(scope="module")
def once():
    """It flows all the time, and is seen in the middle fifth alone."""
    fifth = np.arange(SAMPLES) * 5 // SAMPLES
    return of_current(np.where(fifth == 2, 4e-4, 0.0))


def test_what_was_so_in_one_fifth_alone_is_taken_out_and_unknown(once):
    state, seen = once
    assert state.named[0].evidence > LIMITS.evidence_nats
    assert share_foretold(state, 0, seen) < FORETOLD
    before = unknown.remainder(formed_basis_of(state))
    slim, surveys, left = without_unforetold(state, [seen], before, known=1)
    assert slim.names == ()
    assert surveys == []
    assert unknown.detected(left, LIMITS)


def test_what_is_always_so_stays():
    state, seen = of_current(np.full(SAMPLES, 8e-5))
    before = unknown.remainder(formed_basis_of(state), with_bins=False)
    kept, _, left = without_unforetold(state, [seen], before, known=1)
    assert kept is state
    assert left is before


def test_a_gain_that_is_small_is_held_against_the_evidence():
    """Those of a name for an unlogged turret, and of a rotor whose moved copies are as good."""
    assert part_of(Gain(0.0006, 0.0), 0.017, 14.5, 2282) < FORETOLD
    assert part_of(Gain(2 * 0.013 / 3, 0.0), 0.018, 61.0, 4725) > FORETOLD
    assert part_of(Gain(2 * 0.001 / 3, 0.0), 0.0009, 1000.0, 5000) == 1.0  # more than the copies
    assert part_of(Gain(0.0, 0.001), 0.0, 50.0, 5000) < 0.0


def test_what_has_a_moment_of_its_own_is_not_asked(once):
    state, seen = once
    assert not in_time_alone(state.named[0].candidate)
    for name in ("field_step", "geomagnetic_drift", "field_anomaly", "gyro_startup"):
        assert in_time_alone(Candidate(EFFECTS[name], {}, 1, 0.0))
    begun = replace(state.named[0].candidate, setting={**SETTING, "onset_s": 20.0})
    assert in_time_alone(begun)
    judged = replace(state.named[0], candidate=begun)
    assert share_foretold(replace(state, named=(judged,)), 0, seen) == 1.0


@pytest.fixture(scope="module")
def crossed():
    return made(Trial(3, (("mag_cross_axis", 2.0),), samples=6000)).track


@pytest.mark.slow
def test_what_is_not_refused_is_named(crossed):
    assert [one.effect for one in diagnose(crossed).findings] == ["mag_cross_axis"]


def test_a_diagnosis_asks_and_what_is_refused_is_unknown(crossed, monkeypatch):
    monkeypatch.setattr(foretold, "gain_of", lambda *_, **__: Gain(1.0, 1.01))
    found = diagnose(crossed)
    assert found.findings == ()
    assert found.unexplained.detected


def test_a_logged_cause_that_changes_often_is_not_asked_amid_a_louder_rest(once):
    """The rest bends the calibration of four fifths by more than the name is worth in the fifth."""
    state, seen = once
    left = unknown.remainder(formed_basis_of(state))
    rest, slim = left.strongest.evidence, LIMITS.beyond_nats
    for nats, names in ((5.0, ()), (slim - 1, ()), (slim + 1, (NAMED,)), (3 * rest, ())):
        judged = replace(state.named[0], evidence=nats)
        strong = replace(state, named=(judged,))
        kept, _, _ = without_unforetold(strong, [seen], left, known=1)
        assert kept.names == names


def test_what_changes_often():
    time_s = np.arange(0.0, 300.0, 0.1)
    rng = np.random.default_rng(1)
    throttled = np.repeat(rng.integers(0, 2, 60), 50) + 0.05 * rng.standard_normal(3000)
    warming = 25 * (1 - np.exp(-time_s / 60)) + 0.3 * rng.standard_normal(3000)
    assert changes(throttled, 0.1) >= 20
    assert changes(warming, 0.1) == 1
    assert changes(rng.standard_normal(3000) * 0.0, 0.1) == 0


def test_a_change_at_a_known_moment_counts_twice():
    time_s = np.arange(0.0, 300.0, 0.1)
    switched = np.where(time_s % 100.0 < 50.0, 0.0, 1.0)
    swung = np.sin(2 * np.pi * time_s / 100.0)
    assert changes(swung, 0.1) == 5
    assert changes(switched, 0.1) == 10
