"""What an effect is worth over all its settings, and how many ways lead to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.rules.settings import _averaged, best_settings, evidence_of
from ahrsd.diagnosis.track import Spec

DRIFT = EFFECTS["hard_iron_drift"]


@pytest.fixture(scope="module")
def basis() -> Base:
    """Of iron that drifts a little: all its forms explain it."""
    track = made(Trial(11, effects=(("hard_iron_drift", 0.5),), samples=6000)).track
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return formed_basis_of(State(problem, fit_null(problem.track, Spec(), cold, walk=False)))


def options(*nats: float) -> list[Candidate]:
    """Settings with that evidence, their choice paid for."""
    return [Candidate(DRIFT, {"k": k}, len(nats), e) for k, e in enumerate(nats)]


def test_settings_that_do_as_well_cost_nothing() -> None:
    best = _averaged(options(5.0, 5.0, 5.0, 5.0))
    assert best.alike == pytest.approx(4.0)
    assert best.paid == pytest.approx(0.0)
    assert best.evidence == pytest.approx(5.0 + np.log(4.0))


def test_one_setting_among_many_is_paid_for() -> None:
    best = _averaged(options(5.0, -30.0, 25.0, -30.0))
    assert best.setting == {"k": 2}
    assert best.paid == pytest.approx(np.log(4.0))
    assert best.evidence == pytest.approx(25.0)


def test_what_cannot_be_stays_so() -> None:
    assert _averaged(options(-np.inf, -np.inf)).evidence == -np.inf


def test_the_mean_of_the_bayes_factors(basis: Base) -> None:
    """Computed anew from each form's own evidence."""
    library = {"hard_iron_drift": DRIFT}
    (found,) = best_settings(basis, library, [])
    forms = DRIFT.settings(basis.context)
    alone = [evidence_of(basis, Candidate(DRIFT, form, 1, 0.0)) for form in forms]
    mean = float(np.logaddexp.reduce(alone) - np.log(len(forms)))
    assert 10.0 < mean < max(alone)
    assert found.evidence == pytest.approx(mean, abs=1e-6)
    assert max(alone) - found.paid == pytest.approx(mean, abs=1e-6)
    assert found.alike > 1.2


def test_a_temperature_that_nobody_logged_is_one_more_way_to_a_drift(basis: Base) -> None:
    track = basis.context.track
    bare = {k: v for k, v in track.covariates.items() if "temperature" not in k}
    assert len(bare) < len(track.covariates)
    context = replace(basis.context, track=replace(track, covariates=bare))
    unlogged = replace(basis, context=context)
    both = {k: EFFECTS[k] for k in ("hard_iron_drift", "mag_bias_temperature")}
    alone = {"hard_iron_drift": DRIFT}

    def drift(seen: Base, library) -> float:
        return {c.name: c.evidence for c in best_settings(seen, library, [])}["hard_iron_drift"]

    assert drift(unlogged, both) - drift(basis, both) == pytest.approx(np.log(2.0), abs=1e-6)
    # a library without that effect knows of no such way
    assert drift(unlogged, alone) == pytest.approx(drift(basis, alone), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "key", "again"),
    [
        ("motor_current_field", "late_s", False),
        ("field_gradient", "turn_deg", False),
        ("hard_iron_step", "onset_s", True),
    ],
)
def test_a_cause_is_read_in_one_way(basis: Base, name: str, key: str, again: bool) -> None:
    """A current is not late by two times at once, and one north is not turned by two angles."""
    effect = EFFECTS[name]
    one, *others = effect.settings(basis.context)
    taken = [(name, {**one, key: 0.123})]
    assert others or name == "motor_current_field"
    found = [candidate.name for candidate in best_settings(basis, {name: effect}, taken)]
    assert found == ([name] if again else [])
