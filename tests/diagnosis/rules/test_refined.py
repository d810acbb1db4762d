"""What stands alone: less is asked where nothing is named, a walk is nothing, a name is a name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS, Limits
from ahrsd.diagnosis.rules import refined as refined_module
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.explained import explained
from ahrsd.diagnosis.rules.name import ROBUST
from ahrsd.diagnosis.rules.one_source import ANY_NATS, with_any_course, with_one_source
from ahrsd.diagnosis.rules.refined import _of_any_course, left_alone, refined
from ahrsd.diagnosis.rules.search import State, formed_basis_of, survey
from ahrsd.diagnosis.rules.unknown import Remainder
from ahrsd.diagnosis.track import Spec, Track

BEGIN_S, END_S = 120.0, 160.0


LIBRARY = {name: EFFECTS[name] for name in ("hard_iron_step", "hard_iron_drift")}


def left_of(track: Track, limits: Limits = LIMITS) -> tuple[State, Remainder]:
    """A state without names and what it leaves."""
    problem, cold = problem_of(track, Spec(), LIBRARY, limits)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    left = with_one_source(unknown.remainder(formed_basis_of(state)))
    return state, refined(state.fit, state, left, None, limits)


def switched(gauss: float) -> Track:
    """Something on the vehicle is on for 40 s."""
    track = made(Trial(4)).track
    on = (track.time_s >= BEGIN_S) & (track.time_s < END_S)
    field = gauss * np.array([0.48, -0.6, 0.64])
    return replace(track, mag_b_gauss=track.mag_b_gauss + on[:, None] * field)


def drifting(rad_s_sqrt_s: float) -> Track:
    """A gyro whose bias walks by so much."""
    track = made(Trial(4)).track
    step = np.sqrt(np.nan_to_num(track.dt_s))[:, None]
    walk = np.random.default_rng(8).normal(size=(len(track), 3)) * step * rad_s_sqrt_s
    return replace(track, gyro_b_rad_s=track.gyro_b_rad_s + np.cumsum(walk, axis=0))


@cache
def left_of_switched(gauss: float) -> tuple[State, Remainder]:
    """What several tests begin with."""
    return left_of(switched(gauss))


@cache
def left_of_step() -> tuple[State, Remainder]:
    """A step of the hard iron, before it has a name."""
    return left_of(stepped())


@cache
def stepped() -> Track:
    return made(Trial(7, effects=(("hard_iron_step", 0.6),))).track


@cache
def robust_p_of_step() -> float:
    """What its blocks say of the step."""
    return survey(left_of_step()[0]).judged[0].robust_family_p


@pytest.mark.parametrize(("gauss", "alone", "beside"), [(0.0, 0, 0), (2.2e-4, 1, 0), (4e-4, 1, 1)])
def test_alone_less_is_asked_of_it_than_beside_a_name(gauss, alone, beside) -> None:
    state, left = left_of_switched(gauss)
    assert unknown.detected(left, LIMITS) == bool(beside)
    same, rest, seen = left_alone(state.fit, state, left)
    assert same is state
    assert rest is left
    assert (seen is not None) == bool(alone)
    if seen is not None:
        ((begin, end),) = seen.spells_s
        assert (begin, end) == pytest.approx((BEGIN_S, END_S), abs=6.0)
        assert seen.strongest.evidence > LIMITS.alone_nats


def test_an_ordinary_walk_of_the_gyro_is_nothing() -> None:
    state, left = left_of(drifting(1.2e-5))
    assert left.strongest.frame == "gyro"
    assert left.strongest.evidence > LIMITS.alone_nats
    walking, rest, seen = left_alone(state.fit, state, left)
    assert walking.walk > 0.0
    assert seen is None
    assert not unknown.detected(rest, LIMITS.alone())


@pytest.mark.slow
def test_a_large_walk_of_the_gyro_is_something() -> None:
    state, left = left_of(drifting(1e-4))
    assert left_alone(state.fit, state, left)[2] is not None


def wobbling(gauss: float, noise: str, turn_s: float) -> Track:
    """Every reading is longer and shorter by so much, in turns."""
    track = made(Trial(4, noise=noise)).track
    unit = track.mag_b_gauss / np.linalg.norm(track.mag_b_gauss, axis=1, keepdims=True)
    turns = np.sign(np.sin(np.pi * track.time_s / turn_s))
    return replace(track, mag_b_gauss=track.mag_b_gauss + gauss * turns[:, None] * unit)


@pytest.mark.parametrize(
    ("gauss", "noise", "turn_s", "told"),
    [
        (0.9e-4, "white", 8.5, False),
        (1.0e-4, "white", 30.0, True),
        # what is red may be the noise's own, also where that is next to white
        pytest.param(0.0, "red", 8.5, False, marks=pytest.mark.slow),
        pytest.param(1.2e-4, "white", 8.5, False, marks=pytest.mark.slow),
        # and where it is slow; but nothing that forgets within two seconds is as slow as this
        pytest.param(8e-4, "white", 8.5, False, marks=pytest.mark.slow),
        pytest.param(8e-4, "red", 8.5, False, marks=pytest.mark.slow),
        pytest.param(1.2e-3, "white", 8.5, True, marks=pytest.mark.slow),
    ],
)
def test_a_quick_course_is_seen_alone_where_it_can_be_no_noise(gauss, noise, turn_s, told) -> None:
    state, left = left_of(wobbling(gauss, noise, turn_s))
    assert not unknown.detected(left, LIMITS)
    _, rest, seen = left_alone(state.fit, state, left)
    assert (seen is not None) is told
    if seen is not None:
        assert seen.strongest.frame in ("sensor", "world")
        assert seen.strongest.evidence > ANY_NATS
        assert not rest.one_source


@pytest.mark.parametrize(
    ("colour", "slow", "asked"),
    [
        (1.0, 0.0, True),
        (1.14, 0.0, True),
        (1.22, 0.04, False),  # `ring120d`, b38bd190: a twentieth of the noise is red
        (15.6, 0.44, False),  # `ring600j`, 18a2391a: a quarter is, and forgets within two seconds
        (15.6, 0.62, True),
    ],
)
def test_where_a_quick_course_can_be_no_noise(monkeypatch, colour, slow, asked) -> None:
    monkeypatch.setattr(refined_module, "slowness", lambda basis: slow)
    left = SimpleNamespace(basis=SimpleNamespace(rest=None, colour=colour))
    monkeypatch.setattr(refined_module, "formed_basis_of", lambda state: left.basis)
    monkeypatch.setattr(refined_module, "smooth_nats", lambda _: {"sensor": 0.0})
    monkeypatch.setattr(refined_module, "heading_nats", lambda _: 0.0)
    monkeypatch.setattr(refined_module, "with_any_course", lambda *_: "asked")
    assert (_of_any_course(SimpleNamespace(), left) == "asked") is asked


@pytest.mark.parametrize(
    ("slow", "quick", "gyro", "frame"),
    [
        (-1.1, ANY_NATS - 0.1, -5.0, None),
        (-1.1, ANY_NATS + 0.1, -5.0, "sensor"),
        (7.0, 6.4, -5.0, "world"),  # a slow course of a field is one as well
        (-1.1, 6.4, 8.0, None),  # a gyro's bias that walks is none
        (-1.1, 8.1, 8.0, "sensor"),
    ],
)
def test_a_field_alone_of_whatever_course(slow, quick, gyro, frame) -> None:
    _, left = left_of_switched(0.0)
    nats = {"sensor": -1.1, "world": slow, "gyro": gyro}
    located = {k: replace(one, evidence=nats[k]) for k, one in left.located.items()}
    courses = {"sensor": replace(left.quick["sensor"], evidence=quick)}
    given = replace(left, located=located, quick=courses)
    told = with_any_course(given)
    assert told.one_source is (frame is not None)
    if frame is None:
        assert told is given
    else:
        assert told.strongest.frame == frame
        assert told.strongest.evidence == max(slow, quick)
        assert told.strongest.p_value == pytest.approx(np.exp(-max(slow, quick)))


@pytest.mark.parametrize(
    ("times", "named"), [(5.0, True), pytest.param(50.0, False, marks=pytest.mark.slow)]
)
def test_a_name_that_few_blocks_show_is_told_where_it_explains_all(times, named) -> None:
    assert unknown.detected(left_of_step()[1], LIMITS)
    strict = replace(LIMITS, robust_family_p=robust_p_of_step() / times)
    state, left = left_of(stepped(), strict)
    assert survey(state).judged[0].refused == (ROBUST,)
    found = explained(state, left, strict.alone())
    assert (found is not None) == named
    if found is not None:
        tried, surveys, last, rest = found
        assert tried.names == ("hard_iron_step",)
        assert len(surveys) == 1
        # what the name explains is gone from the others, so they are rivals for its place
        drift = [
            next(c.evidence for c in seen.candidates if c.name == "hard_iron_drift")
            for seen in (surveys[0], last)
        ]
        assert drift[0] > 10.0
        assert drift[1] < 2.0
        assert not unknown.detected(rest, strict.alone())


@pytest.mark.parametrize(
    ("nats", "colour", "frame"),
    [
        ({"world": 1.0, "sensor": np.log(1000.0) + 0.1}, 1.0, "sensor"),
        ({"world": np.log(1000.0) - 0.1, "sensor": 1.0}, 1.0, None),
        # slow noise has more at long periods than its colour tells
        ({"world": np.log(1e6) - 0.1, "sensor": 1.0}, 3.0, None),
        ({"world": np.log(1e6) + 0.1, "sensor": 1.0}, 3.0, "world"),
    ],
)
def test_a_smooth_course_alone(monkeypatch, nats, colour, frame) -> None:
    state, left = left_of_switched(0.0)
    basis = replace(formed_basis_of(state), colour=colour)
    monkeypatch.setattr(refined_module, "formed_basis_of", lambda _: basis)
    monkeypatch.setattr(refined_module, "smooth_nats", lambda _: dict(nats))
    monkeypatch.setattr(refined_module, "heading_nats", lambda _: -1.0)
    quiet = replace(left, quick={})
    told = _of_any_course(state, quiet)
    if frame is None:
        assert told is quiet
    else:
        assert (told.strongest.frame, told.strongest.evidence) == (frame, nats[frame])
        assert unknown.detected(told, LIMITS.alone())


def test_a_name_hardly_likelier_than_a_smooth_course_is_none(monkeypatch) -> None:
    strict = replace(LIMITS, robust_family_p=robust_p_of_step() / 5)
    state, left = left_of(stepped(), strict)
    asked: list[tuple[str, ...]] = []

    def hardly(tried: State) -> tuple[list[int], str]:
        asked.append(tried.names)
        return [0], "sensor"

    assert explained(state, left, strict.alone()) is not None
    monkeypatch.setattr("ahrsd.diagnosis.rules.explained.hardly_likelier", hardly)
    assert explained(state, left, strict.alone()) is None
    assert asked == [("hard_iron_step",)]


def test_a_name_that_leaves_something_is_none() -> None:
    """A jump and one back: a step explains a part of it, and only the blocks refuse it."""
    track = switched(8e-4)
    strict = replace(
        LIMITS, robust_family_p=survey(left_of(track)[0]).judged[0].robust_family_p / 5
    )
    state, left = left_of(track, strict)
    assert survey(state).judged[0].refused == (ROBUST,)
    assert explained(state, left, strict.alone()) is None


def test_a_name_that_passes_everything_was_asked_before_and_is_not_told_here() -> None:
    state, left = left_of_step()
    assert survey(state).judged[0].accepted
    assert explained(state, left, LIMITS.alone()) is None
