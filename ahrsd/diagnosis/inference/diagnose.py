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
from ahrsd.diagnosis.answer.null_simulations import FittedDiagnosis, diagnose_beyond_chance
from ahrsd.diagnosis.calibration_fit.gyro_at_rest import (
    effects_testable_at_rest,
    field_hardly_turns,
    find_bias_drift_at_rest,
)
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem, build_problem
from ahrsd.diagnosis.data_quality.dropped_samples import (
    corrections_differ,
    find_lost_turns_at_start,
)
from ahrsd.diagnosis.data_quality.preparation import diagnose_with_gaps, prepare
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.answer.whole_answer import whole_answer
from ahrsd.diagnosis.inference.both_rates import found_at_both_rates
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.likelihood.column_clocks import find_wrong_clock
from ahrsd.diagnosis.inference.lost_turns import broken_where_unsampled, lost_beside, nats
from ahrsd.diagnosis.track import Spec, Track


def begun(track: Track, spec: Spec) -> tuple[Problem, NullFit]:
    """A track that hygiene has put right at its working rate, and the fit of a null to it."""
    problem, cold = build_problem(broken_where_unsampled(track), spec)
    return problem, fit_null(problem.track, problem.spec, cold, walk=False)


def diagnose_logged(
    track: Track, spec: Spec | None = None, *, recording: str = "", simulated: bool = False
) -> Diagnosis:
    """The same of columns with holes, as users have it."""
    ask = partial(diagnose, recording=recording, simulated=simulated)
    return diagnose_with_gaps(track, spec, ask)


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
    return replace(diagnose_beyond_chance(track, ask), recording=recording)


def _answered(
    track: Track, spec: Spec, library: Mapping[str, Effect], *, simulated: bool, clocks: bool
) -> FittedDiagnosis:
    """The answer, whatever is to be expected of it by chance.

    clocks: whether a column may run by another clock than the sensor
    """
    asked = prepare(track)
    if (nothing := asked.stopped_diagnosis("", library)) is not None:
        return FittedDiagnosis(nothing)
    problem, start = begun(asked.corrected_track(), spec)
    came, counted = problem.recorded, asked
    if lost := find_lost_turns_at_start(came, problem.cold):
        asked = counted.with_facts(lost)
        problem, start = begun(asked.corrected_track(), spec)
    richest = richest_model.fit_richest_model(problem, start.filtered, library)
    if clocks and (clock := find_wrong_clock(richest)) is not None:
        at_its_time = _answered(
            clock.realigned_track(asked.track), spec, library, simulated=simulated, clocks=False
        )
        moved = at_its_time.found
        if any(one.setting.get("covariate") == clock.column for one in moved.findings):
            said = f"{clock.words}: its cause is judged at the sensor's time"
            return replace(at_its_time, found=replace(moved, notes=(said, *moved.notes)))
    still = find_bias_drift_at_rest(start.context(), library) if field_hardly_turns(start) else ()
    searched = effects_testable_at_rest(library, still) if field_hardly_turns(start) else library
    found, fast = found_at_both_rates(problem, richest, start, searched)
    beside = lost_beside(came, found, fast, lost)
    if corrections_differ(lost, beside):
        other = counted.with_facts(beside)
        otherwise, begin = begun(other.corrected_track(), spec)
        richest = richest_model.fit_richest_model(otherwise, begin.filtered, library)
        again, quickly = found_at_both_rates(otherwise, richest, begin, searched)
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
    return FittedDiagnosis(told, problem, start)
