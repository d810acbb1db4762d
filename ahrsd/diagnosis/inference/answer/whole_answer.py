"""An answer with all that is said beside its names, in the contract's form.

held-out gains and moved copies, priors halved and doubled, checks of the residual, sizes of what is
left, the smallest effects that would have shown, the repaired model with its noise, pictures
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import (
    Check,
    Diagnosis,
    Finding,
    RegimeMap,
)
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, baseline_of
from ahrsd.diagnosis.data_quality.facts import Fact, as_finding, rounding
from ahrsd.diagnosis.data_quality.preparation import PreparedRecording
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.answer import pictures, residual_checks, support, visibility
from ahrsd.diagnosis.inference.answer.held_out import HeldOut
from ahrsd.diagnosis.inference.answer.left_sizes import told_sizes, with_channels
from ahrsd.diagnosis.inference.answer.repaired_noise import loud_facts, repaired_noise
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.decision.members import nats_of_remainder
from ahrsd.diagnosis.inference.likelihood.logged_columns import recorded_setting
from ahrsd.diagnosis.inference.recorded_rate import Quick
from ahrsd.diagnosis.inference.search_rounds import Searched
from ahrsd.diagnosis.model import Term

#: what has a setting
Told = TypeVar("Told", Finding, Term)


def whole_answer(
    asked: PreparedRecording,
    start: NullFit,
    found: Searched,
    fast: Quick,
    library: Mapping[str, Effect],
    still: tuple[Finding, ...],
    *,
    spec_given: bool,
    simulated: bool,
) -> Diagnosis:
    """Everything that was found.

    start: the calibration alone;  spec_given: whether somebody said how loud the sensor is
    still: what a gyro that stands tells of its bias
    simulated: known to be no real recording
    """
    answer, all_sets = found.answer, found.all_sets
    held, quickly = HeldOut(all_sets, answer.best), HeldOut(fast.all_sets, fast.answer.best)
    slow = support.supported(answer, held, 0)
    told = (*slow, *support.supported(fast.answer, quickly, len(slow)))
    courses = pictures.courses(all_sets, answer.best)
    contributions = [
        *pictures.contributions(all_sets, answer),
        *pictures.contributions(fast.all_sets, fast.answer),
    ]
    left = support.left_at_both_rates(found, fast.answer, (held, quickly), contributions)
    left = with_channels(left, found, courses)
    remainder_nats = nats_of_remainder(all_sets, answer.best)
    left = told_sizes(all_sets, answer, left, remainder_nats, simulated=simulated)
    left = max(left, fast.hum, key=lambda one: (one.detected, one.evidence_nats))
    loud = loud_facts(found, fast, asked.facts, told, spec_given=spec_given)
    named = (*asked.findings(library), *told, *(as_finding(fact, library) for fact in loud), *still)
    something = bool(named) or left.detected
    residuals = residual_checks.residuals_of(held.rows(answer.best.names))
    maps = residual_checks.regime_maps(residuals)
    alone = visibility.seen_alone(all_sets, found.space, held.less(answer.keys))
    odds = answer.log_odds, fast.answer.log_odds, remainder_nats, left.evidence_nats, 0.0
    counted = len(named) > len(told)
    said = support.doubts(told) if something else support.nearest(answer, all_sets)
    return Diagnosis(
        recording="",
        baseline=baseline_of(start),
        mismatch=something,
        p_value=0.0 if counted else float(np.exp(-max(odds))),
        findings=_as_recorded(named, found),
        unexplained=left,
        posterior_predictive=_checked(residuals, maps, fast.answer, quickly),
        sensitivity=() if something else visibility.limits([*alone, *_seen_quickly(fast)]),
        notes=support.notes(asked, start, found, said, something=something),
        model=fast.left.filtered.model,
        noise=repaired_noise(found, fast, library, asked.facts, _spans(loud)),
        terms=(*_as_recorded((*answer.terms, *fast.answer.terms), found), *rounding(asked.facts)),
        drawn=pictures.drawn(start, found, residuals.whitened, contributions, courses, alone),
        omnibus=residual_checks.whiteness(start, residuals),
        validation=support.validation((answer, held), (fast.answer, quickly), told, left),
        regime_map=maps,
    )


def _as_recorded(told: Sequence[Told], found: Searched) -> tuple[Told, ...]:
    """What was told by columns as they are read, with settings by the columns as they came."""
    problem = found.all_sets.made.point.problem
    return tuple(replace(one, setting=recorded_setting(one.setting, problem)) for one in told)


def _checked(
    residuals: residual_checks.Residuals, maps: Sequence[RegimeMap], quick: Answer, held: HeldOut
) -> dict[str, Check]:
    """Of the residual, where only the recorded rate shows it at that: what was found and left."""
    checked = residual_checks.checks(residuals, maps)
    if not quick.keys:
        return checked
    fast = residual_checks.residuals_of(held.rows(quick.best.names))
    return residual_checks.at_recorded_rate(checked, fast)


def _seen_quickly(fast: Quick) -> list[visibility.Seen]:
    return visibility.seen_alone(fast.all_sets, fast.space, fast.answer.best.names)


def _spans(facts: Sequence[Fact]) -> list[tuple[float, float]]:
    return [span for fact in facts for span in fact.where.intervals_s]
