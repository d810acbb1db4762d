"""The search at the working rate, and the search for quick effects at the recorded rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.decision.members import nats_of_remainder
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.recorded_rate import RecordedRateResult, search_recorded_rate
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult, search_until_stable


def search_both_rates(
    problem: Problem,
    richest: richest_model.FittedPoint,
    start: NullFit,
    library: Mapping[str, Effect],
) -> tuple[ModelSearchResult, RecordedRateResult]:
    """Both searches; if quick effects are found, they are removed and the first one is repeated.

    A source that is quicker than the working rate is aliased there and resembles what real
    recordings leave.  It is accepted as the source if it has higher odds than the evidence of the
    ordinary remainder, and if the recording without it needs no such remainder.
    """
    found = search_until_stable(richest, library)
    real = found.all_sets.is_real(found.answer.best.names)
    fast = _search_quick(found, library, real=real)
    if fast.reduced_problem is not None:
        return _search_without_quick(problem, fast, start, library)
    if real:
        without_remainder = _search_quick(found, library, real=False)
        remainder_nats = nats_of_remainder(found.all_sets, found.answer.best)
        if (
            without_remainder.reduced_problem is not None
            and without_remainder.answer.log_odds > remainder_nats
        ):
            again, again_fast = _search_without_quick(problem, without_remainder, start, library)
            if not again.all_sets.is_real(again.answer.best.names):
                return again, again_fast
    return found, fast


def _search_without_quick(
    problem: Problem, fast: RecordedRateResult, start: NullFit, library: Mapping[str, Effect]
) -> tuple[ModelSearchResult, RecordedRateResult]:
    """The search repeated without the quick effects that were found at the recorded rate."""
    if fast.reduced_problem is None:
        raise ValueError("nothing was found at the recorded rate")
    refit = fit_null(fast.reduced_problem.track, problem.spec, start.model, walk=False)
    found = search_until_stable(
        richest_model.fit_richest_model(fast.reduced_problem, refit.filtered, library), library
    )
    real = found.all_sets.is_real(found.answer.best.names)
    return found, replace(fast, point=_search_quick(found, library, real=real).point)


def _search_quick(
    found: ModelSearchResult, library: Mapping[str, Effect], *, real: bool
) -> RecordedRateResult:
    answer = found.answer
    switching = any(key in found.space.sources for key in answer.unknown)
    nats = answer.unexplained.evidence_nats if switching else found.all_sets.unknown_nats
    return search_recorded_rate(
        found.all_sets.made, answer.best, library, real=real, source_nats=nats
    )
