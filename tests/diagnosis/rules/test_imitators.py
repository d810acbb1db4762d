"""Iron that remembers gives way to two others that say more together; forms are sought again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import imitators
from ahrsd.diagnosis.rules.findings import of_both
from ahrsd.diagnosis.rules.search import State, refitted, shaped_again, survey
from ahrsd.diagnosis.track import Spec


@pytest.mark.parametrize(
    ("names", "nats", "asked", "taken"),
    [
        (("viscous_magnetisation", "field_gradient"), (100.0, 106.0), True, True),
        (("viscous_magnetisation", "field_gradient"), (100.0, 99.0), True, False),
        (("viscous_magnetisation",), (100.0, 106.0), False, False),
        (("hard_iron_step", "field_gradient"), (100.0, 106.0), False, False),
        (("viscous_magnetisation", "mag_time_lag"), (100.0, 106.0), False, False),
    ],
)
def test_names_without_it_are_taken_where_they_are_likelier(
    monkeypatch, names, nats, asked, taken
) -> None:
    one = made(Trial(3, samples=1500)).track
    problem, cold = problem_of(one, Spec(), EFFECTS, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    judged = tuple(
        SimpleNamespace(candidate=SimpleNamespace(name=n, effect=EFFECTS[n])) for n in names
    )
    state = replace(start, named=judged)
    other = (SimpleNamespace(candidate=SimpleNamespace(name="mag_bias_temperature")),)
    libraries = []

    def found_without(poorer: State) -> tuple[State]:
        libraries.append(set(poorer.problem.library))
        return (replace(poorer, named=other),)

    together = {id(judged): nats[0]}
    monkeypatch.setattr(imitators, "refitted", lambda s, kept: replace(s, named=kept))
    monkeypatch.setattr(imitators, "forward", found_without)
    monkeypatch.setattr(imitators, "pruned", lambda s: s)
    monkeypatch.setattr(imitators, "formed_basis_of", lambda s: None)
    monkeypatch.setattr(imitators, "without_term", lambda *_: None)
    monkeypatch.setattr(imitators, "_together", lambda s, _: together.get(id(s.named), nats[1]))
    found = imitators.without_imitators(state)
    assert [set(EFFECTS) - library for library in libraries] == asked * [{"viscous_magnetisation"}]
    assert found.names == (("mag_bias_temperature",) if taken else names)
    assert set(found.problem.library) == set(EFFECTS)


def test_the_form_of_a_course_is_sought_again_in_the_joint_fit() -> None:
    """A large field by the speed looked like its square while the calibration was still bent."""
    one = made(Trial(5, (("speed_field", 4.0),), samples=6000))
    problem, cold = problem_of(one.track, Spec(), EFFECTS, LIMITS)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    best = survey(state).judged[0]
    assert best.candidate.name == "speed_field"
    power = one.truth[0][2]["power"]
    other = {**best.candidate.setting, "power": 3 - power}
    wrong = replace(best, candidate=replace(best.candidate, setting=other))
    again = shaped_again(refitted(state, (wrong,)), newest=True)
    assert again.named[0].candidate.setting["power"] == power


def test_a_deviation_holds_what_two_weightings_disagree_in() -> None:
    change = np.array([0.001, -0.007, 0.0004])
    found = of_both(change, np.full(3, 3e-4), np.full(3, 4e-4))
    np.testing.assert_allclose(found, [3e-4, np.hypot(3e-4, 0.007 - 1.5e-3), 3e-4], rtol=1e-6)
