"""How an answer depends on what was assumed: each prior halved and doubled, for all sets alike.

A set's score is its largest likelihood times densities that were assumed.  Where one of these
changes, the largest moves by next to nothing to first order, so the score is taken anew at the same
sizes and noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Assumed, OnPriors
from ahrsd.diagnosis.one_model import noise_model, priors
from ahrsd.diagnosis.one_model.component import Fixed, Law, Sized
from ahrsd.diagnosis.one_model.effect_components import LAG, LAG_FORM
from ahrsd.diagnosis.one_model.evidence import evaluated
from ahrsd.diagnosis.one_model.gaussian_process import CourseLaw
from ahrsd.diagnosis.one_model.model_search import Hypotheses, Hypothesis

NAME, COURSE = "how often a name is there", "how often an unknown course is there"
ORDINARY, NOISE = "what recordings ordinarily leave", "steps of the noise from octave to octave"


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
        evaluated(products, each, known.at.log_noise, known.at.psi).nats for each in (laws, other)
    )
    return after - before


def _larger(law: Law, factor: float) -> Law:
    """A law whose sizes are so many times as large."""
    if isinstance(law, Fixed):
        return Fixed(law.variance * factor**2)
    if isinstance(law, Sized | CourseLaw) and law.spread > 0.0:
        return replace(law, mean=law.mean + float(np.log(factor)))
    return law
