"""Which name comes next, and when a bias that changes is noise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.calibration_fit.resting import ORDINARY_WALK_RAD_S_SQRT_S
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import selection
from ahrsd.diagnosis.rules.name import ROBUST
from ahrsd.diagnosis.rules.search import State, added, refitted, survey
from ahrsd.diagnosis.rules.selection import (
    _cause,
    _cause_after_all,
    _may_wander,
    _which_change,
    borne_out,
    forward,
)
from ahrsd.diagnosis.track import Spec, Track

SCALE = 1 + np.array([-1.2e-3, 2.3e-3, -1.6e-3])


def _beside_a_walk(track: Track) -> State:
    """The state with the gyro's scale named, and a bias that may wander."""
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    scale = next(j for j in survey(start).judged if j.candidate.name == "gyro_scale")
    return refitted(replace(start, walk=ORDINARY_WALK_RAD_S_SQRT_S), (scale,))


@pytest.fixture(scope="module")
def track() -> Track:
    plain = made(Trial(3, scenario="wam", samples=6000)).track
    return replace(plain, gyro_b_rad_s=plain.gyro_b_rad_s * SCALE)


def test_a_cause_is_asked_for_again_when_another_name_is_in(track: Track) -> None:
    """A walk had the scale's error to follow as well, and took the step with it."""
    later = (track.time_s - track.time_s[0] > 140.0)[:, None]
    stepped = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + later * [2.1e-4, 5.4e-4, 1.4e-4])
    state = _beside_a_walk(stepped)
    more = _cause_after_all(state, survey(state))
    assert more.names == ("gyro_scale", "gyro_bias_step")
    assert more.walk == 0.0
    assert more.fit.model.gyro_walk_rad_s_sqrt_s == 0.0
    assert abs(float(more.named[1].candidate.setting["onset_s"]) - track.time_s[0] - 140.0) < 3.0


def test_a_bias_that_wanders_stays_noise(track: Track) -> None:
    rng = np.random.default_rng(4)
    steps = ORDINARY_WALK_RAD_S_SQRT_S * np.sqrt(0.04) * rng.standard_normal((len(track), 3))
    wandered = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + np.cumsum(steps, axis=0))
    state = _beside_a_walk(wandered)
    assert _cause_after_all(state, survey(state)) is state


def judged(name: str, evidence: float, *refused: str) -> SimpleNamespace:
    return SimpleNamespace(candidate=SimpleNamespace(name=name), evidence=evidence, refused=refused)


DRIFT = judged("gyro_bias_drift", 20.4)


@pytest.mark.parametrize(
    ("walk", "others", "said"),
    [
        # a start-up of forty seconds: three of four blocks have nothing of it
        (5e-6, [judged("gyro_startup", 28.6, ROBUST)], "gyro_startup"),
        (0.0, [judged("gyro_startup", 28.6, ROBUST)], "gyro_bias_drift"),
        (5e-6, [judged("gyro_startup", 22.0, ROBUST)], "gyro_bias_drift"),
        (5e-6, [judged("gyro_startup", 28.6, ROBUST, "held-out gain")], "gyro_bias_drift"),
        (5e-6, [judged("field_step", 28.6, ROBUST)], "gyro_bias_drift"),
        (
            5e-6,
            [judged("gyro_startup", 28.6, ROBUST), judged("gyro_bias_step", 30.0, "held-out gain")],
            "gyro_bias_drift",
        ),
    ],
)
def test_how_a_bias_changes_is_for_the_evidence_to_say(walk, others, said) -> None:
    state = SimpleNamespace(walk=walk, problem=SimpleNamespace(limits=LIMITS))
    seen = SimpleNamespace(judged=(*others, DRIFT))
    assert _which_change(DRIFT, state, seen, set()).candidate.name == said
    # what the joint fit does not bear out is not asked again
    assert _which_change(DRIFT, state, seen, {"gyro_startup"}) is DRIFT


def held(name: str, evidence: float, *refused: str) -> SimpleNamespace:
    one = judged(name, evidence, *refused)
    one.candidate.evidence, one.accepted = evidence, not refused
    return one


@pytest.mark.parametrize(
    ("first", "others", "asked"),
    [
        (held("gyro_startup", 50.0), [], "gyro_startup"),
        (held("gyro_startup", 50.0, ROBUST), [], "gyro_startup"),
        (held("gyro_bias_drift", 50.0), [], None),
        # the few modes of a walk are ahead by little: the walk itself decides
        (held("gyro_bias_drift", 50.0), [held("gyro_startup", 49.0)], "gyro_startup"),
        (held("gyro_bias_drift", 50.0), [held("gyro_startup", 46.9)], None),
        (held("gyro_bias_drift", 50.0), [held("gyro_startup", 49.0, "held-out gain")], None),
        # a step that may be anywhere is what a walk looks like soonest
        (held("gyro_bias_step", 56.1), [held("gyro_bias_drift", 50.0)], "gyro_bias_step"),
        (held("gyro_bias_step", 55.9), [held("gyro_bias_drift", 50.0)], None),
        (held("gyro_bias_drift", 50.0), [held("gyro_bias_step", 49.0)], None),
    ],
)
def test_which_cause_a_walk_is_held_against(first, others, asked) -> None:
    every = (first, *others)
    seen = SimpleNamespace(judged=every, candidates=tuple(one.candidate for one in every))
    cause = _cause(first, seen, LIMITS)
    assert (cause.candidate.name if cause else None) == asked


def test_a_cause_that_the_joint_fit_does_not_bear_out_is_tried_once(monkeypatch) -> None:
    """Then the bias wanders: the search ends."""
    drift, cause = judged("gyro_bias_drift", 20.4), judged("gyro_startup", 28.6, ROBUST)
    for one, accepted in ((drift, True), (cause, False)):
        one.accepted = accepted
    tried, problem = [], SimpleNamespace(limits=LIMITS)

    def add(state: State, what) -> State:
        tried.append(what.candidate.name)
        return SimpleNamespace(named=(what,) * 5, problem=problem)

    seen = SimpleNamespace(judged=(cause, drift), candidates=())
    monkeypatch.setattr(selection, "survey", lambda _: seen)
    monkeypatch.setattr(selection, "added", add)
    monkeypatch.setattr(selection, "borne_out", lambda _a, _b, what, _c: what is drift)
    forward(SimpleNamespace(named=(), names=(), walk=5e-6, problem=problem))
    assert tried == ["gyro_startup", "gyro_bias_drift"]


def test_no_other_name_is_asked_how_a_bias_changes() -> None:
    state = SimpleNamespace(walk=5e-6, problem=SimpleNamespace(limits=LIMITS))
    scale = judged("gyro_scale", 12.0)
    seen = SimpleNamespace(judged=(judged("gyro_startup", 28.6, ROBUST), scale))
    assert _which_change(scale, state, seen, set()) is scale


@pytest.fixture(scope="module")
def crossed() -> State:
    """A magnetometer with a cross axis, before anything is named."""
    track = made(Trial(3, (("mag_cross_axis", 2.0),), samples=6000)).track
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return State(problem, fit_null(problem.track, problem.spec, cold, walk=False))


def test_a_name_that_the_joint_fit_does_not_bear_out_is_not_given(crossed, monkeypatch):
    """Of what the calibration takes nearly all, the fit gained little and left more than before."""
    assert forward(crossed)[0].names == ("mag_cross_axis",)

    def in_vain(state: State, judged) -> State:
        return replace(state, named=(*state.named, judged))

    monkeypatch.setattr(selection, "added", in_vain)
    assert forward(crossed)[0].names == ()


def test_a_name_is_borne_out_by_what_is_gained_beyond_its_price(crossed):
    seen = survey(crossed)
    best = seen.judged[0]
    tried = added(crossed, best)
    assert borne_out(crossed, tried, best, seen)
    assert 2 * (tried.fit.log_likelihood - crossed.fit.log_likelihood) > best.what.statistic
    assert not borne_out(crossed, crossed, best, seen)
    more = replace(best, evidence=best.what.statistic / 2 + 5.0)
    assert borne_out(crossed, crossed, more, seen)


@pytest.mark.parametrize(
    ("share", "named"), [pytest.param(0.03, 1, marks=pytest.mark.slow), (0.5, 2)]
)
def test_vibration_by_two_columns_is_named_once_unless_both_say_much(share, named) -> None:
    """How it shakes is told by the shaft and by the current, neither exactly."""
    track = made(Trial(7, scenario="wam", samples=8000)).track
    time_s = track.time_s
    shaft = 90.0 + 30.0 * np.sign(np.sin(time_s / 9.0))
    current = 4.0 + 2.0 * np.sign(np.sin(time_s / 23.0))
    parts = [part**2 / np.mean(part**2) for part in (shaft, current)]
    shaking = (1 - share) * parts[0] + share * parts[1]
    gyro = track.gyro_b_rad_s + 2e-3 * shaking[:, None] * [0.5, -0.7, 0.5]
    columns = {"motor_rpm": shaft, "motor_current_a": current}
    track = replace(track, gyro_b_rad_s=gyro, covariates=columns)
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    state, _, _ = forward(State(problem, fit_null(problem.track, problem.spec, cold, walk=False)))
    assert state.names == ("vibration_rectification",) * named


@pytest.mark.parametrize(
    ("name", "nats", "others", "asked"),
    [
        ("gyro_startup", 50.0, {}, True),
        # `ring600l`, 2bc1bb11: a null whose gyro walks
        ("geomagnetic_drift", 24.6, {"gyro_bias_drift": 22.4, "gyro_bias_step": 21.6}, True),
        ("geomagnetic_drift", 24.6, {"gyro_bias_drift": 21.5}, False),
        ("geomagnetic_drift", 24.6, {"hard_iron_drift": 24.0}, False),
        ("geomagnetic_drift", 24.6, {}, False),
        ("hard_iron_drift", 24.6, {"gyro_bias_drift": 24.0}, False),
    ],
)
def test_a_field_that_turns_slowly_may_be_a_bias_that_wanders(name, nats, others, asked) -> None:
    best = held(name, nats)
    rivals = tuple(held(other, size).candidate for other, size in others.items())
    seen = SimpleNamespace(candidates=(best.candidate, *rivals))
    assert _may_wander(best, seen, LIMITS) is asked
