"""What an answer is held against: other readings, the same columns at other times, other priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ahrsd.diagnosis.answer.diagnosis import Finding, Unexplained, Validation
from ahrsd.diagnosis.one_model.acceptance import asked_odds
from ahrsd.diagnosis.one_model.answer.held_out import HeldOut
from ahrsd.diagnosis.one_model.answer.prior_dependence import on_priors
from ahrsd.diagnosis.one_model.decision import Answer
from ahrsd.diagnosis.one_model.model_search import Hypotheses


def supported(answer: Answer, held: HeldOut, first: int) -> tuple[Finding, ...]:
    """An answer's findings with their held-out gains and what they owe to priors.

    first: number of the first one's term among all terms
    """
    all_sets, best = held.all_sets, answer.best
    return tuple(
        replace(
            one,
            heldout=held.told((key,)),
            priors=on_priors(all_sets, best, answer.rivals[key], asked_odds(all_sets, best, key)),
            term=number,
        )
        for number, (key, one) in enumerate(
            zip(answer.keys, answer.findings, strict=True), start=first
        )
    )


def what_is_left(answer: Answer, held: HeldOut) -> Unexplained:
    """What no name explains, with the same."""
    left, keys = answer.unexplained, answer.unknown
    if not keys:
        return left
    left = replace(left, heldout=held.told(keys))
    if keys[0] not in answer.rivals:
        return left
    all_sets, best = held.all_sets, answer.best
    asked = asked_odds(all_sets, best, keys[0])
    return replace(left, priors=on_priors(all_sets, best, answer.rivals[keys[0]], asked))


def validation(
    slow: tuple[Answer, HeldOut], fast: tuple[Answer, HeldOut], told: Sequence[Finding],
    left: Unexplained,
) -> Validation:  # fmt: skip
    """What all names together gain on readings that they were not fitted to."""
    named = sum(held.gain(held.less(answer.keys)) for answer, held in (slow, fast) if answer.keys)
    copies = [one.heldout.placebo_gain for one in told if one.heldout is not None]
    free = 0.0 if left.heldout is None else left.heldout.nll_gain_per_sample
    return Validation(named, free, max([0.0, *copies]))


def doubts(told: Sequence[Finding]) -> tuple[str, ...]:
    """A sentence on each name that foretells other readings no better than copies of it."""
    out = []
    for one in told:
        held = one.heldout
        if held is not None and held.nll_gain_per_sample <= max(held.placebo_gain, 0.0):
            out.append(
                f"{one.effect}: other readings than it was fitted to are foretold no better by it "
                "than by its own copies at other times: doubt it"
            )
        elif one.priors is not None and not one.priors.stays:
            least = min(one.priors.assumed, key=lambda each: min(each.half_nats, each.double_nats))
            nats, how = min((least.half_nats, "half"), (least.double_nats, "twice"))
            out.append(
                f"{one.effect} owes its name to what is assumed: with {how} of {least.what} it has "
                f"{nats:.0f} nats of odds, {one.priors.asked:.0f} are asked"
            )
    return tuple(out)


def nearest(answer: Answer, all_sets: Hypotheses) -> tuple[str, ...]:
    """A sentence on the likeliest name that is not told: how far from one it is."""
    best = answer.best
    more = {
        key: one
        for names, one in all_sets.judged.items()
        if best.names < names and len(names - best.names) == 1
        for key in names - best.names
        if all_sets.component(key).row is not None
    }
    if not more:
        return ()
    key = max(more, key=lambda one: more[one].score)
    asked = asked_odds(all_sets, more[key], key)
    found = on_priors(all_sets, more[key], best, asked)
    most = max(nats for one in found.assumed for nats in (one.half_nats, one.double_nats))
    name = all_sets.component(key).effect
    return (
        f"nearest to a name is {name}: {found.log_odds:+.1f} nats of odds where {asked:.0f} are "
        f"asked, {most:+.1f} at most with half or twice of what was assumed",
    )
