"""Checks of an answer: held-out readings, copies of the columns shifted in time, other priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import (
    Contribution,
    Finding,
    Unexplained,
    Validation,
)
from ahrsd.diagnosis.calibration_fit.gyro_at_rest import HARDLY_TURNED, field_hardly_turns
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.data_quality.preparation import PreparedRecording, detectable_faults
from ahrsd.diagnosis.inference.answer.held_out import HeldOut
from ahrsd.diagnosis.inference.answer.prior_sensitivity import prior_sensitivity
from ahrsd.diagnosis.inference.decision.acceptance import required_odds
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.decision.unexplained import directed_noise_source
from ahrsd.diagnosis.inference.search.model_search import Hypotheses
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult

#: note for an unknown part that may be more sources than are tested together
TOO_MANY = (
    f"models of more than {priors.WIDEST} coefficients were not tested: the unknown cause may be "
    "several sources; a shorter part of the recording shows more"
)


def validate_findings(answer: Answer, held: HeldOut, first: int) -> tuple[Finding, ...]:
    """An answer's findings with their held-out gains and their sensitivity to the priors.

    first: number of the first one's term among all terms
    """
    all_sets, best = held.all_sets, answer.best
    return tuple(
        replace(
            one,
            heldout=held.held_out_gain((key,)),
            priors=prior_sensitivity(
                all_sets, best, answer.rivals[key], required_odds(all_sets, best, key)
            ),
            term=number,
        )
        for number, (key, one) in enumerate(
            zip(answer.keys, answer.findings, strict=True), start=first
        )
    )


def validate_unexplained(answer: Answer, held: HeldOut) -> Unexplained:
    """What no effect explains, with the same."""
    unexplained, keys = answer.unexplained, answer.unknown
    if not keys:
        return unexplained
    unexplained = replace(unexplained, heldout=held.held_out_gain(keys))
    if keys[0] not in answer.rivals:
        return unexplained
    all_sets, best = held.all_sets, answer.best
    required = required_odds(all_sets, best, keys[0])
    return replace(
        unexplained, priors=prior_sensitivity(all_sets, best, answer.rivals[keys[0]], required)
    )


def unexplained_part(
    found: ModelSearchResult,
    fast: Answer,
    held: tuple[HeldOut, HeldOut],
    contributions: Sequence[Contribution],
) -> Unexplained:
    """What no effect explains: in time, along one direction, or at the recorded rate."""
    unexplained = validate_unexplained(found.answer, held[0])
    if not unexplained.detected:
        added = [one.added for one in contributions if one.unit == "gauss"]
        unexplained = directed_noise_source(found.all_sets, found.answer.best, found.source, added)
    return unexplained if unexplained.detected else validate_unexplained(fast, held[1])


def validation(
    slow: tuple[Answer, HeldOut], fast: tuple[Answer, HeldOut], findings: Sequence[Finding],
    unexplained: Unexplained,
) -> Validation:  # fmt: skip
    """The gain of all effects together on readings that they were not fitted to."""
    gain = sum(held.gain(held.without(answer.keys)) for answer, held in (slow, fast) if answer.keys)
    copies = [one.heldout.placebo_gain for one in findings if one.heldout is not None]
    free = 0.0 if unexplained.heldout is None else unexplained.heldout.nll_gain_per_sample
    return Validation(gain, free, max([0.0, *copies]))


def doubts(findings: Sequence[Finding]) -> tuple[str, ...]:
    """A note on each finding that predicts no better than its copies, or depends on a prior."""
    out = []
    for one in findings:
        held = one.heldout
        if held is not None and held.nll_gain_per_sample <= max(held.placebo_gain, 0.0):
            out.append(
                f"doubt {one.effect}: on readings that it was not fitted to it predicts no better "
                "than its time-shifted copies"
            )
        elif one.priors is not None and not one.priors.stays:
            weakest = min(
                one.priors.assumed, key=lambda each: min(each.half_nats, each.double_nats)
            )
            nats, how = min((weakest.half_nats, "halved"), (weakest.double_nats, "doubled"))
            out.append(
                f"{one.effect} depends on a prior: with {weakest.what} {how} its evidence is "
                f"{nats:.0f} nats, and {one.priors.asked:.0f} are required"
            )
    return tuple(out)


def nearest_effect(answer: Answer, all_sets: Hypotheses) -> tuple[str, ...]:
    """A sentence on the most probable effect that is not reported: how far from a finding it is.

    As the decision does, it is compared with the best set without it: with nothing more, or with a
    free process in its place.
    """
    best = answer.best
    in_its_place = [
        one
        for names, one in all_sets.judged.items()
        if best.names < names
        and all(all_sets.component(key).effect is None for key in names - best.names)
    ]
    rival = max([best, *in_its_place], key=lambda one: one.score)
    extended = {
        key: one
        for names, one in all_sets.judged.items()
        if best.names < names and len(names - best.names) == 1
        for key in names - best.names
        if all_sets.component(key).row is not None
    }
    if not extended:
        return ()
    key = max(extended, key=lambda one: extended[one].score)
    required = required_odds(all_sets, extended[key], key)
    sensitivity = prior_sensitivity(all_sets, extended[key], rival, required)
    most = max(nats for one in sensitivity.assumed for nats in (one.half_nats, one.double_nats))
    name = all_sets.component(key).effect
    other = "no effect" if rival is best else "an unknown cause"
    return (
        f"the effect nearest to a finding is {name}: {sensitivity.log_odds:+.1f} nats over {other} "
        f"where {required:.0f} are required; at most {most:+.1f} with each prior halved or doubled",
    )


def notes(
    prepared: PreparedRecording,
    start: NullFit,
    found: ModelSearchResult,
    answer_notes: tuple[str, ...],
    *,
    differs: bool,
) -> tuple[str, ...]:
    """How the recording was read and what was left out of it, then the notes on the answer."""
    problem = found.all_sets.made.point.problem
    faults = () if differs else detectable_faults(problem.recorded)
    reading_notes = (
        *prepared.notes,
        *problem.notes,
        *((HARDLY_TURNED,) if field_hardly_turns(start) else ()),
    )
    if problem.unread_s:
        when = ", ".join(f"{begin:.1f}-{end:.1f}" for begin, end in problem.unread_s)
        reading_notes = (
            *reading_notes,
            f"readings at {when} s were left out: something was being moved there",
        )
    if found.all_sets.too_wide and found.answer.unknown:
        reading_notes = (*reading_notes, TOO_MANY)
    return (*reading_notes, *answer_notes, *prepared.minor_notes, *faults)
