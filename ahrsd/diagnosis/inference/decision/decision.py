"""From the most probable set to an answer: findings with rivals, what is unknown, what is ordinary.

An effect is a finding if every set without it is less probable by odds that follow from the losses
(`acceptance`).  What remains is unknown if a free process in time is as certain, or if a part of
the ordinary remainder exceeds its 95 %.
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
    """Findings, terms and what is unexplained of one hypothesis.

    best: the set whose members are all accepted
    keys: keys of the findings and of the terms, in their order
    unknown: keys of what is unexplained: a process, a part of the remainder, the steps of a source
    rivals: the best set without each member
    log_odds: the largest of the members' odds and the evidence of what is unexplained
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
    repeated_kinds = _repeated_step_kinds(all_sets, best)
    findings, terms, keys = [], [], []
    for key in sorted(odds, key=lambda one: -odds[one]):
        effect = all_sets.component(key).effect
        if effect is None or effect in repeated_kinds or is_ordinary(all_sets, best, key):
            continue
        finding, term = finding_and_term(all_sets, space, best, key, odds[key], library)
        findings.append(finding)
        terms.append(term)
        keys.append(key)
    drift_effects = _drift_effects(all_sets, space, best, library)
    for key, drift in drift_effects.items():
        finding, term = drift_finding(all_sets, space, best, key, odds[key], drift, library)
        findings.append(finding)
        terms.append(term)
        keys.append(key)
    if (misalignment := _misalignment_effect(all_sets, best, library)) is not None:
        reduced = all_sets.judge(best.names - {GYRO_MATRIX}, best)
        rivals = {**rivals, GYRO_MATRIX: reduced}
        finding, term = misalignment_finding(
            all_sets, best, best.score - reduced.score, misalignment, library
        )
        findings.append(finding)
        terms.append(term)
        keys.append(GYRO_MATRIX)
    unknown, unexplained = largest_unexplained(
        all_sets, space, best, {k: v for k, v in odds.items() if k not in drift_effects}
    )
    if repeated_kinds and not unexplained.detected:
        unknown, unexplained = changing_source(all_sets, best, repeated_kinds[0], odds)
    largest_nats = max([*odds.values(), unexplained.evidence_nats], default=0.0)
    results = tuple(findings), tuple(terms), unexplained, largest_nats
    return Answer(best, tuple(keys), unknown, rivals, *results)


def _drift_effects(
    all_sets: Hypotheses, space: Space, best: Hypothesis, library: Mapping[str, Effect]
) -> dict[str, Effect]:
    """Free processes as slow as the library's drift in their frame, by key, whatever their form."""
    present = {all_sets.component(key).effect for key in best.names}
    drifts = {}
    for key in space.courses:
        if key not in best.names or is_ordinary(all_sets, best, key):
            continue
        frame, corner = all_sets.component(key).frame, float(np.exp(all_sets.psi_of(best)[key][1]))
        rows = [
            one for identifier, one in library.items() if one.course and identifier not in present
        ]
        rows = [one for one in rows if (one.frame or one.family) == frame]
        if rows and corner < priors.DRIFT_CORNER:
            drifts[key] = rows[0]
    return drifts


def _misalignment_effect(
    all_sets: Hypotheses, best: Hypothesis, library: Mapping[str, Effect]
) -> Effect | None:
    """The library's turn between the sensors, if the gyro's matrix has more of it than is ordinary.

    That matrix is a part of the ordinary remainder.
    """
    present = {all_sets.component(key).effect for key in best.names}
    rows = [
        one
        for identifier, one in library.items()
        if one.turns_sensors and identifier not in present
    ]
    if not rows or GYRO_MATRIX not in best.names:
        return None
    turn, deviation = (part[TURNS] for part in coefficients(all_sets, best, GYRO_MATRIX))
    least_turn_rad = float(np.linalg.norm(turn)) - 2.0 * float(np.linalg.norm(deviation))
    return rows[0] if least_turn_rad > priors.CROOKED * priors.ORDINARY_MISALIGNMENT_RAD else None


def _repeated_step_kinds(all_sets: Hypotheses, best: Hypothesis) -> list[str]:
    """Kinds of steps with so many members that they are one source that changes, most first.

    Steps of ordinary size count as well.
    """
    members = [all_sets.component(key) for key in sorted(best.names)]
    kinds = sorted(one.effect for one in members if one.effect is not None and one.jumps)
    repeated = [k for k in dict.fromkeys(kinds) if kinds.count(k) >= priors.CHANGES]
    return sorted(repeated, key=kinds.count, reverse=True)
