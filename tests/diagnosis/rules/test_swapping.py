"""A name gives way to one that explains more, if the joint fit with that one is likelier."""

from __future__ import annotations

from functools import cache

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.search import State, Survey, added, survey
from ahrsd.diagnosis.rules.swapping import _replaced, _without, swapped
from ahrsd.diagnosis.track import Spec

DRIFT, OUTSIDE = "hard_iron_drift", "geomagnetic_drift"


@cache
def named(true: str, said: str) -> tuple[State, Survey, Survey]:
    """A state with that name for what is in the recording, the survey without it, and the last."""
    trial = Trial(5, samples=4_000, sigma_mag=5e-4, effects=((true, 1.0),))
    problem, cold = problem_of(
        made(trial).track, Spec(), {name: EFFECTS[name] for name in (DRIFT, OUTSIDE)}, LIMITS
    )
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    state = added(start, judged(survey(start), said))
    last = survey(state)
    return state, _without(state, 0, last.basis)[0], last


def judged(seen: Survey, name: str) -> Judged:
    return next(one for one in seen.judged if one.candidate.name == name)


@pytest.mark.parametrize(("true", "other"), [(DRIFT, OUTSIDE), (OUTSIDE, DRIFT)])
def test_the_wrong_name_gives_way_and_the_right_one_does_not(true: str, other: str) -> None:
    state, seen, last = named(true, other)
    assert state.names == (other,)
    assert _replaced(state, 0, judged(seen, true), seen).names == (true,)
    assert swapped(state, last)[0].names == (true,)
    right, seen, last = named(true, true)
    assert _replaced(right, 0, judged(seen, other), seen) is right
    assert swapped(right, last)[0] is right


@pytest.mark.parametrize(("short", "asked"), [(0.05, True), (0.2, False)])
def test_what_is_nearly_as_likely_by_its_columns_is_asked_by_the_joint_fit(
    monkeypatch: pytest.MonkeyPatch, short: float, asked: bool
) -> None:
    state, _, last = named(DRIFT, OUTSIDE)
    mine = _without(state, 0, last.basis)[1]
    monkeypatch.setattr(
        "ahrsd.diagnosis.rules.swapping.in_its_place", lambda candidate, last: (1.0 - short) * mine
    )
    assert swapped(state, last)[0].names == ((DRIFT,) if asked else (OUTSIDE,))
