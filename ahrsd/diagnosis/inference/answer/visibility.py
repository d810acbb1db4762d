"""What a recording says about each single effect of the library, given a set.

Each effect is taken in its most probable setting: its log Bayes factor, averaged over sizes, and
the smallest coefficients that would have been detected in this noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Limit
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Names, Space
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class EffectEvidence:
    """One effect: its log Bayes factor, and information (p, p) on its coefficients."""

    row: Effect
    nats: float
    information: Array


def effect_evidence(all_sets: Hypotheses, space: Space, names: Names) -> list[EffectEvidence]:
    """Every effect that can be tested, each in its most probable setting, given a set."""
    base = all_sets.judge(names)
    scan = candidate_scan(all_sets.made, base.keys, base.at)
    candidates = {
        name: [key for key in keys if key not in base.names] for name, keys in space.effects.items()
    }
    if not any(candidates.values()):
        return []
    log_bayes_factors = scan.log_bayes_factors(
        [key for keys in candidates.values() for key in keys]
    )
    best = [
        max(keys, key=lambda key: log_bayes_factors[key]) for keys in candidates.values() if keys
    ]
    C, own, _ = all_sets.made.candidate_products(base.keys, best, scan.inverse)
    W = scan.project(C)
    out, begin = [], 0
    for key, square in zip(best, own, strict=True):
        mine = slice(begin, begin + len(square))
        begin = mine.stop
        row = all_sets.component(key).row
        if row is not None:
            out.append(
                EffectEvidence(row, log_bayes_factors[key], square - W[:, mine].T @ W[:, mine])
            )
    return out


def limits(found: Sequence[EffectEvidence]) -> tuple[Limit, ...]:
    """The smallest detectable value of every parameter; None if the motion does not show it."""
    out = []
    for one in found:
        scale = np.array([parameter.scale for parameter in one.row.parameters])
        smallest, hidden = _smallest_detectable(one, scale)
        for k, parameter in enumerate(one.row.parameters):
            value = None if hidden[k] else float(smallest[k])
            out.append(Limit(one.row.identifier, parameter.name, value, parameter.unit))
    return tuple(out)


def _smallest_detectable(one: EffectEvidence, scale: Array) -> tuple[Array, NDArray[np.bool]]:
    """(p,) smallest detectable values, and which lie mostly in directions that the motion hides."""
    G = one.information * scale * scale[:, None]
    values, vectors = np.linalg.eigh((G + G.T) / 2)
    shown = values > one.row.least_information
    deviation = np.sqrt(np.sum(vectors[:, shown] ** 2 / values[shown], axis=1))
    hidden = np.sum(vectors[:, shown] ** 2, axis=1) < 0.5
    return priors.SHOWN_AT * scale * deviation, hidden
