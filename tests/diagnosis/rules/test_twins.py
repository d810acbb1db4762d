"""A drift of the hard iron and a compensation on board, each forced in the other's place."""

from dataclasses import replace
from functools import cache

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.findings import shares_of
from ahrsd.diagnosis.rules.search import State, Survey, added, refitted, survey
from ahrsd.diagnosis.rules.swapping import swapped
from ahrsd.diagnosis.rules.twins import told_apart
from ahrsd.diagnosis.track import Spec

DRIFT, ON_BOARD = "hard_iron_drift", "onboard_calibration_active"


@cache
def forced(true: str, strength: float, said: str) -> tuple[State, list[Survey], Survey]:
    """A state that has another name for what is in the recording, its surveys and the last."""
    trial = Trial(5, samples=4_000, sigma_mag=5e-4, effects=((true, strength),))
    problem, cold = problem_of(
        made(trial).track, Spec(), {name: EFFECTS[name] for name in (DRIFT, ON_BOARD)}, LIMITS
    )
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    seen = survey(start)
    wrong = next(one for one in seen.judged if one.candidate.name == said)
    state = added(start, wrong)
    return state, [seen], survey(state)


@pytest.mark.parametrize(
    ("true", "strength", "said"), [(ON_BOARD, 0.06, DRIFT), (DRIFT, 1.0, ON_BOARD)]
)
def test_the_joint_fit_tells_which_of_the_two_it_is(true: str, strength: float, said: str) -> None:
    state, surveys, last = forced(true, strength, said)
    assert state.names == (said,)
    right, seen, after = told_apart(state, surveys, last)
    assert right.names == (true,)
    assert right.fit.log_likelihood > state.fit.log_likelihood + 20
    assert shares_of(right, 0, seen[0], after)[true] > 0.99
    again, _, _ = told_apart(*swapped(state, last))
    assert again.names == (true,)


def test_a_twin_that_cannot_be_told_apart_is_said_with_the_name() -> None:
    """Too weak to tell: both stay in the set, as the joint fits say."""
    state, _, last = forced(ON_BOARD, 0.0015, DRIFT)
    kept, seen, after = told_apart(*swapped(state, last))
    shares = shares_of(kept, 0, seen[0], after)
    assert shares[DRIFT] + shares[ON_BOARD] > 0.99
    assert min(shares[DRIFT], shares[ON_BOARD]) > 0.02


def test_a_twin_that_a_gate_refused_takes_no_place() -> None:
    state, (seen,), last = forced(ON_BOARD, 0.06, DRIFT)
    refused = tuple(
        replace(one, refused=("held-out gain",)) if one.candidate.name == ON_BOARD else one
        for one in seen.judged
    )
    kept, _, _ = told_apart(state, [replace(seen, judged=refused)], last)
    assert kept is state


def test_others_are_left_alone() -> None:
    trial = Trial(3, samples=3_000, sigma_mag=1.5e-3, effects=(("hard_iron_step", 0.4),))
    library = {name: EFFECTS[name] for name in ("hard_iron_step", DRIFT, ON_BOARD)}
    problem, cold = problem_of(made(trial).track, Spec(), library, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    seen = survey(start)
    step = next(one for one in seen.judged if one.candidate.name == "hard_iron_step")
    state = refitted(start, (step,))
    last = survey(state)
    assert told_apart(state, [seen], last) == (state, [seen], last)
