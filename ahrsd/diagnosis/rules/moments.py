"""One moment for all: what a search for one name has found is asked of the others too.

The evidence of a step falls within seconds of its onset, so between the times of the coarse grid
the right one is easily missed.  Two names that are held against each other must be so at the same
moments, and a term that is held against others as it was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.settings import WORTH_NATS, evidence_of


def as_found(
    basis: Base, candidates: Sequence[Candidate], own: Candidate | None
) -> tuple[Candidate, ...]:
    """The candidates with `own` in the setting in which it was found, where that is the better."""
    if own is None:
        return tuple(candidates)
    return tuple(_better(basis, c, own) if c.name == own.name else c for c in candidates)


def at_one_moment(basis: Base, candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The candidates, every step at the best of the moments that steps have found, best first.

    A moment costs each of them what it costs the one that found it.
    """
    found = [c for c in candidates if _is_step(c) and c.evidence > WORTH_NATS]
    out = []
    for candidate in candidates:
        best = candidate
        for other in found if _is_step(candidate) else ():
            if other.setting != candidate.setting:
                best = _better(basis, best, replace(other, effect=candidate.effect))
        out.append(best)
    return tuple(sorted(out, key=lambda c: -c.evidence))


def _is_step(candidate: Candidate) -> bool:
    return set(candidate.setting) == {"onset_s"}


def _better(basis: Base, candidate: Candidate, other: Candidate) -> Candidate:
    """The candidate in its own setting or the other's, as the evidence has it, both paid for."""
    dearer = max(candidate, other, key=lambda one: one.paid)
    evidence = evidence_of(basis, other) - dearer.paid
    if evidence <= candidate.evidence:
        return candidate
    chosen = replace(candidate, setting=other.setting, evidence=evidence)
    return replace(chosen, tried=dearer.tried, alike=dearer.alike)
