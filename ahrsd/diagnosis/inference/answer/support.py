"""What an answer is held against: other readings, the same columns at other times, other priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import (
    Assumed,
    Contribution,
    Finding,
    OnPriors,
    Unexplained,
    Validation,
)
from ahrsd.diagnosis.calibration_fit.gyro_at_rest import HARDLY_TURNED, field_hardly_turns
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.data_quality.preparation import PreparedRecording, detectable_faults
from ahrsd.diagnosis.inference.answer.held_out import HeldOut
from ahrsd.diagnosis.inference.components.component import FixedLaw, Law, ScaledLaw
from ahrsd.diagnosis.inference.components.effect_components import LAG, LAG_FORM
from ahrsd.diagnosis.inference.components.gaussian_process import GaussianProcessLaw
from ahrsd.diagnosis.inference.decision.acceptance import required_odds
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.decision.unexplained import directed_noise_source
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.diagnosis.inference.likelihood.evidence import evaluate
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.inference.search_rounds import Searched

#: where what is unknown may be more sources than are asked together
TOO_MANY = (
    f"models of more than {priors.WIDEST} coefficients were not asked: what is unknown may be "
    "several sources, of which a shorter part of the recording tells more"
)


def supported(answer: Answer, held: HeldOut, first: int) -> tuple[Finding, ...]:
    """An answer's findings with their held-out gains and what they owe to priors.

    first: number of the first one's term among all terms
    """
    all_sets, best = held.all_sets, answer.best
    return tuple(
        replace(
            one,
            heldout=held.told((key,)),
            priors=on_priors(
                all_sets, best, answer.rivals[key], required_odds(all_sets, best, key)
            ),
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
    asked = required_odds(all_sets, best, keys[0])
    return replace(left, priors=on_priors(all_sets, best, answer.rivals[keys[0]], asked))


def left_at_both_rates(
    found: Searched, quick: Answer, held: tuple[HeldOut, HeldOut], named: Sequence[Contribution]
) -> Unexplained:
    """What no name explains: in time, along one direction, or at the recorded rate."""
    left = what_is_left(found.answer, held[0])
    if not left.detected:
        added = [one.added for one in named if one.unit == "gauss"]
        left = directed_noise_source(found.all_sets, found.answer.best, found.source, added)
    return left if left.detected else what_is_left(quick, held[1])


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
                f"{one.effect}: it predicts readings that it was not fitted to no better than its "
                "time-shifted copies do: doubt it"
            )
        elif one.priors is not None and not one.priors.stays:
            least = min(one.priors.assumed, key=lambda each: min(each.half_nats, each.double_nats))
            nats, how = min((least.half_nats, "halved"), (least.double_nats, "doubled"))
            out.append(
                f"{one.effect} depends on a prior: with {least.what} {how} its evidence is "
                f"{nats:.0f} nats, {one.priors.asked:.0f} are required"
            )
    return tuple(out)


def nearest(answer: Answer, all_sets: Hypotheses) -> tuple[str, ...]:
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
    asked = required_odds(all_sets, more[key], key)
    found = on_priors(all_sets, more[key], rival, asked)
    most = max(nats for one in found.assumed for nats in (one.half_nats, one.double_nats))
    name = all_sets.component(key).effect
    other = "no effect" if rival is best else "an unknown cause"
    return (
        f"nearest to being found is {name}: {found.log_odds:+.1f} nats over {other} where "
        f"{asked:.0f} are required; at most {most:+.1f} with each prior halved or doubled",
    )


NAME, COURSE = "the prior odds of an effect", "the prior odds of an unknown cause"
ORDINARY, NOISE = "the ordinary residual sizes", "the noise steps between octaves"


def on_priors(all_sets: Hypotheses, best: Hypothesis, rival: Hypothesis, asked: float) -> OnPriors:
    """The odds of a set to its rival, with each prior as it is, halved and doubled."""
    log_odds = float(best.score - rival.score)
    half, double = (_apart(all_sets, best, rival, factor) for factor in (0.5, 2.0))
    assumed = tuple(
        Assumed(what, log_odds + half[what], log_odds + double[what])
        for what in half
        if half[what] or double[what]
    )
    least = min([log_odds, *(nats for one in assumed for nats in (one.half_nats, one.double_nats))])
    return OnPriors(log_odds, asked, bool(least >= asked), assumed)


def _apart(
    all_sets: Hypotheses, best: Hypothesis, rival: Hypothesis, factor: float
) -> Mapping[str, float]:
    mine, other = (changes(all_sets, one, factor) for one in (best, rival))
    return {what: mine[what] - other[what] for what in mine}


def changes(all_sets: Hypotheses, known: Hypothesis, factor: float) -> Mapping[str, float]:
    """By what a set's score changes where each prior is so many times what it is, nats."""
    log, at = float(np.log(factor)), known.at
    members = [
        all_sets.component(key) for key in sorted(known.names) if key not in all_sets.remainder
    ]
    named = sum(one.row is not None for one in members)
    real = all_sets.is_real(known.names)
    step = priors.NOISE_STEP_REAL if real else priors.NOISE_STEP_CLEAN
    alone = all_sets.made.alone
    assumed, wider = (
        noise_model.log_prior(at.log_noise, deviation, alone)[0]
        for deviation in (step, factor * step)
    )
    return {
        NAME: named * log,
        COURSE: (len(members) - named) * log,
        ORDINARY: _resized(all_sets, known, factor, step),
        NOISE: wider - assumed,
    }


def _resized(all_sets: Hypotheses, known: Hypothesis, factor: float, step: float) -> float:
    """The change where all ordinary sizes are so many times what they are."""
    ordinary = {*all_sets.remainder, LAG, LAG_FORM}
    if not ordinary & set(known.keys):
        return 0.0
    products = all_sets.made.products(known.keys, step)
    laws = [all_sets.component(key).law for key in known.keys]
    other = [
        _larger(law, factor) if key in ordinary else law
        for key, law in zip(known.keys, laws, strict=True)
    ]
    before, after = (
        evaluate(products, each, known.at.log_noise, known.at.psi).nats for each in (laws, other)
    )
    return after - before


def _larger(law: Law, factor: float) -> Law:
    """A law whose sizes are so many times as large."""
    if isinstance(law, FixedLaw):
        return FixedLaw(law.variance * factor**2)
    if isinstance(law, ScaledLaw | GaussianProcessLaw) and law.spread > 0.0:
        return replace(law, mean=law.mean + float(np.log(factor)))
    return law


def notes(
    asked: PreparedRecording,
    start: NullFit,
    found: Searched,
    said: tuple[str, ...],
    *,
    something: bool,
) -> tuple[str, ...]:
    """How the recording was read and what was left out of it, then what was said of the answer."""
    problem = found.all_sets.made.point.problem
    seen = () if something else detectable_faults(problem.recorded)
    how = (*asked.notes, *problem.notes, *((HARDLY_TURNED,) if field_hardly_turns(start) else ()))
    if problem.unread_s:
        when = ", ".join(f"{begin:.1f}-{end:.1f}" for begin, end in problem.unread_s)
        how = (*how, f"readings at {when} s were left out: something was being moved there")
    if found.all_sets.too_wide and found.answer.unknown:
        how = (*how, TOO_MANY)
    return (*how, *said, *asked.minor_notes, *seen)
