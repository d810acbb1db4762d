"""One diagnosis by one generative model.

data quality -> null fit -> richest model, linearised -> search over sets -> linearised there -> ...
     -> findings, and the residual beyond the ordinary -> quick effects at the recorded rate
     -> checks of the answer: held-out readings, copies shifted in time, other priors
     -> with a gyro of a high noise level: comparison with simulations of the null model
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
from ahrsd.diagnosis.inference.answer.whole_answer import build_diagnosis
from ahrsd.diagnosis.inference.both_rates import search_both_rates
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.likelihood.column_clocks import find_wrong_clock
from ahrsd.diagnosis.inference.lost_turns import (
    corrected_log_evidence,
    find_lost_turns_given,
    split_at_large_turns,
)
from ahrsd.diagnosis.track import Spec, Track


def build_and_fit_null(track: Track, spec: Spec) -> tuple[Problem, NullFit]:
    """The problem of a corrected track at its working rate, and the null model fitted to it."""
    problem, cold = build_problem(split_at_large_turns(track), spec)
    return problem, fit_null(problem.track, problem.spec, cold, walk=False)


def diagnose_logged(
    track: Track, spec: Spec | None = None, *, recording: str = "", simulated: bool = False
) -> Diagnosis:
    """The same for columns that have missing values."""
    run = partial(diagnose, recording=recording, simulated=simulated)
    return diagnose_with_gaps(track, spec, run)


def diagnose(
    track: Track,
    spec: Spec | None = None,
    *,
    library: Mapping[str, Effect] = EFFECTS,
    recording: str = "",
    simulated: bool = False,
) -> Diagnosis:
    """Where the recording and the model differ, and which physical effects the model lacks.

    simulated: the recording is known to be simulated; then no residual counts as ordinary
    Deterministic.  ValueError, one line, where nothing can be fitted.
    """
    known_spec = spec or Spec()
    run = partial(
        _diagnose_once, spec=known_spec, library=library, simulated=simulated, clocks=True
    )
    return replace(diagnose_beyond_chance(track, run), recording=recording)


def _diagnose_once(
    track: Track, spec: Spec, library: Mapping[str, Effect], *, simulated: bool, clocks: bool
) -> FittedDiagnosis:
    """The diagnosis, without the comparison with simulations of the null model.

    clocks: whether to test for a column that was logged by another clock than the sensor's
    """
    prepared = prepare(track)
    if (stopped := prepared.stopped_diagnosis("", library)) is not None:
        return FittedDiagnosis(stopped)
    problem, start = build_and_fit_null(prepared.corrected_track(), spec)
    recorded, prepared_first = problem.recorded, prepared
    if lost_turns := find_lost_turns_at_start(recorded, problem.cold):
        prepared = prepared_first.with_facts(lost_turns)
        problem, start = build_and_fit_null(prepared.corrected_track(), spec)
    richest = richest_model.fit_richest_model(problem, start.filtered, library)
    if clocks and (clock := find_wrong_clock(richest)) is not None:
        realigned = _diagnose_once(
            clock.realigned_track(prepared.track), spec, library, simulated=simulated, clocks=False
        )
        at_sensor_time = realigned.found
        if any(one.setting.get("covariate") == clock.column for one in at_sensor_time.findings):
            note = f"{clock.words}: effects of it are judged at the sensor's time"
            return replace(
                realigned, found=replace(at_sensor_time, notes=(note, *at_sensor_time.notes))
            )
    drift = find_bias_drift_at_rest(start.context(), library) if field_hardly_turns(start) else ()
    testable = effects_testable_at_rest(library, drift) if field_hardly_turns(start) else library
    found, fast = search_both_rates(problem, richest, start, testable)
    lost_given_found = find_lost_turns_given(recorded, found, fast, lost_turns)
    if corrections_differ(lost_turns, lost_given_found):
        other = prepared_first.with_facts(lost_given_found)
        other_problem, other_start = build_and_fit_null(other.corrected_track(), spec)
        richest = richest_model.fit_richest_model(other_problem, other_start.filtered, library)
        other_found, other_fast = search_both_rates(other_problem, richest, other_start, testable)
        if corrected_log_evidence(other_found, lost_given_found) > corrected_log_evidence(
            found, lost_turns
        ):
            prepared, problem, start, found, fast = (
                other,
                other_problem,
                other_start,
                other_found,
                other_fast,
            )
    diagnosis = build_diagnosis(
        prepared,
        start,
        found,
        fast,
        library,
        drift,
        spec_given=spec.sigma_mag_gauss is not None,
        simulated=simulated,
    )
    return FittedDiagnosis(diagnosis, problem, start, prepared.rounding)
