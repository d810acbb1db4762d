"""One diagnosis by one generative model.

hygiene -> null fit -> richest model, linearised -> search over sets -> linearised there -> ...
        -> names, and what is left beyond the ordinary
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis import roles
from ahrsd.diagnosis.descent import NullFit
from ahrsd.diagnosis.diagnosis import Diagnosis
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.facts import matters, of_fact, stopped
from ahrsd.diagnosis.hygiene import hygiene, put_right
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.null import baseline, fit_null, unusable
from ahrsd.diagnosis.one_model.sampled_turns import broken_where_unsampled
from ahrsd.diagnosis.one_model.search_rounds import answered
from ahrsd.diagnosis.pauses import without_jumps
from ahrsd.diagnosis.problem import Problem, model_at_rate, problem_of
from ahrsd.diagnosis.track import NothingToFit, Spec, Track

NOTE = "by the engine one-model, which is experimental"


def begun(track: Track, spec: Spec, library: Mapping[str, Effect]) -> tuple[Problem, NullFit]:
    """A track that hygiene has put right at its working rate, and the fit of a null to it."""
    problem, cold = problem_of(broken_where_unsampled(track), spec, library, LIMITS)
    return problem, fit_null(problem.track, problem.spec, cold, walk=False)


def diagnose(
    track: Track,
    spec: Spec | None = None,
    *,
    library: Mapping[str, Effect] = EFFECTS,
    recording: str = "",
) -> Diagnosis:
    """Where the recording and the model differ, and which physics was left out.

    Deterministic.  ValueError, one line, where nothing can be fitted.
    """
    track, notes = roles.prepared(track)
    track, jumped = without_jumps(track)
    if why := unusable(track):
        raise NothingToFit(why)
    facts = hygiene(track)
    said = [of_fact(fact, library) for fact in facts if matters(fact)]
    notes = (NOTE, *jumped, *notes, *(fact.words for fact in facts if not matters(fact)))
    if any(fact.stops for fact in facts):
        return stopped(recording, [fact for fact in facts if fact.stops], library, notes)
    problem, start = begun(put_right(track, facts), spec or Spec(), library)
    answer, model = answered(problem, start, library)
    something = bool(said or answer.findings or answer.unexplained.detected)
    return Diagnosis(
        recording=recording,
        baseline=baseline(start),
        mismatch=something,
        p_value=float(np.exp(-max(answer.log_odds, 0.0))) if not said else 0.0,
        findings=(*said, *answer.findings),
        unexplained=answer.unexplained,
        posterior_predictive={},
        notes=(*notes, *problem.notes),
        model=model_at_rate(model.point.filtered.model, problem),
        terms=answer.terms,
    )
