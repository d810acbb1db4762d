"""Names held against the spectrum of what is left; delays beside wider names."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import beside, sought, unknown
from ahrsd.diagnosis.rules.beside import _judged, named_beside, sayable
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.exam import pruned
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, added, formed_basis_of, survey
from ahrsd.diagnosis.rules.spectrum import spectrum_of
from ahrsd.diagnosis.track import Spec, Track


@cache
def room(samples: int = 4000) -> Track:
    """A recording in whose remainder a field in sensor axes changes every eight seconds."""
    track = track_of(experiment("wam", motion="rov", samples=samples))
    pieces = np.floor(track.time_s / 8.0).astype(int)
    values = np.random.default_rng(8).normal(0.0, 4e-3, (pieces.max() + 1, 3))
    return replace(track, mag_b_gauss=track.mag_b_gauss + values[pieces])


def switched(track: Track) -> np.ndarray:
    """(N,) a lamp that is on for a few seconds now and then."""
    seconds = np.floor(track.time_s / 3.0).astype(int)
    return np.random.default_rng(9).integers(0, 2, seconds.max() + 1)[seconds].astype(float)


@pytest.mark.slow
def test_a_lamp_is_named_beside_a_room_that_nothing_explains():
    track = room()
    value = np.array([5e-3, -3e-3, 4e-3])
    lit = switched(track)
    reading = track.mag_b_gauss + lit[:, None] * value
    found = diagnose(replace(track, mag_b_gauss=reading, covariates={"lamp_on": lit}))
    lamp = next(one for one in found.findings if one.effect == "switched_device")
    for parameter, true in zip(lamp.parameters, value, strict=True):
        assert abs(parameter.value - true) < 4 * parameter.std < 6e-3
    assert [one.effect for one in found.findings] == ["switched_device"]
    assert found.unexplained.detected


@pytest.mark.slow
def test_a_misalignment_is_named_beside_a_room_with_its_value():
    track = room()
    angle = np.array([0.05, -0.03, 0.04])
    reading = track.mag_b_gauss @ so3.exp(angle[None])[0].T
    found = diagnose(replace(track, mag_b_gauss=reading))
    (mount,) = found.findings
    assert mount.effect == "mag_gyro_misalignment"
    values = np.array([parameter.value for parameter in mount.parameters])
    np.testing.assert_allclose(np.linalg.norm(values), np.linalg.norm(angle), rtol=0.15)
    assert abs(values @ angle) > 0.97 * np.linalg.norm(values) * np.linalg.norm(angle)
    assert found.unexplained.detected


@pytest.mark.slow
def test_a_sharp_step_is_named_beside_a_room_and_a_change_like_the_others_is_not():
    track = room()
    later = (track.time_s >= 83.0)[:, None]
    for size, named in ((0.12, ["hard_iron_step"]), (0.006, [])):
        step = size * np.array([0.6, -0.64, 0.48])
        found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + later * step))
        assert [one.effect for one in found.findings] == named
        for one in found.findings:
            values = [parameter.value for parameter in one.parameters]
            np.testing.assert_allclose(values, step, atol=0.15 * size)
            assert one.setting["onset_s"] == pytest.approx(83.0, abs=0.5)


@pytest.mark.slow
def test_a_room_alone_gets_no_name():
    track = room()
    found = diagnose(replace(track, covariates={"lamp_on": switched(track)}))
    assert found.findings == ()
    assert found.unexplained.detected


def warmed(track: Track) -> np.ndarray:
    """(N,) degrees: a box that warms up."""
    return 20.0 + 25.0 * (1 - np.exp(-(track.time_s - track.time_s[0]) / 60.0))


def beside_a_room(mag_b_gauss: np.ndarray, degrees: np.ndarray) -> tuple[str, ...]:
    """Names that stand out beside the room's remainder."""
    track = replace(room(), mag_b_gauss=mag_b_gauss, covariates={"temperature_c": degrees})
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    left = unknown.remainder(formed_basis_of(state), with_bins=False)
    assert unknown.detected(left, LIMITS)
    return named_beside(state, [], left)[0].names


def test_a_drift_beside_a_room_is_not_laid_to_the_temperature_that_settles_like_it(monkeypatch):
    track = room()
    course = np.exp(-(track.time_s - track.time_s[0]) / 35.0)[:, None]
    drifting = track.mag_b_gauss + course * [0.036, -0.03, 0.036]
    assert beside_a_room(drifting, warmed(track)) == ()
    monkeypatch.setattr(beside, "_no_more_than_a_drift", lambda *_: False)
    assert beside_a_room(drifting, warmed(track)) == ("mag_bias_temperature",)


@pytest.mark.slow
def test_a_temperature_that_has_a_course_of_its_own_is_named_beside_a_room():
    track = room()
    degrees = warmed(track) + 2.0 * np.sin(track.time_s / 9.0)
    bent = track.mag_b_gauss + (degrees - 20.0)[:, None] * [2.4e-3, -2e-3, 2.4e-3]
    assert beside_a_room(bent, degrees) == ("mag_bias_temperature",)


@pytest.mark.parametrize(
    ("form", "said"), [pytest.param("field", True, marks=pytest.mark.slow), ("gain", False)]
)
def test_a_gain_that_follows_a_current_is_no_field_of_it(form, said, monkeypatch):
    """A supply that sags with the motor's current: what is read grows with the field."""
    track = room()
    amps = 9.0 * switched(track)
    parts = {"field": np.ones_like(track.mag_b_gauss), "gain": (track.mag_b_gauss + 0.15) / 0.25}
    reading = track.mag_b_gauss + amps[:, None] * [1e-3, -0.8e-3, 1.2e-3] * parts[form]
    track = replace(track, mag_b_gauss=reading, covariates={"motor_current_a": amps})
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    left = unknown.remainder(formed_basis_of(state), with_bins=False)
    current = ("motor_current_field",)
    assert named_beside(state, [], left, hidden=True)[0].names == (current if said else ())
    monkeypatch.setattr(beside, "_as_a_gain", lambda *_: None)
    assert named_beside(state, [], left, hidden=True)[0].names == current


@pytest.mark.parametrize(
    ("eddy", "kept"), [(0.1, ("mag_time_lag", "eddy_current")), (1.0, ("eddy_current",))]
)
def test_a_delay_stays_beside_eddy_currents_that_hardly_differ_from_it(eddy, kept):
    trial = Trial(4, (("mag_time_lag", 0.7), ("eddy_current", eddy)), samples=4000)
    problem, cold = problem_of(made(trial).track, Spec(), EFFECTS, LIMITS)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    for name in ("mag_time_lag", "eddy_current"):
        seen = survey(state)
        state = added(state, next(one for one in seen.judged if one.candidate.name == name))
    assert state.problem.lag_s == pytest.approx(0.014, abs=0.008)
    state = pruned(state)
    assert state.names == kept
    assert (state.problem.lag_s > 0.0) == ("mag_time_lag" in kept)


@pytest.mark.parametrize(
    ("judged", "said"),
    [
        ([(90.0, ()), (40.0, ())], [90.0, 40.0]),
        ([(90.0, ("held-out gain",)), (80.0, ())], []),  # the likelier one may not be said
        ([(90.0, ("size",)), (80.0, ()), (40.0, ())], [80.0]),  # more than half of a crooked mount
        ([], []),
    ],
)
def test_what_is_less_likely_than_what_may_not_be_said_is_not_said(judged, said):
    seen = [
        SimpleNamespace(evidence=nats, refused=why, accepted=not why, candidate=None)
        for nats, why in judged
    ]
    assert [one.evidence for one in sayable(seen)] == said


def state_of(track: Track) -> State:
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return State(problem, fit_null(problem.track, problem.spec, cold, walk=False))


def crooked(track: Track, angle: np.ndarray) -> Track:
    """The track of a magnetometer that is mounted at an angle."""
    return replace(track, mag_b_gauss=track.mag_b_gauss @ so3.exp(angle[None])[0].T)


def test_names_lost_to_a_rest_are_sought_beside_it_though_no_course_shows_it(monkeypatch):
    """And the second, when nothing is left that a course would show."""
    track = crooked(room(), np.array([0.06, -0.05, 0.04]))
    lit = switched(track)
    reading = track.mag_b_gauss + lit[:, None] * np.array([5e-3, -3e-3, 4e-3])
    state = state_of(replace(track, mag_b_gauss=reading, covariates={"lamp_on": lit}))
    left = unknown.remainder(formed_basis_of(state))
    monkeypatch.setattr(unknown, "detected", lambda *_: False)
    assert named_beside(state, [], left)[0].names == ()
    found = named_beside(state, [], left, hidden=True)[0].names
    assert set(found) == {"mag_gyro_misalignment", "switched_device"}


class Deaf(type(EFFECTS["mag_gyro_misalignment"])):
    """A mount of which no direction can be told."""

    least_information = 1e12


def test_directions_that_are_not_paid_for_explain_nothing():
    state = state_of(crooked(room(), np.array([0.06, -0.05, 0.04])))
    basis = formed_basis_of(state)
    plain = spectrum_of(basis)
    heard, deaf = (
        _judged(state, basis, plain, Candidate(effect, {}, 1, 0.0), 1)
        for effect in (EFFECTS["mag_gyro_misalignment"], Deaf())
    )
    assert heard.evidence > 60.0
    assert deaf.what.rank == 0
    assert deaf.evidence == pytest.approx(0.0, abs=1e-6)


def test_a_lamp_that_a_free_course_explains_as_well_is_asked_for_beside_the_rest(monkeypatch):
    """Any course in time is explained by a free one, and the rest with it; other forms are not.

    What is throttled up and down often is asked for as well: nothing slow goes with it.
    """

    def named(*names: str) -> SimpleNamespace:
        setting = {"covariate": "logged"}
        candidates = [SimpleNamespace(name=name, setting=setting) for name in names]
        judged = tuple(SimpleNamespace(candidate=one) for one in candidates)
        return SimpleNamespace(named=judged, names=names, problem=SimpleNamespace(track=None))

    found = named("switched_device", "mag_bias_temperature", "motor_current_field")
    steps = {
        "forward": lambda _: (found, None, None),
        "examined": lambda state: (state, True),
        "swapped": lambda state, last: (state, [], last),
        "without_unlikely": lambda *all_of: all_of,
        "told_apart": lambda *all_of: all_of,
        "without_stand_ins": lambda *_: (named(), [], None),
        "without_imitators": lambda state: state,
        "logged_often": lambda _, candidate: candidate.name == "motor_current_field",
        **{name: lambda state: state for name in ("pruned", "paired", "eddies_alone")},
    }
    for name, step in steps.items():
        monkeypatch.setattr(sought, name, step)
    assert sought.sought(found).stood_in == {"mag_bias_temperature"}


@pytest.mark.parametrize(
    ("name", "setting", "least"),
    [
        ("motor_current_field", {"covariate": "motor_current_a"}, 20.0),
        ("mag_bias_temperature", {"covariate": "temperature_c"}, 35.0),
        ("mag_time_lag", {}, 35.0),
        ("hard_iron_step", {"onset_s": 9.0}, 75.0),
        ("gyro_bias_step", {"onset_s": 9.0}, 25.0),
    ],
)
def test_the_easier_a_rest_imitates_a_name_the_more_it_must_be_worth(name, setting, least):
    track = room()
    logged = {"motor_current_a": 9.0 * switched(track), "temperature_c": warmed(track)}
    problem = SimpleNamespace(track=replace(track, covariates=logged), limits=LIMITS)
    candidate = Candidate(EFFECTS[name], setting, 1, 0.0)
    assert beside._least_nats(candidate, problem) == least
    if name == "motor_current_field":  # a drift may be likelier for what it explains of the rest
        state = SimpleNamespace(problem=problem)
        assert not beside._no_more_than_a_drift(state, SimpleNamespace(candidate=candidate))


def test_a_step_is_looked_for_where_it_was_seen_before_it_counted_as_noise():
    """In the spectrum that holds it, another onset may be the best: of each name the likelier."""
    step = Candidate(EFFECTS["hard_iron_step"], {"onset_s": 34.2}, 1, 300.0)
    assert beside._new(step, [("gyro_bias_step", {"onset_s": 34.0}), ("mag_time_lag", {})])
    assert not beside._new(step, [("hard_iron_step", {"onset_s": 34.0})])
    assert beside._new(step, [("hard_iron_step", {"onset_s": 60.0})])
    names = (("hard_iron_step", 4.0), ("mag_time_lag", 40.0), ("hard_iron_step", 302.0))
    judged = [
        SimpleNamespace(candidate=SimpleNamespace(name=name), evidence=nats) for name, nats in names
    ]
    assert beside._best_of_each(judged) == [judged[2], judged[1]]
