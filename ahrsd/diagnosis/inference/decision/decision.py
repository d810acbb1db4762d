"""From the likeliest set to an answer: names with their rivals, what is left, what is ordinary.

A name is told where every set without it is less likely by odds that the losses ask for
(`acceptance`).  What is left is unknown where a free course is as sure, or where a part of the
ordinary remainder is beyond its 95 %.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Finding, Unexplained
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.components.ordinary_remainder import GYRO_MATRIX, TURNS
from ahrsd.diagnosis.inference.decision.acceptance import accept_members
from ahrsd.diagnosis.inference.decision.findings import (
    drift_finding,
    finding_and_term,
    misalignment_finding,
)
from ahrsd.diagnosis.inference.decision.members import coefficients, is_ordinary
from ahrsd.diagnosis.inference.decision.unexplained import changing_source, largest_unexplained
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis, Space
from ahrsd.diagnosis.model import Term


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


def decide(
    all_sets: Hypotheses, space: Space, best: Hypothesis, library: Mapping[str, Effect]
) -> Answer:
    """The answer of a search."""
    best, rivals = accept_members(all_sets, space, best)
    odds = {key: best.score - rival.score for key, rival in rivals.items()}
    switching = _repeated_step_kinds(all_sets, best)
    found, terms, keys = [], [], []
    for key in sorted(odds, key=lambda one: -odds[one]):
        effect = all_sets.component(key).effect
        if effect is None or effect in switching or is_ordinary(all_sets, best, key):
            continue
        finding, term = finding_and_term(all_sets, space, best, key, odds[key], library)
        found.append(finding)
        terms.append(term)
        keys.append(key)
    drifts = _drift_effects(all_sets, space, best, library)
    for key, row in drifts.items():
        finding, term = drift_finding(all_sets, space, best, key, odds[key], row, library)
        found.append(finding)
        terms.append(term)
        keys.append(key)
    if (turned := _misalignment_effect(all_sets, best, library)) is not None:
        straight = all_sets.judge(best.names - {GYRO_MATRIX}, best)
        rivals = {**rivals, GYRO_MATRIX: straight}
        finding, term = misalignment_finding(
            all_sets, best, best.score - straight.score, turned, library
        )
        found.append(finding)
        terms.append(term)
        keys.append(GYRO_MATRIX)
    unknown, left = largest_unexplained(
        all_sets, space, best, {k: v for k, v in odds.items() if k not in drifts}
    )
    if switching and not left.detected:
        unknown, left = changing_source(all_sets, best, switching[0], odds)
    surest = max([*odds.values(), left.evidence_nats], default=0.0)
    told = tuple(found), tuple(terms), left, surest
    return Answer(best, tuple(keys), unknown, rivals, *told)


def _drift_effects(
    all_sets: Hypotheses, space: Space, best: Hypothesis, library: Mapping[str, Effect]
) -> dict[str, Effect]:
    """Free courses that are as slow as the library's drift of their frame, whatever their form."""
    named = {all_sets.component(key).effect for key in best.names}
    out = {}
    for key in space.courses:
        if key not in best.names or is_ordinary(all_sets, best, key):
            continue
        frame, corner = all_sets.component(key).frame, float(np.exp(all_sets.psi_of(best)[key][1]))
        rows = [one for name, one in library.items() if one.course and name not in named]
        rows = [one for one in rows if (one.frame or one.family) == frame]
        if rows and corner < priors.DRIFT_CORNER:
            out[key] = rows[0]
    return out


def _misalignment_effect(
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


def _repeated_step_kinds(all_sets: Hypotheses, best: Hypothesis) -> list[str]:
    """Kinds of steps of which there are so many that they are one source that changes, most first.

    Those that are ordinary count as well.
    """
    members = [all_sets.component(key) for key in sorted(best.names)]
    kinds = sorted(one.effect for one in members if one.effect is not None and one.jumps)
    many = [k for k in dict.fromkeys(kinds) if kinds.count(k) >= priors.CHANGES]
    return sorted(many, key=kinds.count, reverse=True)
