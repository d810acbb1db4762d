"""Two names of nearly the same shape, told apart by the joint fit with either.

A device that compensates its own iron moves the hard iron along itself, by a part of it; beside
that the soft iron's part is small.  Held against the columns of a model without them, a drift in
any direction comes out ahead: the hard iron that the compensation goes by is still off by the mean
of what drifted, and its onset and time constant were sought on a coarse grid.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.diagnosis.rules.search import (
    State,
    Survey,
    formed_basis_of,
    refitted,
    shaped_again,
    survey,
    without_term,
)
from ahrsd.diagnosis.rules.selection import ahead

_NAMES = ("hard_iron_drift", "onboard_calibration_active")
_NEAR = 0.1  # part of a name's evidence by which its twin's may be less and the joint fit is asked


def told_apart(
    state: State, surveys: list[Survey], last: Survey
) -> tuple[State, list[Survey], Survey]:
    """The state with the likelier of two twins in each place; surveys without each term, and last.

    In the surveys the other is as much less likely as the joint fits say.
    """
    surveys = list(surveys)
    for k in range(len(state.named)):
        found = _likelier(state, k, surveys[k])
        if found is None:
            continue
        likelier, nats = found
        if likelier is not state:
            own = likelier.named[k].candidate
            others = tuple(one for i, one in enumerate(likelier.named) if i != k)
            left = without_term(likelier, k, formed_basis_of(likelier))
            surveys[k] = survey(replace(likelier, named=others), left, own)
            state, last = likelier, survey(likelier)
        surveys[k] = _behind(surveys[k], state.names[k], nats)
    return state, surveys, last


def _likelier(state: State, number: int, seen: Survey) -> tuple[State, float] | None:
    """The state with a term or with its twin, each in its best shape, and by how many nats.

    None where it has no twin that may be said.  Coefficients are paid for as in the survey without
    the term, `seen`.
    """
    name = state.names[number]
    judged = {one.candidate.name: one for one in seen.judged}
    if name not in _NAMES or any(one not in judged for one in _NAMES):
        return None
    mine = judged[name]
    its = judged[next(one for one in _NAMES if one != name)]
    if not its.accepted or its.evidence < (1.0 - _NEAR) * mine.evidence:
        return None
    named = list(state.named)
    named[number] = its
    here = shaped_again(state, newest=True)
    there = shaped_again(refitted(state, tuple(named)), newest=True)
    more = ahead((there, its), (here, mine), seen)
    return (there if more > 0.0 else here), abs(more)


def _behind(seen: Survey, name: str, nats: float) -> Survey:
    """The survey with the twin of a name so many nats behind it."""
    mine = max((one.evidence for one in seen.candidates if one.name == name), default=0.0)
    candidates = (
        replace(one, evidence=mine - nats) if one.name in _NAMES and one.name != name else one
        for one in seen.candidates
    )
    return replace(seen, candidates=tuple(sorted(candidates, key=lambda one: -one.evidence)))
