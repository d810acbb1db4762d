"""Which members of the most probable set are accepted.

A member has to be more probable than its absence, whatever replaces it (nothing, or a free process
in time in any frame), by odds that follow from the losses.  An effect has to remain as well when
sources with other laws are in the model, and its coefficient has to be constant.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.alternatives import (
    alternative_sources,
    coefficient_factors,
    factor_keys,
    field_by_heading,
    single_remainder_parts,
)
from ahrsd.diagnosis.inference.components.effect_components import LAG
from ahrsd.diagnosis.inference.decision.members import (
    coefficients,
    contribution_of,
    is_ordinary,
    library_members,
)
from ahrsd.diagnosis.inference.decision.unexplained import acts_along
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.search.model_search import (
    Hypotheses,
    Hypothesis,
    Space,
    sets_with_merged_steps,
    step_alternatives,
)
from ahrsd.diagnosis.where_and_when.locate import single_source_direction


def accept_members(
    all_sets: Hypotheses, space: Space, best: Hypothesis
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """The most probable set whose members are all accepted, and the best set without each."""
    best = _try_single_remainder_part(all_sets, space, best)
    best = _try_field_by_heading(all_sets, space, best)
    best = _merge_steps(all_sets, space, best)
    best, rivals = _drop_unsupported(all_sets, space, best)
    improved = _choose_step_kinds(all_sets, space, best)
    if improved is not best:
        best, rivals = _drop_unsupported(all_sets, space, improved)
    best, rivals = _test_against_alternatives(all_sets, space, best, rivals)
    best, rivals = _test_constant_coefficients(all_sets, space, best, rivals)
    return _drop_parts_of_unknown_source(all_sets, space, best, rivals)


def _drop_unsupported(
    all_sets: Hypotheses, space: Space, best: Hypothesis
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """Remove members until the data support each one; with the best set without each.

    A free factor of an effect and the effect are one member: an effect is not tested while its
    factor is in the set.
    """
    while True:
        tested = [key for key in sorted(best.names) if key not in all_sets.remainder]
        tested = [key for key in tested if best.names.isdisjoint(factor_keys(key))]
        required = {key: required_odds(all_sets, best, key) for key in tested}
        without = {key: all_sets.without_member(best.names, key) for key in tested}
        reduced = {
            key: all_sets.judge_above(without[key], best, best.score - required[key])
            for key in tested
        }
        rivals = {key: one for key, one in reduced.items() if one is not None}
        if all(best.score - one.score >= required[key] for key, one in rivals.items()):
            rivals = {key: _best_without(all_sets, space, best, key) for key in tested}
        odds = {key: best.score - rival.score for key, rival in rivals.items()}
        unsupported = [
            key for key in odds if odds[key] < required[key] or _is_mostly_form(all_sets, best, key)
        ]
        if not unsupported:
            without_pair = _drop_unsupported_pair(all_sets, space, best, required)
            if without_pair is best:
                return best, rivals
            best = without_pair
            continue
        key = min(unsupported, key=lambda one: odds[one])
        best = _best_without(all_sets, space, best, key)


def _merge_steps(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """Replace two steps by one vector over an interval unless further steps are well supported.

    Each step more has to be worth what an effect has to be.
    """
    required = priors.ODDS_REAL if all_sets.is_real(best.names) else priors.NAME_ODDS
    while True:
        improved = best
        for members in sets_with_merged_steps(all_sets, space, best.names):
            least = improved.score - required * (len(improved.names) - len(members))
            found = all_sets.judge_above(members, best, least)
            if found is not None and found.score > least:
                improved = found
        if improved is best:
            return best
        best = improved


def _choose_step_kinds(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """Exchange each step that has a form for the most probable kind of step at its times.

    With the ordinary remainder nothing is exchanged: its laws are not exact.
    """
    if all_sets.is_real(best.names):
        return best
    while True:
        alternatives = [
            all_sets.with_member(best.names - {key}, other)
            for key in library_members(all_sets, best)
            for other in step_alternatives(all_sets, space, key)
        ]
        improved = all_sets.most_probable(best, alternatives)
        if improved is best:
            return best
        best = improved


def _is_mostly_form(all_sets: Hypotheses, best: Hypothesis, key: str) -> bool:
    """Whether a member consists mostly of its form component: then it is not the effect.

    This is so if each coefficient is below its deviation, or if the member's own columns, at any
    size, fit less than `OWN_PART` of the power of what the member and its form add.
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
    contributions = [contribution_of(all_sets, best, one)[0] for one in (key, all_sets.forms[key])]
    total = np.sum(contributions, axis=0).ravel()
    own_columns = np.asarray(own).reshape(len(total), -1)
    projection = own_columns @ np.linalg.lstsq(own_columns, total)[0]
    return bool(projection @ projection < priors.OWN_PART * (total @ total))


def _drop_unsupported_pair(
    all_sets: Hypotheses, space: Space, best: Hypothesis, required: Mapping[str, float]
) -> Hypothesis:
    """Remove two effects that are not worth what both require together.

    Each may be certain given the other: steps of the field and of the iron at one time cancel, and
    two effects that share an unknown source fit it together.  So both are left out at once, with
    nothing or one free process in time in their place.
    """
    effects = [key for key in sorted(required) if all_sets.component(key).effect is not None]
    for first, last in itertools.combinations(effects, 2):
        least = best.score - required[first] - required[last]
        reduced = all_sets.without_member(all_sets.without_member(best.names, first), last)
        processes = [one for one in space.courses if one not in reduced]
        for members in (reduced, *(reduced | {one} for one in processes)):
            found = all_sets.judge_above(members, best, least)
            if found is not None and found.score > least:
                return found
    return best


def _try_single_remainder_part(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """Replace the ordinary remainder by a single part of it, if that is more probable.

    If one part alone is there, far above the others, it is not what a recording ordinarily leaves.
    """
    remainder = frozenset(all_sets.remainder)
    if all_sets.real or not remainder & best.names or not space.courses:
        return best
    parts = single_remainder_parts(all_sets.component(key) for key in all_sets.remainder)
    all_sets.made.add(parts)
    without_remainder = best.names - remainder
    return all_sets.most_probable(best, [without_remainder | {one.key} for one in parts])


def _try_field_by_heading(all_sets: Hypotheses, space: Space, best: Hypothesis) -> Hypothesis:
    """Add a field by heading, if that is more probable and nothing else is unknown.

    It is not tested in a real recording: on a walk in a circle, the heading is the place.
    """
    unknown = any(all_sets.component(key).row is None for key in best.names)
    if unknown or all_sets.real or not space.courses:
        return best
    heading = field_by_heading(all_sets.made.context)
    all_sets.made.add([heading])
    return all_sets.most_probable(best, [best.names | {heading.key}])


def _test_against_alternatives(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """Remove effects that other laws of an unknown source replace; unchanged if all effects remain.

    Noise of any colour fits a quick source as well, so such a source is reported only if it
    replaces an effect.
    """
    if not library_members(all_sets, best) or not space.courses:
        return best, rivals
    parts = single_remainder_parts(all_sets.component(key) for key in all_sets.remainder)
    alternatives = alternative_sources(all_sets.made.context)
    all_sets.made.add([*parts, *alternatives])
    extended, remainder = best, frozenset(all_sets.remainder)
    for one in (*alternatives, *parts):
        members = extended.names | {one.key}
        extended = all_sets.most_probable(
            extended, [members - remainder] if one in parts else [members, members - remainder]
        )
    if extended is best:
        return best, rivals
    accepted, accepted_rivals = _drop_unsupported(all_sets, space, extended)
    if set(library_members(all_sets, accepted)) >= set(library_members(all_sets, best)):
        return best, rivals
    return accepted, accepted_rivals


def _test_constant_coefficients(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """Add a free factor to each effect whose coefficient varies: it stands in for another source.

    Each effect is given one factor at most.  If that is dropped for lack of support, no factor of
    the effect is tried again.
    """
    tried_factors = set[str]()
    while True:
        required = priors.ODDS_REAL if all_sets.is_real(best.names) else priors.FORM_ODDS
        extended, made = best, all_sets.made
        for key in library_members(all_sets, best):
            effect = all_sets.component(key)
            # the phase of a quick cause is the integral of its column, and drifts with its errors
            phase_from_column = (
                effect.row is not None and effect.row.quick and "covariate" in effect.setting
            )
            if phase_from_column or not tried_factors.isdisjoint(factor_keys(key)):
                continue
            factors = coefficient_factors(
                effect, contribution_of(all_sets, best, key)[0], made.context
            )
            made.add(factors)
            for factor in factors:
                least = max(best.score + required, extended.score)
                with_factor = all_sets.judge_above(best.names | {factor.key}, best, least)
                if with_factor is None or with_factor.score <= least:
                    continue
                if float(np.exp(all_sets.psi_of(with_factor)[factor.key][0])) > priors.VARIES:
                    extended = with_factor
        if extended is best:
            return best, rivals
        tried_factors |= extended.names - best.names
        best, rivals = _drop_unsupported(all_sets, space, extended)


def _drop_parts_of_unknown_source(
    all_sets: Hypotheses, space: Space, best: Hypothesis, rivals: dict[str, Hypothesis]
) -> tuple[Hypothesis, dict[str, Hypothesis]]:
    """Remove effects that act along the one direction along which something unknown acts.

    Logged columns that vary with an unknown source each fit a part of it, along its direction, and
    leave a residual along the same.  Several such effects, or one that is less certain than the
    residual, are parts of one unknown source; a single one that is more certain leaves a residual.
    """
    odds = {key: best.score - rival.score for key, rival in rivals.items()}
    members = [key for key in odds if key != LAG and all_sets.component(key).columns.on_mag]
    effects = [key for key in members if all_sets.component(key).row is not None]
    unknown = [
        key for key in members if key not in effects and not is_ordinary(all_sets, best, key)
    ]
    contributions = {key: contribution_of(all_sets, best, key)[0] for key in (*effects, *unknown)}
    for key in sorted(unknown, key=lambda one: -odds[one]):
        direction, share = single_source_direction(
            contributions[key], np.ones(len(contributions[key]))
        )
        if share < priors.MAINLY_ONE:
            continue
        aligned = [one for one in effects if acts_along(direction, contributions[one])]
        parts = aligned if len(aligned) > 1 else [one for one in aligned if odds[one] < odds[key]]
        if parts:
            reduced = all_sets.judge(best.names - set(parts), best)
            return _drop_parts_of_unknown_source(
                all_sets, space, *_drop_unsupported(all_sets, space, reduced)
            )
    return best, rivals


def required_odds(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """Log odds from which on a member is accepted.

    If something unknown is in the set, an effect has to be the larger part: a source for which
    there is no exact law leaves a residual, and effects on either sensor fit it, such as a gyro's
    error by force where something slides by the force.  An effect by a logged column has to exceed
    what its column is worth at other times as well.
    """
    member = all_sets.component(key)
    if key == LAG:
        return priors.NAME_ODDS
    required = priors.UNKNOWN_ODDS if member.row is None else priors.NAME_ODDS
    if all_sets.is_real(best.names):
        required = priors.ODDS_REAL
    if member.row is None:
        return required
    required = max(required, priors.BESIDE_UNKNOWN * all_sets.unknown_nats)
    unknown = [
        other for other in sorted(best.names - frozenset(all_sets.remainder))
        if all_sets.component(other).row is None and not is_ordinary(all_sets, best, other)
    ]  # fmt: skip
    if not unknown:
        return required
    if "covariate" in member.setting:
        return required + _shifted_copy_nats(all_sets, best, key)
    nats = best.score - all_sets.judge(best.names - frozenset(unknown), best).score
    return max(required, priors.BESIDE_UNKNOWN * nats)


def _shifted_copy_nats(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """Log Bayes factor of the best copy of a member shifted in time, 0 at least.

    With the member itself in the model: a repeating cause resembles itself at other times.
    """
    copies = [all_sets.component(key).moved(share) for share in priors.SHIFTS]
    all_sets.made.add(copies)
    scan = candidate_scan(all_sets.made, best.keys, best.at)
    return max(0.0, *scan.log_bayes_factors([copy.key for copy in copies]).values())


def _best_without(all_sets: Hypotheses, space: Space, best: Hypothesis, key: str) -> Hypothesis:
    """The best set without a member: nothing, or a free process in time, replaces it."""
    reduced = all_sets.without_member(best.names, key)
    processes = [] if all_sets.component(key).effect is None else space.courses
    alternatives = [reduced | {process} for process in processes if process not in reduced]
    return all_sets.most_probable(all_sets.judge(reduced, best), alternatives, near=best)
