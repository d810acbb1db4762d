"""Names held against every other name for what they explain, and the surveys without each.

What turns the field by degrees is not linear: a gyro whose axes are askew by two degrees had 216
nats by its columns at the null, a mount that gives 236, and by the joint fits 29 more than that.
So the joint fit is asked of names that are nearly as likely, too.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.search import (
    State,
    Survey,
    counterpart,
    in_its_place,
    refitted,
    shaped_again,
    survey,
    without_term,
)
from ahrsd.diagnosis.rules.selection import ahead

_NEAR = 0.1  # part of a name's evidence by which another's may be less and the joint fit is asked


def swapped(state: State, last: Survey) -> tuple[State, list[Survey], Survey]:
    """The state with each term that explains less than another name replaced by that one.

    The new one is fitted in its place.  Surveys without each term;  last: the survey of the state,
    renewed if need be.
    """
    surveys: list[Survey] = []
    for k in range(len(state.named)):
        name = state.named[k].candidate.name
        seen, mine = _without(state, k, last.basis)
        rivals = [
            (in_its_place(j.candidate, last), j)
            for j in seen.judged
            if j.accepted and j.candidate.name != name
        ]
        rivals = [(nats, j) for nats, j in rivals if nats > mine or _near(nats, mine, j)]
        if rivals and name not in DELAYS and counterpart(state, k) is None:
            most, best = max(rivals, key=lambda one: one[0])
            lead = 0.0 if most > mine else state.problem.limits.lead_nats
            tried = _replaced(state, k, best, seen, lead)
            if tried is not state:
                state, last = tried, survey(tried)
                seen, _ = _without(state, k, last.basis)
        surveys.append(seen)
    return state, surveys, last


def _near(nats: float, mine: float, judged: Judged) -> bool:
    """Whether a name explains nearly as much, and the joint fit with it can be compared.

    A delay's cannot: it is that of another track.
    """
    return judged.candidate.name not in DELAYS and nats > (1.0 - _NEAR) * mine


def _replaced(state: State, number: int, judged: Judged, seen: Survey, lead: float = 0.0) -> State:
    """The state with a name in another one's place; as it was where the joint fit is worse with it.

    Evidence is of columns at a fit that another name has bent: it proposes, and the joint fit with
    the other name in its best shape decides.
    seen: the survey without the term;  lead: nats by which it must be better
    """
    named = list(state.named)
    mine = next((j for j in seen.judged if j.candidate.name == state.names[number]), named[number])
    named[number] = judged
    tried = refitted(state, tuple(named))
    if judged.candidate.name in DELAYS:
        return tried  # another track: its likelihood is another one's
    tried = shaped_again(tried, newest=True)
    return tried if ahead((tried, judged), (state, mine), seen) > lead else state


def _without(state: State, number: int, basis: Base) -> tuple[Survey, float]:
    """The survey without one term of the state's basis, and the term's own evidence in it."""
    left = without_term(state, number, basis)
    others = tuple(j for i, j in enumerate(state.named) if i != number)
    own = state.named[number].candidate
    seen, name = survey(replace(state, named=others), left, own), own.name
    return seen, max((c.evidence for c in seen.candidates if c.name == name), default=0.0)
