"""Names that are held against each other are so at the same moments."""

from __future__ import annotations

from dataclasses import replace

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import search
from ahrsd.diagnosis.rules.moments import as_found, at_one_moment
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.search import State, formed_basis_of, refitted, survey
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.swapping import swapped
from ahrsd.diagnosis.track import Spec

NAMES = ("hard_iron_step", "soft_iron_step", "geomagnetic_drift")
OTHER_S, TRIED = 40.0, 64


@pytest.fixture(scope="module")
def state() -> tuple[State, float]:
    """A recording with a magnet that was moved, and when."""
    trial = Trial(3, samples=4_000, sigma_mag=1.5e-3, effects=(("hard_iron_step", 0.4),))
    one = made(trial)
    library = {name: EFFECTS[name] for name in NAMES}
    problem, cold = problem_of(one.track, Spec(), library, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    return start, float(one.truth[0][2]["onset_s"])


def _at(basis: Base, name: str, onset_s: float, tried: int = TRIED) -> Candidate:
    found = Candidate(EFFECTS[name], {"onset_s": onset_s}, tried, 0.0)
    return replace(found, evidence=evidence_of(basis, found) - 4.16)


def test_a_moment_that_one_step_found_is_asked_of_the_others(state: tuple[State, float]) -> None:
    start, onset_s = state
    basis = formed_basis_of(start)
    missed = _at(basis, "hard_iron_step", OTHER_S, tried=16)
    seen = [missed, _at(basis, "soft_iron_step", onset_s)]
    best, other = at_one_moment(basis, seen)
    assert best.name == "hard_iron_step"
    assert best.setting == other.setting == {"onset_s": onset_s}
    assert best.tried == TRIED
    assert best.evidence > missed.evidence + 20.0
    assert best.evidence == pytest.approx(_at(basis, "hard_iron_step", onset_s).evidence, abs=0.01)


def test_a_worse_moment_is_not_taken(state: tuple[State, float]) -> None:
    start, onset_s = state
    basis = formed_basis_of(start)
    right, wrong = _at(basis, "hard_iron_step", onset_s), _at(basis, "soft_iron_step", OTHER_S)
    assert at_one_moment(basis, [right, wrong])[0] is right
    assert as_found(basis, [right], _at(basis, "hard_iron_step", OTHER_S)) == (right,)
    assert as_found(basis, [right], None) == (right,)


def test_a_name_is_not_swapped_because_the_search_for_it_missed_its_moment(
    state: tuple[State, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A search that began elsewhere told it as a change of the soft iron, of six coefficients."""
    start, _ = state
    first = survey(start).judged[0]
    named = refitted(start, (first,))
    assert named.names == ("hard_iron_step",)
    last = survey(named)
    whole = search.best_settings

    def missing(*asked: object) -> list[Candidate]:
        basis = asked[0]
        assert isinstance(basis, Base)
        found = whole(*asked)  # type: ignore[arg-type]
        return [_at(basis, c.name, OTHER_S) if c.name == first.candidate.name else c for c in found]

    monkeypatch.setattr(search, "best_settings", missing)
    kept, surveys, _ = swapped(named, last)
    assert kept.names == ("hard_iron_step",)
    assert kept.named[0].candidate.setting == first.candidate.setting
    assert surveys[0].candidates[0].name == "hard_iron_step"
