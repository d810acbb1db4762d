"""The descent ends where the terms' own columns, not those of the point before, are lowest."""

from __future__ import annotations

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit import descent
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.search import State, added, refitted, survey
from ahrsd.diagnosis.rules.selection import likelihood
from ahrsd.diagnosis.track import Spec

TRUE, NEARLY = "gyro_nonorthogonality", "flexible_mount"


def _another_fit_gains() -> float:
    """Nats by which nine coefficients that nearly explain what three do can be fitted better."""
    track = made(Trial(4, samples=6000, scenario="lam", effects=((TRUE, 2.0),))).track
    library = {name: EFFECTS[name] for name in (TRUE, NEARLY)}
    problem, cold = problem_of(track, Spec(), library, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    said = next(one for one in survey(start).judged if one.candidate.name == NEARLY)
    state = added(start, said)
    return likelihood(refitted(state, state.named)) - likelihood(state)


@pytest.mark.slow
def test_a_fit_does_not_stop_at_columns_that_its_own_step_made_stale(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert _another_fit_gains() < 10.0
    monkeypatch.setattr(descent, "_STALE", float("inf"))
    assert _another_fit_gains() > 30.0
