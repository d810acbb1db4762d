"""A mount that bends alike in all directions turns the outside field; what else no motion shows."""

from __future__ import annotations

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.findings import with_unseen
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, added, survey
from ahrsd.diagnosis.track import Spec

MOUNT = EFFECTS["flexible_mount"]


def test_what_no_motion_shows_is_known_as_the_prior_knows_it():
    told = with_unseen(Candidate(MOUNT, {}, 1, 0.0), np.full(9, 3e-4)).reshape(3, 3)
    assert np.diag(told) == pytest.approx(np.full(3, np.hypot(3e-4, 0.01 / np.sqrt(3))))
    assert told[~np.eye(3, dtype=bool)] == pytest.approx(np.full(6, 3e-4))
    plain = Candidate(EFFECTS["hard_iron_step"], {"onset_s": 1.0}, 1, 0.0)
    assert with_unseen(plain, np.full(3, 2e-4)) == pytest.approx(np.full(3, 2e-4))


def test_a_change_of_the_outside_field_does_not_turn_the_world(monkeypatch) -> None:
    """North is where the field points: what turns it is not seen, and must not run away."""
    name = "geomagnetic_drift"
    trial = Trial(6, samples=9_000, sigma_gyro=5e-3, effects=((name, 1.0),))
    problem, cold = problem_of(made(trial).track, Spec(), {name: EFFECTS[name]}, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    judged = survey(start).judged[0]
    held = added(start, judged)
    assert np.linalg.norm(held.fit.terms[0].value) < 2.5e-3  # 2.0e-3 is true
    monkeypatch.setattr(type(EFFECTS[name]), "loose", 30.0)
    loose = added(start, judged)
    assert np.linalg.norm(loose.fit.terms[0].value) > 4.5e-3
    assert held.fit.log_likelihood > loose.fit.log_likelihood
