"""Lost turns beside everything that was named, and which of two searches is believed.

A field that jumps looks like lost turns now and then, and hides those that are.  So they are looked
for once more in the recording as it came, beside the names; and where the two answers differ, the
likelier of the two models is it: turns that were taken for a jump leave the jump's noise.  Every
turn has its price, which row it is and how many steps: many that are free explain anything.

A step that is named just where a turn was put right may be no more than that turn's answer, where
it was none: beside it the same turn would be found again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ahrsd.diagnosis.calibration_fit.delay import without_lag
from ahrsd.diagnosis.calibration_fit.descent import FittedTerm
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.data_quality.missing import LONG, UNSEEN, missing_turns, price
from ahrsd.diagnosis.rules.search import STEPS, State, at_model, refitted
from ahrsd.diagnosis.rules.unknown import Remainder, detected

#: a step so near to a turn that was put right may be its answer
NEAR_S = 2.0


def lost_beside(whole: Problem, state: State, lost: Sequence[Fact]) -> list[Fact]:
    """Lost turns of the recording as it came, `whole`, beside the terms of a state.

    lost: those that were put right before the terms were found
    """
    fit, terms = state.fit, _without_answers(state, lost)
    if state.problem.recorded is not whole.recorded or len(terms) < len(fit.terms):
        track = without_lag(whole.recorded, state.problem.lag_s)
        fit = at_model(track, fit.model, terms)
    rate = fit.filtered.track.gyro_b_rad_s - fit.model.gyro_bias_rad_s
    return missing_turns(fit.filtered, rate)


def _without_answers(state: State, lost: Sequence[Fact]) -> tuple[FittedTerm, ...]:
    """The terms without steps that begin where a turn was put right."""
    begin_s = [end for fact in lost if fact.turned is not None for _, end in fact.where.intervals_s]
    onsets_s = [
        judged.candidate.setting.get("onset_s") if judged.candidate.name in STEPS.values() else None
        for judged in state.named
    ]
    return tuple(
        term
        for term, onset_s in zip(state.fit.terms, onsets_s, strict=True)
        if onset_s is None or all(abs(onset_s - at) > NEAR_S for at in begin_s)
    )


def believed(
    lost: Sequence[Fact], put_right: State, beside: Sequence[Fact], otherwise: State
) -> bool:
    """Whether lost turns that were seen at first stay, though others are seen beside the names.

    put_right: the model of the recording with them put right;  otherwise: with those `beside`
    By what is put right alone: that more may have been lost is noise, which explains anything.
    """
    if not lost:
        return False
    return _as_seen(put_right) - price(lost) > _as_seen(otherwise) - price(beside)


def _as_seen(state: State) -> float:
    """Log likelihood of a model fitted as if no more turns were lost than those put right."""
    track = state.problem.track
    if track.lost_turns is None:
        return state.fit.log_likelihood
    problem = replace(state.problem, track=replace(track, lost_turns=None))
    return refitted(replace(state, problem=problem), state.named).fit.log_likelihood


def beyond_lost(left: Remainder, facts: Sequence[Fact], problem: Problem) -> bool:
    """Whether something is left that is more than the turns lost where no jump shows them.

    Those are an error of the gyro: of slow turns only their number is known, and not when.  Where
    a second was lost, or most of them stand out nowhere, how far the sensor turned meanwhile is not
    known either: the field jumps, and what the filter makes of that is in every frame.
    """
    lost = [fact for fact in facts if fact.turned is not None]
    unseen = bool(lost) and left.strongest.frame == "gyro"
    unseen |= any(key in fact.setting for fact in lost for key in (LONG, UNSEEN))
    return detected(left, problem.limits) and not unseen
