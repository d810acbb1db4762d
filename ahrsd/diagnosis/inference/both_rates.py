"""The search at the working rate, and beside it what only the recorded rate shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.decision.members import nats_of_remainder
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.recorded_rate import Quick, quick
from ahrsd.diagnosis.inference.search_rounds import Searched, answered


def found_at_both_rates(
    problem: Problem,
    richest: richest_model.FittedPoint,
    start: NullFit,
    library: Mapping[str, Effect],
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
    found = answered(richest_model.fit_richest_model(fast.slower, again.filtered, library), library)
    real = found.all_sets.is_real(found.answer.best.names)
    return found, replace(fast, left=_quick(found, library, real=real).left)


def _quick(found: Searched, library: Mapping[str, Effect], *, real: bool) -> Quick:
    answer = found.answer
    switches = any(key in found.space.sources for key in answer.unknown)
    nats = answer.unexplained.evidence_nats if switches else found.all_sets.unknown_nats
    return quick(found.all_sets.made, answer.best, library, real=real, source_nats=nats)
