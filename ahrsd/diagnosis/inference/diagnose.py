"""One diagnosis by one generative model.

prepared -> null fit -> richest model, linearised -> search over sets -> linearised there -> ...
         -> names, and what is left beyond the ordinary -> quick effects at the recorded rate
         -> what holds it against other readings, other times, other priors
         -> beside a loud gyro: whether that is beyond chance
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.answer.null_simulations import Answered, beyond_chance
from ahrsd.diagnosis.calibration_fit.gyro_at_rest import at_rest, resting, told_at_rest
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem, problem_of
from ahrsd.diagnosis.data_quality.dropped_samples import differ, lost_turns
from ahrsd.diagnosis.data_quality.preparation import prepared, with_holes
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.answer.whole_answer import whole_answer
from ahrsd.diagnosis.inference.decision.members import nats_of_remainder
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.likelihood.column_clocks import wrong_clock
from ahrsd.diagnosis.inference.lost_turns import broken_where_unsampled, lost_beside, nats
from ahrsd.diagnosis.inference.recorded_rate import Quick, quick
from ahrsd.diagnosis.inference.search_rounds import Searched, answered
from ahrsd.diagnosis.track import Spec, Track


def begun(track: Track, spec: Spec) -> tuple[Problem, NullFit]:
    """A track that hygiene has put right at its working rate, and the fit of a null to it."""
    problem, cold = problem_of(broken_where_unsampled(track), spec)
    return problem, fit_null(problem.track, problem.spec, cold, walk=False)


def diagnose_logged(
    track: Track, spec: Spec | None = None, *, recording: str = "", simulated: bool = False
) -> Diagnosis:
    """The same of columns with holes, as users have it."""
    ask = partial(diagnose, recording=recording, simulated=simulated)
    return with_holes(track, spec, ask)


def diagnose(
    track: Track,
    spec: Spec | None = None,
    *,
    library: Mapping[str, Effect] = EFFECTS,
    recording: str = "",
    simulated: bool = False,
) -> Diagnosis:
    """Where the recording and the model differ, and which physics was left out.

    simulated: known to be no real recording, of which nothing is ordinary
    Deterministic.  ValueError, one line, where nothing can be fitted.
    """
    known = spec or Spec()
    ask = partial(_answered, spec=known, library=library, simulated=simulated, clocks=True)
    return replace(beyond_chance(track, ask), recording=recording)


def _answered(
    track: Track, spec: Spec, library: Mapping[str, Effect], *, simulated: bool, clocks: bool
) -> Answered:
    """The answer, whatever is to be expected of it by chance.

    clocks: whether a column may run by another clock than the sensor
    """
    asked = prepared(track)
    if (nothing := asked.stopped("", library)) is not None:
        return Answered(nothing)
    problem, start = begun(asked.put_right(), spec)
    came, counted = problem.recorded, asked
    if lost := lost_turns(came, problem.cold):
        asked = counted.with_facts(lost)
        problem, start = begun(asked.put_right(), spec)
    richest = richest_model.richest(problem, start.filtered, library)
    if clocks and (clock := wrong_clock(richest)) is not None:
        at_its_time = _answered(
            clock.moved(asked.track), spec, library, simulated=simulated, clocks=False
        )
        moved = at_its_time.found
        if any(one.setting.get("covariate") == clock.column for one in moved.findings):
            said = f"{clock.words}: its cause is judged at the sensor's time"
            return replace(at_its_time, found=replace(moved, notes=(said, *moved.notes)))
    still = resting(start.context(), library) if at_rest(start) else ()
    searched = told_at_rest(library, still) if at_rest(start) else library
    found, fast = _found(problem, richest, start, searched)
    beside = lost_beside(came, found, fast, lost)
    if differ(lost, beside):
        other = counted.with_facts(beside)
        otherwise, begin = begun(other.put_right(), spec)
        richest = richest_model.richest(otherwise, begin.filtered, library)
        again, quickly = _found(otherwise, richest, begin, searched)
        if nats(again, beside) > nats(found, lost):
            asked, problem, start, found, fast = other, otherwise, begin, again, quickly
    told = whole_answer(
        asked,
        start,
        found,
        fast,
        library,
        still,
        spec_given=spec.sigma_mag_gauss is not None,
        simulated=simulated,
    )
    return Answered(told, problem, start)


def _found(
    problem: Problem, richest: richest_model.Judged, start: NullFit, library: Mapping[str, Effect]
) -> tuple[Searched, Quick]:
    """The search, and what only the recorded rate shows; with that taken out the search anew.

    A source that is quicker than the working rate is folded by it and looks like what real
    recordings leave.  Where it is surer than that, and without it nothing of the kind is left, it
    is the source.
    """
    found = answered(richest, library)
    real = found.all_sets.is_real(found.answer.best.names)
    fast = _quick(found, library, real=real)
    if fast.slower is not None:
        return _without_quick(problem, fast, start, library)
    if real:
        instead = _quick(found, library, real=False)
        left_nats = nats_of_remainder(found.all_sets, found.answer.best)
        if instead.slower is not None and instead.answer.log_odds > left_nats:
            again, quickly = _without_quick(problem, instead, start, library)
            if not again.all_sets.is_real(again.answer.best.names):
                return again, quickly
    return found, fast


def _without_quick(
    problem: Problem, fast: Quick, start: NullFit, library: Mapping[str, Effect]
) -> tuple[Searched, Quick]:
    """The search anew, without what the recorded rate shows."""
    if fast.slower is None:
        raise ValueError("nothing was found at the recorded rate")
    again = fit_null(fast.slower.track, problem.spec, start.model, walk=False)
    found = answered(richest_model.richest(fast.slower, again.filtered, library), library)
    real = found.all_sets.is_real(found.answer.best.names)
    return found, replace(fast, left=_quick(found, library, real=real).left)


def _quick(found: Searched, library: Mapping[str, Effect], *, real: bool) -> Quick:
    answer = found.answer
    switches = any(key in found.space.sources for key in answer.unknown)
    nats = answer.unexplained.evidence_nats if switches else 0.0
    return quick(found.all_sets.made, answer.best, library, real=real, source_nats=nats)
