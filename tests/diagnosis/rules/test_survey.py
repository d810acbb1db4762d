"""The library held against one state: in whose noise the candidates are ranked."""

from dataclasses import replace

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.regression import Candidate, base
from ahrsd.diagnosis.rules.search import State, formed_basis_of, survey
from ahrsd.diagnosis.rules.settings import closest_onset, evidence_of
from ahrsd.diagnosis.rules.unknown import beside_names, detected, remainder
from ahrsd.diagnosis.track import Spec


def surveyed(**trial):
    track = made(Trial(3, samples=8_000, **trial)).track
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return survey(State(problem, fit_null(problem.track, problem.spec, cold, walk=False)))


def test_what_an_effect_does_is_no_noise_to_the_names_for_it():
    seen = surveyed(effects=(("flexible_mount", 0.4),))
    best = seen.candidates[0]
    assert best.name == "flexible_mount"
    assert seen.basis.colour > 2.0  # of all that the calibration leaves, the effect with it
    with_it = evidence_of(seen.basis, best)
    assert best.evidence > 0.8 * seen.basis.colour * with_it
    judged = next(j for j in seen.judged if j.candidate is best)
    assert abs(judged.evidence - best.evidence) < 1e-6


def test_red_noise_stays_noise_to_whatever_is_strongest_in_it():
    seen = surveyed(noise="red")
    assert seen.basis.colour > 1.1
    assert not any(one.accepted for one in seen.judged)
    assert seen.candidates[0].evidence < LIMITS.evidence_nats


def test_what_large_names_leave_of_their_own_form_is_no_unknown():
    """A thousandth of a name's evidence comes off the remainder's, of every frame and regime."""
    track = made(Trial(4, samples=5_000)).track
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    left = remainder(formed_basis_of(state))
    gyro = replace(left.located["gyro"], evidence=24.2, p_value=1e-12)
    found = replace(left, located={**left.located, "gyro": gyro})
    assert detected(found, LIMITS)
    assert not detected(beside_names(found, 41.931, LIMITS), LIMITS)
    assert detected(beside_names(found, 6.0, LIMITS), LIMITS)
    assert beside_names(found, 6.0, LIMITS).strongest.evidence == pytest.approx(18.2)
    quick = replace(left.located["sensor"], evidence=7.4, p_value=6e-4)
    source = replace(left, located={**left.located, "sensor": quick}, one_source=True)
    assert detected(source, LIMITS)
    assert not detected(beside_names(source, 8.6, LIMITS), LIMITS)
    assert detected(beside_names(source, 2.0, LIMITS), LIMITS)


def test_what_begins_has_a_before_and_an_after():
    """A field all through the recording, which takes up how the gyro drifts, is no step."""
    track = made(Trial(seed=1, samples=8000, effects=(("field_gradient", 4.0),))).track
    fit = fit_null(track, walk=False)
    basis = base(fit.context(), fit.filtered, [], 25.0)
    for row, reach_s in ((50, 10.0), (-50, 10.0)):
        near = Candidate(EFFECTS["field_step"], {"onset_s": float(track.time_s[row])}, 1, 0.0)
        onset_s = closest_onset(basis, near, reach_s).setting["onset_s"]
        assert track.time_s[3] <= onset_s <= track.time_s[-3]
