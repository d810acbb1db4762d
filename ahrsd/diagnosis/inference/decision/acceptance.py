"""Which members of the likeliest set are told.

Each has to be likelier than its absence, whatever takes its place (nothing, or a course in time of
any frame), by odds that the losses ask for; and names have to hold beside sources of other laws,
and with a coefficient that is constant.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.alternatives import (
    by_heading,
    form_keys,
    lone_parts,
    other_courses,
    varying,
)
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.decision.members import (
    added_by,
    coefficients,
    is_ordinary,
    library_members,
)
from ahrsd.diagnosis.inference.decision.unexplained import is_along
from ahrsd.diagnosis.inference.likelihood.candidates import beside
from ahrsd.diagnosis.inference.search.model_search import (
    Hypotheses,
    Hypothesis,
    Space,
    at_its_moments,
    come_and_gone,
)
from ahrsd.diagnosis.where_and_when.locate import single_source_direction


def accepted(
    all_sets: Hypotheses, space: Space, best: Hypothesis
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """The likeliest set with members that are told, and what is likeliest without each."""
    best = _with_one_part(all_sets, space, best)
    best = _with_heading(all_sets, space, best)
    best = _come_and_gone(all_sets, space, best)
    best, rivals = _borne_out(all_sets, space, best)
    likelier = _of_likeliest_kind(all_sets, space, best)
    if likelier is not best:
        best, rivals = _borne_out(all_sets, space, likelier)
    best, rivals = _beside_others(all_sets, space, best, rivals)
    best, rivals = _held_to_form(all_sets, space, best, rivals)
    return _of_one_source(all_sets, space, best, rivals)


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


def _of_likeliest_kind(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """The set with each step that has a form of the kind that is likeliest at its moments.

    Beside an ordinary remainder nothing is exchanged: its laws are not exact.
    """
    if all_sets.is_real(best.names):
        return best
    while True:
        tried = [
            all_sets.with_(best.names - {key}, other)
            for key in library_members(all_sets, best)
            for other in at_its_moments(all_sets, space, key)
        ]
        likelier = all_sets.likeliest(best, tried)
        if likelier is best:
            return best
        best = likelier


def _is_form(all_sets: Hypotheses, best: Hypothesis, key: str) -> bool:
    """Whether of a member mostly what it leaves of its form is there: it is no name of anything.

    Its coefficients are within their deviations, or its own columns, however large, hold less than
    the larger part of what both add.
    """
    if key not in all_sets.forms:
        return False
    value, deviation = coefficients(all_sets, best, key)
    if np.all(np.abs(value) < deviation):
        return True
    if key == LAG:
        return False
    columns = all_sets.component(key).columns
    own = columns.mag if columns.on_mag else columns.gyro
    if own is None:
        return False
    added = [added_by(all_sets, best, one)[0] for one in (key, all_sets.forms[key])]
    both = np.sum(added, axis=0).ravel()
    flat = np.asarray(own).reshape(len(both), -1)
    held = flat @ np.linalg.lstsq(flat, both)[0]
    return bool(held @ held < priors.OWN_PART * (both @ both))


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


def _beside_others(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """The names that hold beside sources of other laws; the set as it was where all do.

    A source that is quick is noise of a colour as well: only in place of a name it is told.
    """
    if not library_members(all_sets, best) or not space.courses:
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
    if set(library_members(all_sets, held)) >= set(library_members(all_sets, best)):
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
        for key in library_members(all_sets, best):
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


def _of_one_source(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """The set without names that act along the one direction in which something unknown acts.

    A source that no name has is drawn by logged columns that go with it, each in part: all along
    its direction, the rest as well.  Several names, or one that is less sure than the rest, are
    one unknown source; one that is surer leaves a rest.
    """
    odds = {key: best.score - rival.score for key, rival in rivals.items()}
    members = [key for key in odds if key != LAG and all_sets.component(key).columns.on_mag]
    named = [key for key in members if all_sets.component(key).row is not None]
    unknown = [key for key in set(members) - set(named) if not is_ordinary(all_sets, best, key)]
    added = {key: added_by(all_sets, best, key)[0] for key in (*named, *unknown)}
    for key in sorted(unknown, key=lambda one: -odds[one]):
        direction, share = single_source_direction(added[key], np.ones(len(added[key])))
        if share < priors.MAINLY_ONE:
            continue
        alike = [one for one in named if is_along(direction, added[one])]
        parts = alike if len(alike) > 1 else [one for one in alike if odds[one] < odds[key]]
        if parts:
            fewer = all_sets.judge(best.names - set(parts), best)
            return _of_one_source(all_sets, space, *_borne_out(all_sets, space, fewer))
    return best, rivals


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
        if all_sets.component(other).row is None and not is_ordinary(all_sets, best, other)
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


def _without(all_sets: Hypotheses, space: Space, best: Hypothesis, key: str) -> Hypothesis:
    """The likeliest set without a member: with nothing or a course in its place."""
    fewer = all_sets.without(best.names, key)
    courses = [] if all_sets.component(key).effect is None else space.courses
    tried = [fewer | {course} for course in courses if course not in fewer]
    return all_sets.likeliest(all_sets.judge(fewer, best), tried, near=best)
