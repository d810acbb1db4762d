"""A member of a set as a finding: what else it may be, its values, where it acts, its cost."""

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
    TO_THE_DIGIT,
    holds,
)
from ahrsd.diagnosis.inference.components.ordinary_remainder import GYRO_MATRIX, TURNS
from ahrsd.diagnosis.inference.decision.members import added_by, coefficients, cost_if_left_out
from ahrsd.diagnosis.inference.decision.which_delay import delay_unit, which_delay
from ahrsd.diagnosis.inference.likelihood.candidates import beside
from ahrsd.diagnosis.inference.search.model_search import (
    Hypotheses,
    Hypothesis,
    Space,
    at_its_moments,
)
from ahrsd.diagnosis.inference.search.near_settings import changed, opened
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.where_and_when.address import locate_contribution
from ahrsd.samples import Array


def as_finding(
    all_sets: Hypotheses, space: Space, best: Hypothesis, key: str, odds: float,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """A member as a finding and as a term of the repaired model."""
    one = all_sets.component(key)
    value, deviation = coefficients(all_sets, best, key)
    deviation = np.maximum(deviation, _left_open(all_sets, best, key, value))
    effect = library[one.effect or key]
    if key == LAG:
        shares = which_delay(all_sets, best, value, deviation, library)
        effect = library[next(iter(shares))]
        unit = effect.delay / delay_unit(all_sets, effect)
        value, deviation = value * unit, deviation * abs(unit)
    else:
        shares = _shares(all_sets, space, best, key)
    setting = {k: v for k, v in one.setting.items() if k != "searched"}
    if effect.filters:  # its form is that of the filter itself
        setting["time_constant_s"] = float(value[0])
    where = _where(all_sets, best, key, effect.frame or effect.family)
    found = _found(effect, shares, where, value, deviation, setting, odds, library)
    found = replace(found, cost_if_left_out=cost_if_left_out(all_sets, best, key))
    return found, Term(effect.identifier, value, deviation, setting)


def _left_open(all_sets: Hypotheses, best: Hypothesis, key: str, value: Array) -> Array:
    """(q,) deviations of a member's coefficients whatever its setting is nearby.

    What has a form of its own, as the way of a hand, has no setting that is sharper.
    """
    one, made = all_sets.component(key), all_sets.made
    near = {} if key in all_sets.forms else changed(one, made.context)
    whole = opened(one, made.context, value, near)
    if whole is None:
        return np.zeros(len(value))
    fewer = all_sets.judge(best.names - {key}, best)
    at = replace(fewer.at, log_noise=best.at.log_noise)
    return beside(made, fewer.keys, at).likeliest(whole)[1][: len(value)]


def _found(
    effect: Effect, shares: Mapping[str, float], where: Where, value: Array, deviation: Array,
    setting: Setting, odds: float, library: Mapping[str, Effect],
) -> Finding:  # fmt: skip
    """A finding with what it may be in its place, and what to drive to tell."""
    sure = float(1.0 / (1.0 + np.exp(-min(odds, priors.SUREST_ODDS))))
    others = tuple(
        Share(other, share * sure) for other, share in shares.items()
        if other != effect.identifier and share > priors.SMALLEST_SHARE
    )  # fmt: skip
    close = [one.effect for one in others]
    told = zip(effect.parameters, value, deviation, strict=True)
    return Finding(
        effect=effect.identifier,
        confidence=shares.get(effect.identifier, 1.0) * sure,
        alternatives=others,
        where=where,
        parameters=tuple(Value(p.name, float(v), float(d), p.unit) for p, v, d in told),
        heldout=None,
        cost_if_left_out=None,
        separate_from=separating_manoeuvre(library, effect.identifier, close) if close else None,
        words=effect.words,
        equation=effect.equation,
        setting=setting,
        evidence_nats=float(odds),
    )


def _shares(all_sets: Hypotheses, space: Space, best: Hypothesis, key: str) -> dict[str, float]:
    """Probabilities of the names that could be what a member is, in its place."""
    own = all_sets.component(key)
    fewer = all_sets.judge(best.names - {key})
    named = {all_sets.component(k).effect for k in fewer.names}
    asked = [k for name, keys in space.effects.items() if name not in named for k in keys]
    asked = [k for k in asked if all_sets.is_asked(fewer.names, k)]
    scan = beside(all_sets.made, fewer.keys, best.at_of(fewer))
    worth = scan.worth([*dict.fromkeys([*asked, key])])
    by_name: dict[str, float] = {}
    for k, nats in worth.items():
        one = all_sets.component(k)
        name = one.effect or k
        by_name[name] = float(np.logaddexp(by_name.get(name, -np.inf), nats + one.prior))
    mine = own.effect or key
    by_name[mine] = max(by_name[mine], worth[key] + own.prior)
    rival = max((k for k in worth if k != key), key=lambda k: worth[k], default=key)
    closer = at_its_moments(all_sets, space, key)
    if own.row is None or by_name[all_sets.component(rival).effect or rival] > by_name[mine]:
        closer = [*closer, rival]
    if closer:  # the scan knows sizes, noise and forms but roughly: each as a set of its own
        off = best.score - fewer.score - by_name[mine]
        by_name = {name: nats + off for name, nats in by_name.items()}
        for k in dict.fromkeys(closer):
            instead = all_sets.judge(all_sets.with_(fewer.names, k), best)
            apart = instead.score - best.score
            if all_sets.is_real(best.names):  # of laws that are not exact twelve nats say three
                apart *= priors.NAME_ODDS / priors.ODDS_REAL
            by_name[all_sets.component(k).effect or k] = by_name[mine] + apart
    if all_sets.is_real(best.names):  # what is not exchanged there is no likelier (`exchanged`)
        by_name = {name: min(nats, by_name[mine]) for name, nats in by_name.items()}
    for name, keys in space.effects.items():
        wider = all_sets.component(keys[0])
        if name in by_name and name != mine and holds(wider, own, TO_THE_DIGIT):
            by_name[name] = by_name[mine] + float(np.log(priors.SAME_FORM))
    total = np.logaddexp.reduce(list(by_name.values()))
    shares = {name: float(np.exp(nats - total)) for name, nats in by_name.items()}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _where(all_sets: Hypotheses, best: Hypothesis, key: str, frame: str) -> Where:
    """When, on which axes and in which regime a member acts, told in a frame."""
    one, track = all_sets.component(key), all_sets.made.context.track
    return locate_contribution(track, added_by(all_sets, best, key)[0], one.setting, frame)


def drift_finding(
    all_sets: Hypotheses, space: Space, best: Hypothesis, key: str, odds: float, effect: Effect,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """A slow course as a finding: the drift's own coefficients that are nearest to it."""
    context = all_sets.made.context
    setting = effect.settings(context)[0]
    form, course = effect.columns(context, setting), all_sets.component(key).columns
    mine, other = (form.gyro, course.gyro) if form.mag is None else (form.mag, course.mag)
    if mine is None or other is None:
        raise ValueError(f"{effect.identifier} and {key} are not of one sensor")
    # about their means: a constant is the calibration's bias
    X, Y = ((one - one.mean(axis=0)).reshape(-1, one.shape[2]) for one in (mine, other))
    nearest = np.linalg.pinv(X) @ Y
    value, deviation = coefficients(all_sets, best, key)
    drift, unsure = nearest @ value, np.sqrt(np.square(nearest) @ np.square(deviation))
    kept = {k: v for k, v in setting.items() if k != "searched"}
    shares = _shares(all_sets, space, best, key)
    whole = shares.pop(key) + shares.pop(effect.identifier, 0.0)  # its own form is one of any
    shares = {effect.identifier: whole, **shares}
    where = _where(all_sets, best, key, effect.frame or effect.family)
    found = _found(effect, shares, where, drift, unsure, kept, odds, library)
    found = replace(found, cost_if_left_out=cost_if_left_out(all_sets, best, key))
    return found, Term(effect.identifier, drift, unsure, kept)


def turn_finding(
    all_sets: Hypotheses, best: Hypothesis, odds: float, effect: Effect,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """The turn of the gyro's matrix as a finding.

    A gyro that is turned by minus the angle reads as a magnetometer that is turned by it.
    """
    turn, unsure = (part[TURNS] for part in coefficients(all_sets, best, GYRO_MATRIX))
    where = _where(all_sets, best, GYRO_MATRIX, effect.frame or effect.family)
    shares = {effect.identifier: 1.0}
    found = _found(effect, shares, where, -turn, unsure, {}, odds, library)
    found = replace(found, cost_if_left_out=cost_if_left_out(all_sets, best, GYRO_MATRIX))
    return found, Term(effect.identifier, -turn, unsure, {})
