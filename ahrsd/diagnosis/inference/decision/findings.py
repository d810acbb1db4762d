"""A member of a set as a finding: its probability, alternatives, values, place and cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Finding, Share, Value, Where
from ahrsd.diagnosis.answer.text import separating_manoeuvre
from ahrsd.diagnosis.effects.effect import Effect, Setting
from ahrsd.diagnosis.inference.components.effect_components import (
    LAG,
    ROUNDING_SHARE,
    contains_component,
)
from ahrsd.diagnosis.inference.components.ordinary_remainder import GYRO_MATRIX, TURNS
from ahrsd.diagnosis.inference.decision.members import (
    coefficients,
    contribution_of,
    cost_if_left_out,
)
from ahrsd.diagnosis.inference.decision.which_delay import delay_probabilities, delay_unit
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.search.model_search import (
    Hypotheses,
    Hypothesis,
    Space,
    step_alternatives,
)
from ahrsd.diagnosis.inference.search.near_settings import perturbed_settings, with_setting_slopes
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.where_and_when.address import locate_contribution
from ahrsd.samples import Array


def finding_and_term(
    all_sets: Hypotheses, space: Space, best: Hypothesis, key: str, odds: float,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """A member as a finding and as a term of the repaired model."""
    member = all_sets.component(key)
    value, deviation = coefficients(all_sets, best, key)
    deviation = np.maximum(deviation, _deviation_over_setting(all_sets, best, key, value))
    effect = library[member.effect or key]
    if key == LAG:
        probabilities = delay_probabilities(all_sets, best, value, deviation, library)
        effect = library[next(iter(probabilities))]
        unit = effect.delay / delay_unit(all_sets, effect)
        value, deviation = value * unit, deviation * abs(unit)
    else:
        probabilities = _effect_probabilities(all_sets, space, best, key)
    setting = {k: v for k, v in member.setting.items() if k != "searched"}
    if effect.filters:  # its one coefficient is the filter's time constant
        setting["time_constant_s"] = float(value[0])
    where = _locate(all_sets, best, key, effect.frame or effect.family)
    finding = _build_finding(effect, probabilities, where, value, deviation, setting, odds, library)
    finding = replace(finding, cost_if_left_out=cost_if_left_out(all_sets, best, key))
    return finding, Term(effect.identifier, value, deviation, setting)


def _deviation_over_setting(
    all_sets: Hypotheses, best: Hypothesis, key: str, value: Array
) -> Array:
    """(q,) deviations of a member's coefficients, marginal over its setting nearby.

    A member with a form component, such as a step that a hand makes, has no sharper setting.
    """
    member, made = all_sets.component(key), all_sets.made
    perturbed = {} if key in all_sets.forms else perturbed_settings(member, made.context)
    with_slopes = with_setting_slopes(member, made.context, value, perturbed)
    if with_slopes is None:
        return np.zeros(len(value))
    reduced = all_sets.judge(best.names - {key}, best)
    at = replace(reduced.at, log_noise=best.at.log_noise)
    return candidate_scan(made, reduced.keys, at).estimate(with_slopes)[1][: len(value)]


def _build_finding(
    effect: Effect, probabilities: Mapping[str, float], where: Where, value: Array,
    deviation: Array, setting: Setting, odds: float, library: Mapping[str, Effect],
) -> Finding:  # fmt: skip
    """A finding with its alternatives, and the manoeuvre that would separate them."""
    probability = float(1.0 / (1.0 + np.exp(-min(odds, priors.SUREST_ODDS))))
    alternatives = tuple(
        Share(other, conditional * probability) for other, conditional in probabilities.items()
        if other != effect.identifier and conditional > priors.SMALLEST_SHARE
    )  # fmt: skip
    others = [one.effect for one in alternatives]
    values = zip(effect.parameters, value, deviation, strict=True)
    return Finding(
        effect=effect.identifier,
        confidence=probabilities.get(effect.identifier, 1.0) * probability,
        alternatives=alternatives,
        where=where,
        parameters=tuple(Value(p.name, float(v), float(d), p.unit) for p, v, d in values),
        heldout=None,
        cost_if_left_out=None,
        separate_from=separating_manoeuvre(library, effect.identifier, others) if others else None,
        words=effect.words,
        equation=effect.equation,
        setting=setting,
        evidence_nats=float(odds),
    )


def _effect_probabilities(
    all_sets: Hypotheses, space: Space, best: Hypothesis, key: str
) -> dict[str, float]:
    """Probabilities of the effects that could be in a member's place, the largest first."""
    member = all_sets.component(key)
    reduced = all_sets.judge(best.names - {key})
    present = {all_sets.component(k).effect for k in reduced.names}
    candidates = [
        k for effect, keys in space.effects.items() if effect not in present for k in keys
    ]
    candidates = [k for k in candidates if all_sets.is_compatible(reduced.names, k)]
    scan = candidate_scan(all_sets.made, reduced.keys, best.fit_at_lower_noise(reduced))
    worth = scan.log_bayes_factors([*dict.fromkeys([*candidates, key])])
    log_odds: dict[str, float] = {}
    for k, nats in worth.items():
        component = all_sets.component(k)
        effect = component.effect or k
        log_odds[effect] = float(
            np.logaddexp(log_odds.get(effect, -np.inf), nats + component.prior)
        )
    own = member.effect or key
    log_odds[own] = max(log_odds[own], worth[key] + member.prior)
    rival = max((k for k in worth if k != key), key=lambda k: worth[k], default=key)
    compared = step_alternatives(all_sets, space, key)
    if member.row is None or log_odds[all_sets.component(rival).effect or rival] > log_odds[own]:
        compared = [*compared, rival]
    if compared:  # a scan's sizes, noise and forms are approximate: compare these as sets
        offset = best.score - reduced.score - log_odds[own]
        log_odds = {effect: nats + offset for effect, nats in log_odds.items()}
        for k in dict.fromkeys(compared):
            exchanged = all_sets.judge(all_sets.with_member(reduced.names, k), best)
            difference = exchanged.score - best.score
            if all_sets.is_real(best.names):  # the laws are not exact: twelve nats count as three
                difference *= priors.NAME_ODDS / priors.ODDS_REAL
            log_odds[all_sets.component(k).effect or k] = log_odds[own] + difference
    # with the remainder no effect is exchanged (`exchange_effects`): none is more probable
    if all_sets.is_real(best.names):
        log_odds = {effect: min(nats, log_odds[own]) for effect, nats in log_odds.items()}
    for effect, keys in space.effects.items():
        candidate = all_sets.component(keys[0])
        if (
            effect in log_odds
            and effect != own
            and contains_component(candidate, member, ROUNDING_SHARE)
        ):
            log_odds[effect] = log_odds[own] + float(np.log(priors.SAME_FORM))
    total = np.logaddexp.reduce(list(log_odds.values()))
    probabilities = {effect: float(np.exp(nats - total)) for effect, nats in log_odds.items()}
    return dict(sorted(probabilities.items(), key=lambda item: -item[1]))


def _locate(all_sets: Hypotheses, best: Hypothesis, key: str, frame: str) -> Where:
    """When, on which axes and in which regime a member acts, described in a frame."""
    member, track = all_sets.component(key), all_sets.made.context.track
    return locate_contribution(
        track, contribution_of(all_sets, best, key)[0], member.setting, frame
    )


def drift_finding(
    all_sets: Hypotheses, space: Space, best: Hypothesis, key: str, odds: float, effect: Effect,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """A slow free process as a finding: the drift's coefficients that fit it best."""
    context = all_sets.made.context
    setting = effect.settings(context)[0]
    drift_columns, process = effect.columns(context, setting), all_sets.component(key).columns
    drift_matrix, process_matrix = (
        (drift_columns.gyro, process.gyro)
        if drift_columns.mag is None
        else (drift_columns.mag, process.mag)
    )
    if drift_matrix is None or process_matrix is None:
        raise ValueError(f"{effect.identifier} and {key} are not of one sensor")
    # about their means: a constant is the calibration's bias
    X, Y = (
        (one - one.mean(axis=0)).reshape(-1, one.shape[2]) for one in (drift_matrix, process_matrix)
    )
    projection = np.linalg.pinv(X) @ Y
    value, deviation = coefficients(all_sets, best, key)
    drift = projection @ value
    drift_deviation = np.sqrt(np.square(projection) @ np.square(deviation))
    kept = {k: v for k, v in setting.items() if k != "searched"}
    probabilities = _effect_probabilities(all_sets, space, best, key)
    # the drift's own form is one of those that the free process may have
    probability = probabilities.pop(key) + probabilities.pop(effect.identifier, 0.0)
    probabilities = {effect.identifier: probability, **probabilities}
    where = _locate(all_sets, best, key, effect.frame or effect.family)
    finding = _build_finding(
        effect, probabilities, where, drift, drift_deviation, kept, odds, library
    )
    finding = replace(finding, cost_if_left_out=cost_if_left_out(all_sets, best, key))
    return finding, Term(effect.identifier, drift, drift_deviation, kept)


def misalignment_finding(
    all_sets: Hypotheses, best: Hypothesis, odds: float, effect: Effect,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """The turn in the gyro's matrix as a finding.

    A gyro that is turned by minus an angle reads like a magnetometer that is turned by the angle.
    """
    turn, deviation = (part[TURNS] for part in coefficients(all_sets, best, GYRO_MATRIX))
    where = _locate(all_sets, best, GYRO_MATRIX, effect.frame or effect.family)
    probabilities = {effect.identifier: 1.0}
    finding = _build_finding(effect, probabilities, where, -turn, deviation, {}, odds, library)
    finding = replace(finding, cost_if_left_out=cost_if_left_out(all_sets, best, GYRO_MATRIX))
    return finding, Term(effect.identifier, -turn, deviation, {})
