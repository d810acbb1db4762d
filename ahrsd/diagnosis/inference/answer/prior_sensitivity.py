"""The odds of an answer if each of the assumed priors were halved or doubled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Assumed, OnPriors
from ahrsd.diagnosis.inference.components.component import FixedLaw, Law, ScaledLaw
from ahrsd.diagnosis.inference.components.effect_components import LAG, LAG_FORM
from ahrsd.diagnosis.inference.components.gaussian_process import GaussianProcessLaw
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.diagnosis.inference.likelihood.evidence import evaluate
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis

EFFECT, COURSE = "the prior odds of an effect", "the prior odds of an unknown cause"
ORDINARY, NOISE = "the ordinary residual sizes", "the noise steps between octaves"


def prior_sensitivity(
    all_sets: Hypotheses, best: Hypothesis, rival: Hypothesis, required: float
) -> OnPriors:
    """The odds of a set to its rival, with each prior as it is, halved and doubled."""
    log_odds = float(best.score - rival.score)
    half, double = (_odds_changes(all_sets, best, rival, factor) for factor in (0.5, 2.0))
    assumed = tuple(
        Assumed(what, log_odds + half[what], log_odds + double[what])
        for what in half
        if half[what] or double[what]
    )
    least = min([log_odds, *(nats for one in assumed for nats in (one.half_nats, one.double_nats))])
    return OnPriors(log_odds, required, bool(least >= required), assumed)


def _odds_changes(
    all_sets: Hypotheses, best: Hypothesis, rival: Hypothesis, factor: float
) -> Mapping[str, float]:
    mine, other = (score_changes(all_sets, one, factor) for one in (best, rival))
    return {what: mine[what] - other[what] for what in mine}


def score_changes(
    all_sets: Hypotheses, hypothesis: Hypothesis, factor: float
) -> Mapping[str, float]:
    """Changes of a set's score, nats, if each prior in turn is multiplied by a factor."""
    log, at = float(np.log(factor)), hypothesis.at
    members = [
        all_sets.component(key) for key in sorted(hypothesis.names) if key not in all_sets.remainder
    ]
    effects = sum(one.row is not None for one in members)
    real = all_sets.is_real(hypothesis.names)
    step = priors.NOISE_STEP_REAL if real else priors.NOISE_STEP_CLEAN
    alone = all_sets.made.alone
    as_assumed, wider = (
        noise_model.log_prior(at.log_noise, deviation, alone)[0]
        for deviation in (step, factor * step)
    )
    return {
        EFFECT: effects * log,
        COURSE: (len(members) - effects) * log,
        ORDINARY: _size_prior_change(all_sets, hypothesis, factor, step),
        NOISE: wider - as_assumed,
    }


def _size_prior_change(
    all_sets: Hypotheses, hypothesis: Hypothesis, factor: float, step: float
) -> float:
    """The change if all ordinary sizes are multiplied by the factor.

    0 where it cannot be evaluated, because rounding exceeds the residual there.
    """
    ordinary = {*all_sets.remainder, LAG, LAG_FORM}
    if not ordinary & set(hypothesis.keys):
        return 0.0
    products = all_sets.made.products(hypothesis.keys, step)
    laws = [all_sets.component(key).law for key in hypothesis.keys]
    scaled = [
        _scale_law(law, factor) if key in ordinary else law
        for key, law in zip(hypothesis.keys, laws, strict=True)
    ]
    before, after = (
        evaluate(products, each, hypothesis.at.log_noise, hypothesis.at.psi).nats
        for each in (laws, scaled)
    )
    return after - before if np.isfinite(after) else 0.0


def _scale_law(law: Law, factor: float) -> Law:
    """A law with its sizes multiplied by a factor."""
    if isinstance(law, FixedLaw):
        return FixedLaw(law.variance * factor**2)
    if isinstance(law, ScaledLaw | GaussianProcessLaw) and law.spread > 0.0:
        return replace(law, mean=law.mean + float(np.log(factor)))
    return law
