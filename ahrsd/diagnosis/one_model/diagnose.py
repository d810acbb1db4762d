"""One diagnosis by one generative model.

hygiene -> null fit -> richest model, linearised -> search over sets -> linearised there -> ...
        -> names, and what is left beyond the ordinary -> quick effects at the recorded rate
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import roles
from ahrsd.diagnosis.descent import NullFit
from ahrsd.diagnosis.diagnosis import Diagnosis
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.facts import matters, of_fact, stopped
from ahrsd.diagnosis.hygiene import hygiene, put_right
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.missing import lost_turns
from ahrsd.diagnosis.noise import level_facts
from ahrsd.diagnosis.null import baseline, fit_null, unusable
from ahrsd.diagnosis.one_model.decision import Answer
from ahrsd.diagnosis.one_model.model_search import Hypotheses
from ahrsd.diagnosis.one_model.recorded_rate import Quick, quick
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
    spec = spec or Spec()
    problem, start = begun(put_right(track, facts), spec, library)
    if lost := lost_turns(problem.recorded, problem.cold):
        facts = (*facts, *lost)
        said += [of_fact(fact, library) for fact in lost if matters(fact)]
        problem, start = begun(put_right(track, facts), spec, library)
    answer, all_sets = answered(problem, start, library)
    fast = _quick(answer, all_sets, library)
    if fast.slower is not None:
        again = fit_null(fast.slower.track, problem.spec, start.model, walk=False)
        answer, all_sets = answered(fast.slower, again, library)
        fast = replace(fast, filtered=_quick(answer, all_sets, library).filtered)
    if not all_sets.is_real(answer.best.names):  # the ordinary remainder's level comes and goes
        loud = level_facts(fast.filtered, spec_given=spec.sigma_mag_gauss is not None)
        said += [of_fact(fact, library) for fact in loud]
    named = (*answer.findings, *fast.answer.findings)
    something = bool(said or named or answer.unexplained.detected)
    surest = max(answer.log_odds, fast.answer.log_odds, 0.0)
    return Diagnosis(
        recording=recording,
        baseline=baseline(start),
        mismatch=something,
        p_value=float(np.exp(-surest)) if not said else 0.0,
        findings=(*said, *named),
        unexplained=answer.unexplained,
        posterior_predictive={},
        notes=(*notes, *problem.notes),
        model=model_at_rate(all_sets.made.point.filtered.model, problem),
        terms=(*answer.terms, *fast.answer.terms),
    )


def _quick(answer: Answer, all_sets: Hypotheses, library: Mapping[str, Effect]) -> Quick:
    real = all_sets.is_real(answer.best.names)
    return quick(all_sets.made, answer.best, library, real=real)
