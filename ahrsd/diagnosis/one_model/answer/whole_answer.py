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
    Suspect,
    Unexplained,
)
from ahrsd.diagnosis.calibration_fit.gyro_at_rest import HARDLY_TURNED, at_rest
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, baseline
from ahrsd.diagnosis.data_quality.facts import Fact, around, lost_at, of_fact, rounding
from ahrsd.diagnosis.data_quality.preparation import Prepared, would_have_shown
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.innovation_filter.noise import level_facts
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.one_model import priors
from ahrsd.diagnosis.one_model.answer import pictures, residual_checks, support, visibility
from ahrsd.diagnosis.one_model.answer.held_out import HeldOut
from ahrsd.diagnosis.one_model.answer.left_sizes import told_sizes
from ahrsd.diagnosis.one_model.answer.repaired_noise import repaired_noise
from ahrsd.diagnosis.one_model.decision import Answer
from ahrsd.diagnosis.one_model.logged_columns import as_recorded
from ahrsd.diagnosis.one_model.members import nats_of_remainder
from ahrsd.diagnosis.one_model.recorded_rate import Quick
from ahrsd.diagnosis.one_model.search_rounds import Searched
from ahrsd.diagnosis.where_and_when import locate

#: what has a setting
Told = TypeVar("Told", Finding, Term)
#: where what is unknown may be more sources than are asked together
TOO_MANY = (
    f"models of more than {priors.WIDEST} coefficients were not asked: what is unknown may be "
    "several sources, of which a shorter part of the recording tells more"
)


def whole_answer(
    asked: Prepared,
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
    left = support.what_is_left(answer, held)
    if not left.detected:
        left = support.what_is_left(fast.answer, quickly)
    left = _with_channels(left, found, courses)
    remainder_nats = nats_of_remainder(all_sets, answer.best)
    left = told_sizes(all_sets, answer, left, remainder_nats, simulated=simulated)
    left = max(left, fast.hum, key=lambda one: (one.detected, one.evidence_nats))
    loud = _loud(found, fast, asked.facts, told, spec_given=spec_given)
    named = (*asked.told(library), *told, *(of_fact(fact, library) for fact in loud), *still)
    something = bool(named) or left.detected
    residuals = residual_checks.residuals_of(held.rows(answer.best.names))
    maps = residual_checks.regime_maps(residuals)
    alone = visibility.seen_alone(all_sets, found.space, held.less(answer.keys))
    contributions = [
        *pictures.contributions(all_sets, answer),
        *pictures.contributions(fast.all_sets, fast.answer),
    ]
    odds = answer.log_odds, fast.answer.log_odds, remainder_nats, fast.hum.evidence_nats, 0.0
    counted = len(named) > len(told)
    said = support.doubts(told) if something else support.nearest(answer, all_sets)
    return Diagnosis(
        recording="",
        baseline=baseline(start),
        mismatch=something,
        p_value=0.0 if counted else float(np.exp(-max(odds))),
        findings=_as_recorded(named, found),
        unexplained=left,
        posterior_predictive=_checked(residuals, maps, fast.answer, quickly),
        sensitivity=() if something else visibility.limits([*alone, *_seen_quickly(fast)]),
        notes=_notes(asked, found, said, still=at_rest(start), something=something),
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
    return tuple(replace(one, setting=as_recorded(one.setting, problem)) for one in told)


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


def _loud(
    found: Searched, fast: Quick, facts: Sequence[Fact], told: Sequence[Finding], *,
    spec_given: bool,
) -> list[Fact]:  # fmt: skip
    """What is to be said of the noise's level.

    Beside a real remainder it comes and goes, coarse numbers scatter by themselves, and where turns
    were lost or something passed what that leaves is no noise.
    """
    if found.all_sets.is_real(found.answer.best.names) or rounding(facts):
        return []
    short = [
        span for one in told if one.where.frame == "world" for span in one.where.intervals_s
        if span[1] - span[0] < priors.PASSING_S
    ]  # fmt: skip
    moments = [*lost_at(facts), *short]
    levels = level_facts(fast.left.filtered, spec_given=spec_given)
    return [fact for fact in levels if not around(fact, moments)]


def _spans(facts: Sequence[Fact]) -> list[tuple[float, float]]:
    return [span for fact in facts for span in fact.where.intervals_s]


def _notes(
    asked: Prepared, found: Searched, said: tuple[str, ...], *, still: bool, something: bool
) -> tuple[str, ...]:
    problem = found.all_sets.made.point.problem
    seen = () if something else would_have_shown(problem.recorded)
    how = (*asked.notes, *problem.notes, *((HARDLY_TURNED,) if still else ()))
    if problem.unread_s:
        when = ", ".join(f"{begin:.1f}-{end:.1f}" for begin, end in problem.unread_s)
        how = (*how, f"readings at {when} s were left out: something was moved there")
    if found.all_sets.too_wide and found.answer.unknown:
        how = (*how, TOO_MANY)
    return (*how, *said, *asked.lesser, *seen)


def _with_channels(
    left: Unexplained, found: Searched, courses: Sequence[locate.Located]
) -> Unexplained:
    """What is left, with the logged columns that move with it."""
    if left.where is None or not left.course:
        return left
    frame, track = left.where.frame, found.all_sets.made.context.track
    like = [one for course in courses if course.frame == frame
            for one in locate.matches(track, course)]  # fmt: skip
    follows = tuple(
        Suspect(one.channel, one.correlation, one.p_value)
        for one in like
        if one.p_value < priors.CHANCE and abs(one.correlation) > priors.ALIKE
    )
    return replace(left, follows=follows)
