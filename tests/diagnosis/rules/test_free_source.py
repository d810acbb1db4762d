"""Names that no column bears out, held against one source that is free in time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import free_source
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.free_source import free_nats, without_names_of_a_source
from ahrsd.diagnosis.rules.refined import WHITE
from ahrsd.diagnosis.rules.rivals import MORE_NATS
from ahrsd.diagnosis.track import Track

SETTINGS = {"switched_device": {"covariate": "lamp_on"}, "hard_iron_step": {"onset_s": 9.0}}
LEAD = LIMITS.lead_nats


def remainder(
    slow: float, quick: float = -5.0, *, one_source: bool = False, colour: float = 1.0
) -> SimpleNamespace:
    """A remainder whose slow and quick courses are so likely; detected by its slow one."""
    strongest = SimpleNamespace(frame="sensor", evidence=slow, p_value=1e-9 if slow > 0 else 1.0)
    return SimpleNamespace(
        strongest=strongest,
        located={"sensor": strongest},
        quick={"sensor": SimpleNamespace(frame="sensor", evidence=quick, p_value=1e-9)},
        one_source=one_source,
        bins=(),
        stood_in=None,
        basis=SimpleNamespace(rest=None, colour=colour),
    )


def state_of(*names: tuple[str, float], walk: float = 0.0) -> SimpleNamespace:
    judged = [
        SimpleNamespace(
            candidate=SimpleNamespace(name=name, setting=SETTINGS.get(name, {}), paid=0.0),
            evidence=nats,
        )
        for name, nats in names
    ]
    problem = SimpleNamespace(limits=LIMITS)
    return SimpleNamespace(named=tuple(judged), problem=problem, walk=walk)


QUIET, RED = remainder(-1.0), remainder(-1.0, colour=1.01 * WHITE)
WEAK, TWO = (("viscous_magnetisation", 31.0),), (("eddy_current", 31.7), ("eddy_current", 27.7))
MANY = (("viscous_magnetisation", 42.6), ("earth_rotation", 30.9), ("hysteresis", 10.8))
CURRENT, STEP = ("switched_device", 9.0), ("hard_iron_step", 9.0)


@pytest.mark.parametrize(
    ("names", "left", "source", "gone"),
    [
        # a name of 31 nats for a speed that nobody logged
        (WEAK, QUIET, remainder(20.0, 53.0), [0]),
        (WEAK, QUIET, remainder(20.0, 31.1), [0]),
        (WEAK, QUIET, remainder(20.0, 30.9), []),
        (WEAK, QUIET, remainder(31.1), [0]),
        # what is quick may be noise that is not white, unless it is one source before and after
        (WEAK, RED, remainder(20.0, 53.0), []),
        (WEAK, RED, remainder(20.0, 53.0, one_source=True), []),
        (WEAK, RED, remainder(40.0), [0]),
        # 59.4 nats of two names and 6.6 of the rest, for 119.8 of a current that is on now and then
        (
            TWO,
            remainder(6.6, one_source=True, colour=2.0),
            remainder(9.0, 119.8, one_source=True),
            [0, 1],
        ),
        (TWO, remainder(6.6, one_source=True, colour=2.0), remainder(9.0, 119.8), []),
        # beside a rest it must be likelier than all of them and the rest
        (WEAK, remainder(20.0), remainder(51.1 + MORE_NATS), [0]),
        (WEAK, remainder(20.0), remainder(50.9 + MORE_NATS), []),
        (WEAK, remainder(13.0, 20.0), remainder(50.9 + MORE_NATS), []),
        # than each of three of the motion, but two effects are seen on vehicles
        (MANY, QUIET, remainder(63.2), [0, 1, 2]),
        (MANY, QUIET, remainder(42.0), []),
        (MANY, remainder(30.0), remainder(63.2), []),
        (MANY[:2], QUIET, remainder(63.2), []),
        ((*MANY[:2], STEP), QUIET, remainder(63.2), []),
        ((*MANY[:2], CURRENT), QUIET, remainder(63.2), []),
        # what is logged, a delay and a bias that changes are no part of what is not
        ((CURRENT,), QUIET, remainder(63.2), []),
        ((("mag_time_lag", 9.0),), QUIET, remainder(63.2), []),
        ((("gyro_startup", 9.0),), remainder(20.0), remainder(63.2), []),
        ((CURRENT, *WEAK), QUIET, remainder(63.2), [1]),
        # a jump of the outside field may be what a gyro's bias left behind
        ((("field_step", 40.0 - 0.1),), QUIET, remainder(-5.0), [0]),
        ((("field_step", 40.0 + 0.1),), QUIET, remainder(-5.0), []),
        ((("hard_iron_step", 31.0),), QUIET, remainder(-5.0), []),
        # a source that is not there by itself is none
        ((("eddy_current", 1.0),), QUIET, remainder(8.0), []),
        ((), remainder(30.0), remainder(80.0), []),
    ],
)
def test_a_free_source_against_names(monkeypatch, names, left, source, gone) -> None:
    taken: list[int] = []
    slim = SimpleNamespace()

    def dropped(state, surveys, terms, rest):
        taken.extend(terms)
        return slim, ["without"], rest

    state = state_of(*names)
    nats = {id(one.candidate): one.evidence for one in state.named}
    bare = SimpleNamespace(without=lambda *_: bare, colour=1.0)
    monkeypatch.setattr(free_source, "dropped", dropped)
    monkeypatch.setattr(free_source, "formed_basis_of", lambda _: bare)
    monkeypatch.setattr(free_source, "added_value", lambda *_: None)
    monkeypatch.setattr(free_source, "evidence_of", lambda _, candidate: nats[id(candidate)])
    monkeypatch.setattr(free_source.unknown, "remainder", lambda *_, **__: source)
    monkeypatch.setattr(free_source, "with_one_source", lambda one: one)
    monkeypatch.setattr(free_source, "with_gyro_course", with_gyro_of_40)
    monkeypatch.setattr(free_source, "framed", lambda *_: source)
    monkeypatch.setattr(free_source, "with_any_course", sure_of_the_quick)
    monkeypatch.setattr(free_source, "as_smooth", lambda *_: ([], None))
    monkeypatch.setattr(free_source, "replace", lambda one, **_: one)
    after, surveys, rest = without_names_of_a_source(state, ["with"], left)
    if gone:
        assert (taken, after, surveys) == (gone, slim, ["without"])
        assert free_nats(rest, quick=True) >= free_nats(source, quick=True)
    else:
        assert (after, surveys) == (state, ["with"])
        assert rest is left


def with_gyro_of_40(left: SimpleNamespace) -> SimpleNamespace:
    """A gyro whose bias came and went for a moment, in every remainder where it is asked for."""
    gyro = SimpleNamespace(frame="gyro", evidence=40.0, p_value=1e-9)
    return SimpleNamespace(**{**vars(left), "quick": {**left.quick, "gyro": gyro}})


def sure_of_the_quick(left: SimpleNamespace) -> SimpleNamespace:
    quick = max(left.quick.values(), key=lambda one: one.evidence)
    if quick.evidence < left.strongest.evidence:
        return left
    return SimpleNamespace(
        **{**vars(left), "strongest": quick, "located": {quick.frame: quick}, "one_source": True}
    )


def test_beside_a_bias_that_wanders_nothing_is_asked(monkeypatch) -> None:
    monkeypatch.setattr(free_source, "formed_basis_of", lambda _: None)
    monkeypatch.setattr(free_source, "as_smooth", lambda *_: ([], None))
    state = state_of(*WEAK, walk=1e-5)
    assert without_names_of_a_source(state, ["with"], QUIET) == (state, ["with"], QUIET)


def test_odds_that_a_sought_form_needs_beside_a_smooth_course(monkeypatch) -> None:
    """1000 to 1 for iron that remembers, 20 to 1 for steps as one; a trend is asked nothing."""
    asked: list[dict[tuple[int, ...], float]] = []

    def as_smooth(_state, _basis, least):
        asked.append(least)
        return [0], "world"

    state = state_of(*WEAK, STEP, ("hard_iron_drift", 9.0), CURRENT, ("mag_scale", 9.0), STEP)
    slim = SimpleNamespace(problem=state.problem, named=(), walk=0.0)
    monkeypatch.setattr(free_source, "formed_basis_of", lambda _: None)
    monkeypatch.setattr(free_source, "as_smooth", as_smooth)
    monkeypatch.setattr(free_source, "dropped", lambda *_: (slim, [], remainder(-1.0)))
    monkeypatch.setattr(free_source, "replace", lambda one, **more: (one, more))
    after, surveys, (_, more) = without_names_of_a_source(state, ["with"], QUIET)
    assert asked == [{(0,): pytest.approx(np.log(1000.0)), (1, 5): LEAD}]
    assert (after, surveys, more) == (slim, [], {"stood_in": "world"})


@dataclass(frozen=True)
class Noisy:
    """A basis of which only the power of its noise, over white, is asked."""

    colour: float

    def without(self, *_) -> Noisy:
        return self


@pytest.mark.parametrize(("colour", "gone"), [(1.0, False), (1.05, True)])
def test_names_and_source_are_held_against_one_another_in_the_same_noise(
    monkeypatch, colour, gone
) -> None:
    """A drift of 6429 nats in white noise has 6300 in the noise that its own fit leaves."""
    state = state_of(("geomagnetic_drift", 6300.0))
    source, kept = remainder(6390.0, colour=colour), (state, ["with"], QUIET)
    slim = SimpleNamespace()
    monkeypatch.setattr(free_source, "formed_basis_of", lambda _: Noisy(1.05))
    monkeypatch.setattr(free_source, "evidence_of", lambda basis, _: 6429.0 / basis.colour)
    monkeypatch.setattr(free_source, "added_value", lambda *_: None)
    monkeypatch.setattr(free_source, "as_smooth", lambda *_: ([], None))
    monkeypatch.setattr(free_source, "with_one_source", lambda one: one)
    monkeypatch.setattr(free_source.unknown, "remainder", lambda *_, **__: source)
    monkeypatch.setattr(free_source, "dropped", lambda *_: (slim, [], source))
    monkeypatch.setattr(free_source, "framed", lambda *_: source)
    monkeypatch.setattr(free_source, "with_any_course", lambda one: one)
    after = without_names_of_a_source(state, ["with"], QUIET)
    assert after == ((slim, [], source) if gone else kept)


def with_field(course) -> Track:
    """A field of 1 mG, fixed to the vehicle, whose course (N,) nobody logged."""
    track = made(Trial(4)).track
    field = 1e-3 * np.outer(course(track.time_s), [0.48, -0.6, 0.64])
    return replace(track, mag_b_gauss=track.mag_b_gauss + field)


def warming(time_s):
    """A sensor that takes its time, as its temperature does."""
    return 1.0 - np.exp(-time_s / 250.0)


@pytest.mark.slow
def test_a_sensor_that_warms_is_no_iron_that_remembers() -> None:
    """328 nats as that; a smooth course has hardly less, and nobody logged a temperature."""
    library = {name: EFFECTS[name] for name in ("viscous_magnetisation", "hard_iron_step")}
    warm = diagnose(with_field(warming), library=library)
    assert [one.effect for one in warm.findings] == []
    assert warm.unexplained.detected and warm.unexplained.where.frame == "sensor"
