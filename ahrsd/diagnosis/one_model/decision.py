"""From the likeliest set to an answer: names with their rivals, what is left, what is ordinary.

A name is told where every set without it, whatever takes its place (nothing, or a course in time of
any frame), is less likely by odds that the losses ask for.  What is left is unknown where a free
course is as sure, or where a part of the ordinary remainder is beyond its 95 %.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from ahrsd.diagnosis.answer.added_field import heading_error_deg
from ahrsd.diagnosis.answer.diagnosis import Cost, Finding, Share, Unexplained, Value, Where
from ahrsd.diagnosis.answer.text import separating_manoeuvre
from ahrsd.diagnosis.calibration_fit.delay import usual_step
from ahrsd.diagnosis.calibration_fit.null_fit import prior_of
from ahrsd.diagnosis.effects.effect import Effect, Setting
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.one_model import priors
from ahrsd.diagnosis.one_model.alternatives import (
    by_heading,
    form_keys,
    lone_parts,
    other_courses,
    varying,
)
from ahrsd.diagnosis.one_model.candidates import beside
from ahrsd.diagnosis.one_model.component import Sized
from ahrsd.diagnosis.one_model.effect_components import (
    LAG,
    LAG_FORM,
    TO_THE_DIGIT,
    holds,
    plain_delay,
)
from ahrsd.diagnosis.one_model.linearised import CALIBRATION, model_of
from ahrsd.diagnosis.one_model.model_search import Hypotheses, Hypothesis, Space, come_and_gone
from ahrsd.diagnosis.one_model.near_settings import changed, opened
from ahrsd.diagnosis.one_model.remainder import GYRO_MATRIX, TURNS, still_spells
from ahrsd.diagnosis.where_and_when.address import AXES, departures, where_of
from ahrsd.diagnosis.where_and_when.locate import Frame, single_source, unit_columns
from ahrsd.samples import Array

#: odds are told no surer than this
_SUREST = 30.0
_SMALLEST_SHARE = 0.01
_PIECES = 80


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Names, terms and what is left of one hypothesis.

    best: with nothing that is not told;  keys: of the findings and of the terms, in their order
    unknown: of what is left: a course, a part of the remainder, a source's steps
    rivals: what is likeliest without each member
    """

    best: Hypothesis
    keys: tuple[str, ...]
    unknown: tuple[str, ...]
    rivals: Mapping[str, Hypothesis]
    findings: tuple[Finding, ...]
    terms: tuple[Term, ...]
    unexplained: Unexplained
    log_odds: float


def decided(
    all_sets: Hypotheses, space: Space, best: Hypothesis, library: Mapping[str, Effect]
) -> Answer:
    """The answer of a search."""
    best = _with_one_part(all_sets, space, best)
    best = _with_heading(all_sets, space, best)
    best = _come_and_gone(all_sets, space, best)
    best, rivals = _borne_out(all_sets, space, best)
    best, rivals = _beside_others(all_sets, space, best, rivals)
    best, rivals = _held_to_form(all_sets, space, best, rivals)
    odds = {key: best.score - rival.score for key, rival in rivals.items()}
    switching = _switching(all_sets, best)
    found, terms, keys = [], [], []
    for key in sorted(odds, key=lambda one: -odds[one]):
        effect = all_sets.component(key).effect
        if effect is None or effect in switching or _is_ordinary(all_sets, best, key):
            continue
        finding, term = _told(all_sets, space, best, key, odds[key], library)
        found.append(finding)
        terms.append(term)
        keys.append(key)
    drifts = _drifts(all_sets, space, best, library)
    for key, row in drifts.items():
        finding, term = _drifting(all_sets, space, best, key, odds[key], row, library)
        found.append(finding)
        terms.append(term)
        keys.append(key)
    if (turned := _beyond_ordinary_turn(all_sets, best, library)) is not None:
        straight = all_sets.judge(best.names - {GYRO_MATRIX}, best)
        rivals = {**rivals, GYRO_MATRIX: straight}
        finding, term = _crooked(all_sets, best, best.score - straight.score, turned, library)
        found.append(finding)
        terms.append(term)
        keys.append(GYRO_MATRIX)
    unknown, left = _left(all_sets, space, best, {k: v for k, v in odds.items() if k not in drifts})
    if switching and not left.detected:
        unknown, left = _jumping(all_sets, best, switching[0], odds)
    surest = max([*odds.values(), left.evidence_nats], default=0.0)
    told = tuple(found), tuple(terms), left, surest
    return Answer(best, tuple(keys), unknown, rivals, *told)


def _drifts(
    all_sets: Hypotheses, space: Space, best: Hypothesis, library: Mapping[str, Effect]
) -> dict[str, Effect]:
    """Free courses that are as slow as the library's drift of their frame, whatever their form."""
    named = {all_sets.component(key).effect for key in best.names}
    out = {}
    for key in space.courses:
        if key not in best.names or _is_ordinary(all_sets, best, key):
            continue
        frame, corner = all_sets.component(key).frame, float(np.exp(all_sets.psi_of(best)[key][1]))
        rows = [one for name, one in library.items() if one.course and name not in named]
        rows = [one for one in rows if (one.frame or one.family) == frame]
        if rows and corner < priors.DRIFT_CORNER:
            out[key] = rows[0]
    return out


def _drifting(
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
    found = replace(found, cost_if_left_out=_cost(all_sets, best, key))
    return found, Term(effect.identifier, drift, unsure, kept)


def _beyond_ordinary_turn(
    all_sets: Hypotheses, best: Hypothesis, library: Mapping[str, Effect]
) -> Effect | None:
    """The library's turn between the sensors, where it is beyond what recordings ordinarily have.

    It stands in the gyro's matrix, which every real recording has.
    """
    named = {all_sets.component(key).effect for key in best.names}
    rows = [one for name, one in library.items() if one.turns_sensors and name not in named]
    if not rows or GYRO_MATRIX not in best.names:
        return None
    turn, unsure = (part[TURNS] for part in coefficients(all_sets, best, GYRO_MATRIX))
    surely = float(np.linalg.norm(turn)) - 2.0 * float(np.linalg.norm(unsure))
    return rows[0] if surely > priors.CROOKED * priors.ORDINARY_MISALIGNMENT_RAD else None


def _crooked(
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
    found = replace(found, cost_if_left_out=_cost(all_sets, best, GYRO_MATRIX))
    return found, Term(effect.identifier, -turn, unsure, {})


def _switching(all_sets: Hypotheses, best: Hypothesis) -> list[str]:
    """Kinds of steps of which there are so many that they are one source that changes, most first.

    Those that are ordinary count as well.
    """
    members = [all_sets.component(key) for key in sorted(best.names)]
    kinds = sorted(one.effect for one in members if one.effect is not None and one.jumps)
    many = [k for k in dict.fromkeys(kinds) if kinds.count(k) >= priors.CHANGES]
    return sorted(many, key=kinds.count, reverse=True)


def _jumping(
    all_sets: Hypotheses, best: Hypothesis, kind: str, odds: Mapping[str, float]
) -> tuple[tuple[str, ...], Unexplained]:
    """A source that goes in steps: its levels between the changes, along its direction."""
    keys = [key for key in sorted(best.names) if all_sets.component(key).effect == kind]
    moments = sorted(
        (time_s, way, key)
        for key in keys
        for time_s, way in zip(all_sets.component(key).moments_s, (1.0, -1.0), strict=False)
    )
    changes = np.array([way * coefficients(all_sets, best, key)[0] for _, way, key in moments])
    onsets = [time_s for time_s, _, _ in moments]
    time_s = all_sets.made.context.track.time_s
    at = np.linspace(time_s[0], time_s[-1], _PIECES)
    levels = np.vstack([np.zeros(3), np.cumsum(changes, axis=0)])
    course = levels[np.searchsorted(onsets, at, side="right")]
    frame = all_sets.component(keys[0]).frame
    nats = sum(odds.get(key, 0.0) for key in keys)
    return tuple(keys), _described(at, course, frame, nats, ((onsets[0], float(time_s[-1])),))


def _borne_out(
    all_sets: Hypotheses, space: Space, best: Hypothesis
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """The set without members that are not sure, and what is likeliest without each other one.

    A name with a free factor beside it is a part of that: it stays as long.
    """
    while True:
        own = [key for key in sorted(best.names) if key not in all_sets.remainder]
        own = [key for key in own if best.names.isdisjoint(form_keys(key))]
        asked = {key: asked_odds(all_sets, best, key) for key in own}
        without = {key: all_sets.without(best.names, key) for key in own}
        near = {key: all_sets.compared(without[key], best, best.score - asked[key]) for key in own}
        rivals = {key: one for key, one in near.items() if one is not None}
        if all(best.score - one.score >= asked[key] for key, one in rivals.items()):
            rivals = {key: _without(all_sets, space, best, key) for key in own}
        odds = {key: best.score - rival.score for key, rival in rivals.items()}
        unsure = [key for key in odds if odds[key] < asked[key] or _is_form(all_sets, best, key)]
        if not unsure:
            fewer = _without_one_moment(all_sets, best, asked)
            if fewer is best:
                return best, rivals
            best = fewer
            continue
        key = min(unsure, key=lambda one: odds[one])
        best = _without(all_sets, space, best, key)


def _come_and_gone(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The set with one vector that comes and goes where further steps are not worth being told.

    Each step more has to be worth what a name has to.
    """
    asked = priors.ODDS_REAL if all_sets.is_real(best.names) else priors.NAME_ODDS
    while True:
        likeliest = best
        for names in come_and_gone(all_sets, space, best.names):
            least = likeliest.score - asked * (len(likeliest.names) - len(names))
            found = all_sets.compared(names, best, least)
            if found is not None and found.score > least:
                likeliest = found
        if likeliest is best:
            return best
        best = likeliest


def _is_form(all_sets: Hypotheses, best: Hypothesis, key: str) -> bool:
    """Whether of a member only what it leaves of its form is there: it is no name of anything."""
    if key not in all_sets.forms:
        return False
    value, deviation = coefficients(all_sets, best, key)
    return bool(np.all(np.abs(value) < deviation))


def _without_one_moment(
    all_sets: Hypotheses, best: Hypothesis, asked: Mapping[str, float]
) -> Hypothesis:
    """The set without names of one moment that are not worth together what each has to be.

    Steps of the field and of the iron at a moment undo each other: with one of them left out what
    the other does is seen, and each looks sure.
    """
    moments = {key: all_sets.component(key).moments_s for key in asked}
    for first, last in itertools.combinations(sorted(key for key in asked if moments[key]), 2):
        apart_s = np.abs(np.subtract.outer(moments[first], moments[last]))
        if np.min(apart_s) > priors.APPROACH_S:
            continue
        least = best.score - asked[first] - asked[last]
        fewer = all_sets.compared(best.names - {first, last}, best, least)
        if fewer is not None and fewer.score > least:
            return fewer
    return best


def _with_one_part(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The set with a part of what recordings leave in place of all of them, where that is likelier.

    What has but one of them, and that far beyond the others, leaves nothing ordinary.
    """
    rest = frozenset(all_sets.remainder)
    if all_sets.real or not rest & best.names or not space.courses:
        return best
    found = lone_parts(all_sets.component(key) for key in all_sets.remainder)
    all_sets.made.add(found)
    bare = best.names - rest
    return all_sets.likeliest(best, [bare | {one.key} for one in found])


def _with_heading(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The set with a field by heading, where that is likelier and nothing else is unknown.

    Of rooms it is not asked: where one walks in a circle, the heading is the place.
    """
    unknown = any(all_sets.component(key).row is None for key in best.names)
    if unknown or all_sets.real or not space.courses:
        return best
    heading = by_heading(all_sets.made.context)
    all_sets.made.add([heading])
    return all_sets.likeliest(best, [best.names | {heading.key}])


def _names(all_sets: Hypotheses, best: Hypothesis) -> list[str]:
    """Members that the library has, without the delay."""
    known = [key for key in sorted(best.names) if all_sets.component(key).row is not None]
    return [key for key in known if key != LAG]


def _beside_others(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """The names that hold beside sources of other laws; the set as it was where all do.

    A source that is quick is noise of a colour as well: only in place of a name it is told.
    """
    if not _names(all_sets, best) or not space.courses:
        return best, rivals
    parts = lone_parts(all_sets.component(key) for key in all_sets.remainder)
    others = other_courses(all_sets.made.context)
    all_sets.made.add([*parts, *others])
    wide, rest = best, frozenset(all_sets.remainder)
    for one in (*others, *parts):
        more = wide.names | {one.key}
        wide = all_sets.likeliest(wide, [more - rest] if one in parts else [more, more - rest])
    if wide is best:
        return best, rivals
    held, others_rivals = _borne_out(all_sets, space, wide)
    if set(_names(all_sets, held)) >= set(_names(all_sets, best)):
        return best, rivals
    return held, others_rivals


def _held_to_form(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """With a free factor for each name that stands in for something: its coefficient varies.

    A factor is taken once: one that is not borne out beside the names that are left stays out.
    """
    taken = set[str]()
    while True:
        asked = priors.ODDS_REAL if all_sets.is_real(best.names) else priors.FORM_ODDS
        found, made = best, all_sets.made
        for key in _names(all_sets, best):
            one = all_sets.component(key)
            # a quick cause's phase is summed from its column, and wanders as that errs
            wanders = one.row is not None and one.row.quick and "covariate" in one.setting
            if wanders or not taken.isdisjoint(form_keys(key)):
                continue
            forms = varying(one, added_by(all_sets, best, key)[0], made.context)
            made.add(forms)
            for form in forms:
                least = max(best.score + asked, found.score)
                free = all_sets.compared(best.names | {form.key}, best, least)
                if free is None or free.score <= least:
                    continue
                if float(np.exp(all_sets.psi_of(free)[form.key][0])) > priors.VARIES:
                    found = free
        if found is best:
            return best, rivals
        taken |= found.names - best.names
        best, rivals = _borne_out(all_sets, space, found)


def asked_odds(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """Log odds from which on a member is told.

    Beside something unknown a name has to be the larger part: a source that no law here has leaves
    a rest, and names take that, of either sensor: a gyro's error by force for what slides by it.
    What takes a rest by a logged column takes it by that column at other times as well.
    """
    one = all_sets.component(key)
    if key == LAG:
        return priors.NAME_ODDS
    asked = priors.UNKNOWN_ODDS if one.row is None else priors.NAME_ODDS
    if all_sets.is_real(best.names):
        asked = priors.ODDS_REAL
    if one.row is None:
        return asked
    asked = max(asked, priors.BESIDE_UNKNOWN * all_sets.unknown_nats)
    unknown = [
        other for other in sorted(best.names - frozenset(all_sets.remainder))
        if all_sets.component(other).row is None and not _is_ordinary(all_sets, best, other)
    ]  # fmt: skip
    if not unknown:
        return asked
    if "covariate" in one.setting:
        return asked + _at_other_times(all_sets, best, key)
    nats = best.score - all_sets.judge(best.names - frozenset(unknown), best).score
    return max(asked, priors.BESIDE_UNKNOWN * nats)


def _at_other_times(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """Nats that a member would be worth once more at the best of other times, 0 at least.

    Beside the member itself: what comes again and again is like itself at other times.
    """
    copies = [all_sets.component(key).moved(share) for share in priors.SHIFTS]
    all_sets.made.add(copies)
    scan = beside(all_sets.made, best.keys, best.at)
    return max(0.0, *scan.worth([copy.key for copy in copies]).values())


def _is_ordinary(all_sets: Hypotheses, best: Hypothesis, key: str) -> bool:
    """Whether a member is no larger than what real recordings ordinarily have of its kind."""
    if key == LAG or not all_sets.is_real(best.names):
        return False
    one = all_sets.component(key)
    if one.jumps and _is_place(all_sets, key):
        return True
    course = priors.ORDINARY_COURSE.get(one.frame, 0.0)
    return size_of(all_sets, best, key) < (course if one.row is None else one.row.ordinary)


def _is_place(all_sets: Hypotheses, key: str) -> bool:
    """Whether a step of the field is where the sensor is lifted off a place or put down on it."""
    one, recorded = all_sets.component(key), all_sets.made.point.problem.recorded
    spells = still_spells(recorded.time_s, recorded.gyro_b_rad_s)
    if not spells or one.frame != "world":
        return False
    off = np.abs(np.ravel(spells)[:, None] - one.moments_s)
    return bool(np.min(off) < 2.0 * priors.TRANSITION_S)


def _without(all_sets: Hypotheses, space: Space, best: Hypothesis, key: str) -> Hypothesis:
    """The likeliest set without a member: with nothing or a course in its place."""
    fewer = all_sets.without(best.names, key)
    courses = [] if all_sets.component(key).effect is None else space.courses
    tried = [fewer | {course} for course in courses if course not in fewer]
    return all_sets.likeliest(all_sets.judge(fewer, best), tried, near=best)


def _told(
    all_sets: Hypotheses, space: Space, best: Hypothesis, key: str, odds: float,
    library: Mapping[str, Effect],
) -> tuple[Finding, Term]:  # fmt: skip
    """A member as a finding and as a term of the repaired model."""
    one = all_sets.component(key)
    value, deviation = coefficients(all_sets, best, key)
    deviation = np.maximum(deviation, _left_open(all_sets, best, key, value))
    effect = library[one.effect or key]
    if key == LAG:
        shares = _which_delay(all_sets, best, value, deviation, library)
        effect = library[next(iter(shares))]
        unit = effect.delay / _delay_unit(all_sets, effect)
        value, deviation = value * unit, deviation * abs(unit)
    else:
        shares = _shares(all_sets, space, best, key)
    setting = {k: v for k, v in one.setting.items() if k != "searched"}
    if effect.filters:  # its form is that of the filter itself
        setting["time_constant_s"] = float(value[0])
    where = _where(all_sets, best, key, effect.frame or effect.family)
    found = _found(effect, shares, where, value, deviation, setting, odds, library)
    found = replace(found, cost_if_left_out=_cost(all_sets, best, key))
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
    sure = float(1.0 / (1.0 + np.exp(-min(odds, _SUREST))))
    others = tuple(
        Share(other, share * sure) for other, share in shares.items()
        if other != effect.identifier and share > _SMALLEST_SHARE
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


def _cost(all_sets: Hypotheses, best: Hypothesis, key: str) -> Cost:
    """What the calibration would be off by in the set without a member."""
    made = all_sets.made
    middle, here = prior_of(made.point.problem.track).mean, made.point.filtered.model
    fewer = all_sets.judge(all_sets.without(best.names, key), best)
    left_out, known = (
        model_of(coefficients(all_sets, one, CALIBRATION)[0] + middle, here)
        for one in (fewer, best)
    )
    shift = np.linalg.norm(left_out.hard_iron_gauss - known.hard_iron_gauss)
    return Cost(float(shift), heading_error_deg(left_out, known, made.context.field_b))


def coefficients(all_sets: Hypotheses, best: Hypothesis, key: str) -> tuple[Array, Array]:
    """Likeliest coefficients of a member and their deviations."""
    begin = 0
    for one in best.keys:
        width = all_sets.component(one).width
        if one == key:
            part = slice(begin, begin + width)
            return best.at.mean[part], best.at.deviation[part]
        begin += width
    raise KeyError(key)


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
    named_so = all_sets.component(rival).effect or rival
    if own.row is None or by_name[named_so] > by_name[mine]:
        # the scan knows sizes and noise but roughly: both as sets of their own
        off = best.score - fewer.score - by_name[mine]
        by_name = {name: nats + off for name, nats in by_name.items()}
        instead = all_sets.judge(all_sets.with_(fewer.names, rival), best)
        by_name[named_so] = instead.score - fewer.score
    for name, keys in space.effects.items():
        wider = all_sets.component(keys[0])
        if name in by_name and name != mine and holds(wider, own, TO_THE_DIGIT):
            by_name[name] = by_name[mine] + float(np.log(priors.SAME_FORM))
    total = np.logaddexp.reduce(list(by_name.values()))
    shares = {name: float(np.exp(nats - total)) for name, nats in by_name.items()}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _which_delay(
    all_sets: Hypotheses, best: Hypothesis, lag_s: Array, deviation_s: Array,
    library: Mapping[str, Effect],
) -> dict[str, float]:  # fmt: skip
    """Which delay it is, with probabilities, that which is told first.

    A filter's where its form is there in full; half a step's where the delay is that and no other.
    """
    tau, unsure = float(lag_s[0]), float(deviation_s[0])
    late = cast("Effect", all_sets.component(LAG).row)
    plain = plain_delay(library, 1.0 if tau >= 0.0 else -1.0) or late
    nats = {plain.identifier: 0.0}
    half_s = _half_step_s(all_sets)
    for row in library.values() if tau > 0.0 else ():
        if row.filters and LAG_FORM in best.keys:
            value, deviation = (float(one[0]) for one in coefficients(all_sets, best, LAG_FORM))
            whole = 0.5 * ((value / deviation) ** 2 - ((value - 1.0) / deviation) ** 2)
            full = abs(value - 1.0) < max(2.0 * deviation, priors.NEARLY_ALL)
            nats[row.identifier] = whole - priors.ODDS_REAL if full else -np.inf
        elif row.of_step and half_s is not None:
            miss, usual = (tau - half_s) / unsure, tau / priors.ORDINARY_LAG_S
            point = 0.5 * (usual**2 - miss**2) + float(np.log(priors.ORDINARY_LAG_S / unsure))
            nats[row.identifier] = point + float(np.log(priors.HALF_STEP))
    total = np.logaddexp.reduce(list(nats.values()))
    shares = {name: float(np.exp(one - total)) for name, one in nats.items()}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _half_step_s(all_sets: Hypotheses) -> float | None:
    """Half of the recording's step, None where the steps are not alike."""
    step_s = usual_step(all_sets.made.point.problem.recorded.dt_s)
    return None if step_s is None else step_s / 2.0


def _delay_unit(all_sets: Hypotheses, effect: Effect) -> float:
    """Seconds of an effect's unit of delay."""
    half_s = _half_step_s(all_sets) if effect.of_step else None
    return 1.0 if half_s is None else half_s


def added_by(all_sets: Hypotheses, best: Hypothesis, key: str) -> tuple[Array, str]:
    """(N, 3) what a member adds to the readings, and its unit: gauss, or rad/s of the gyro's."""
    one, track = all_sets.component(key), all_sets.made.context.track
    value, _ = coefficients(all_sets, best, key)
    matrix = one.columns.mag if one.columns.on_mag else one.columns.gyro
    added = np.zeros((len(track), 3)) if matrix is None else np.asarray(matrix @ value)
    return added, "gauss" if one.columns.on_mag else "rad/s"


def _where(all_sets: Hypotheses, best: Hypothesis, key: str, frame: str) -> Where:
    """When, on which axes and in which regime a member acts, told in a frame."""
    one, track = all_sets.component(key), all_sets.made.context.track
    return where_of(track, added_by(all_sets, best, key)[0], one.setting, frame)


def _left(
    all_sets: Hypotheses, space: Space, best: Hypothesis, odds: Mapping[str, float]
) -> tuple[tuple[str, ...], Unexplained]:
    """What no name explains, where that is beyond the ordinary, and the members that it is."""
    courses = [key for key in odds if all_sets.component(key).row is None]
    courses = [key for key in courses if not _is_ordinary(all_sets, best, key)]
    if courses:
        key = max(courses, key=lambda one: odds[one])
        if key in space.courses:
            return (key,), _course(all_sets, best, key, odds[key])
        stands_in = [name for name in _names(all_sets, best) if key in form_keys(name)]
        return (key, *stands_in), _other(all_sets, best, (key, *stands_in), odds[key])
    for key, size in priors.ORDINARY.items():
        if key not in best.names or size_of(all_sets, best, key) < size.up_to():
            continue
        nats = best.score - all_sets.judge(best.names - {key}, best).score
        if nats > priors.ODDS_REAL:
            frame, found = all_sets.component(key).frame, size_of(all_sets, best, key)
            unit = "rad/s" if frame == "gyro" else "gauss"
            where = Where((), AXES, frame, f"a part of what is left ({key})")
            return (key,), Unexplained(True, where, None, found, unit, evidence_nats=nats)
    return (), Unexplained(False)


def size_of(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """How large a member surely is: an effect in its usual scales, all else in its unit.

    Of an effect what is beyond two deviations: where the motion hardly shows a coefficient, a large
    one says nothing.
    """
    one = all_sets.component(key)
    if one.effect is not None and isinstance(one.law, Sized):
        value, deviation = coefficients(all_sets, best, key)
        return float(np.max(np.maximum(np.abs(value) - 2.0 * deviation, 0.0) / one.law.scale))
    psi = all_sets.psi_of(best)[key]
    return float(np.exp(psi[0])) * float(getattr(one.law, "unit", 1.0))


def _course(all_sets: Hypotheses, best: Hypothesis, key: str, odds: float) -> Unexplained:
    """A free course in time: its frame, its direction and its values."""
    one, time_s = all_sets.component(key), all_sets.made.context.track.time_s
    modes, unsure = (part.reshape(-1, 3) for part in coefficients(all_sets, best, key))
    edges = np.linspace(time_s[0], time_s[-1], _PIECES + 1)
    at = (edges[1:] + edges[:-1]) / 2
    order = np.arange(1, len(modes) + 1)
    phase = np.pi * (at - time_s[0]) / (time_s[-1] - time_s[0])
    waves = np.cos(phase[:, None] * order)
    course = waves @ modes
    deviation = np.sqrt(np.mean(waves**2 @ unsure**2, axis=1))
    away = departures(edges, course, deviation)
    spans = away or [(float(time_s[0]), float(time_s[-1]))]
    return _described(at, course, one.frame, odds, tuple(spans))


def _other(all_sets: Hypotheses, best: Hypothesis, keys: Sequence[str], odds: float) -> Unexplained:
    """What is left that members explain together, whatever their law: its course in their frame."""
    one, context = all_sets.component(keys[0]), all_sets.made.context
    added = sum(added_by(all_sets, best, key)[0] for key in keys)
    turned = np.einsum("nia,ni->na", unit_columns(context, cast("Frame", one.frame)), added)
    time_s = context.track.time_s
    at = np.linspace(time_s[0], time_s[-1], _PIECES)
    course = np.column_stack([np.interp(at, time_s, column) for column in turned.T])
    whole = ((float(time_s[0]), float(time_s[-1])),)
    return _described(at, course, one.frame, odds, one.setting.get("spans_s", whole))


def _described(
    at: Array, course: Array, frame: str, nats: float, spans: tuple[tuple[float, float], ...]
) -> Unexplained:
    """A course (k, 3) at times (k,) as what no name explains."""
    direction, share = single_source(course, np.ones(len(at)))
    source = course @ direction
    spread = course.std(axis=0)
    axes = tuple(axis for axis, size in zip(AXES, spread, strict=True) if size > 0.3 * spread.max())
    x, y, z = (float(part) for part in direction)
    return Unexplained(
        detected=True,
        where=Where(spans, axes, frame, direction=(x, y, z)),
        size=float(np.ptp(source)),
        unit="rad/s" if frame == "gyro" else "gauss",
        single_source_share=share,
        evidence_nats=float(nats),
        course=tuple(zip(at.tolist(), source.tolist(), strict=True)),
    )


def names_of(all_sets: Hypotheses, best: Hypothesis) -> Sequence[str]:
    """Effects in a set, sorted."""
    return sorted(one for key in best.names if (one := all_sets.component(key).effect))
