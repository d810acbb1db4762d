"""All names of one state: named one after the other, pruned, examined, swapped, held to their form.

forward -> prune -> without imitators -> examine -> swap -> twins -> stand-ins;
the same again beside a bias that wanders.
"""

from __future__ import annotations

from dataclasses import dataclass

from ahrsd.diagnosis.rules.exam import examined, paired, pruned
from ahrsd.diagnosis.rules.imitators import without_imitators
from ahrsd.diagnosis.rules.nested import eddies_alone
from ahrsd.diagnosis.rules.often import logged_often
from ahrsd.diagnosis.rules.search import State, Survey, survey
from ahrsd.diagnosis.rules.selection import forward
from ahrsd.diagnosis.rules.stand_ins import IN_TIME, without_stand_ins, without_unlikely
from ahrsd.diagnosis.rules.swapping import swapped
from ahrsd.diagnosis.rules.twins import told_apart
from ahrsd.diagnosis.rules.unknown import Remainder


@dataclass(frozen=True, slots=True, eq=False)
class Sought:
    """The state with all names, the surveys without each of them, what is left.

    first, last: the surveys before and after the names
    before: the state before any name was taken out again
    stood_in: names by a logged cause that were taken out since they only stood in for another form,
              but for causes that change often
    hidden: whether names were taken out that were worth no more than what they leave
    """

    state: State
    surveys: list[Survey]
    first: Survey
    last: Survey
    left: Remainder
    before: State
    stood_in: frozenset[str] = frozenset()
    hidden: bool = False


def sought(state: State) -> Sought:
    """Every name that the state's fit allows beside what it has."""
    more, first, last = forward(state)
    given = paired(without_imitators(pruned(more)))
    slim, beside = examined(given)
    hidden = len(slim.named) < len(given.named)
    slim = eddies_alone(slim)
    last = last if slim.names == more.names else survey(slim)
    named, surveys, last = without_unlikely(*told_apart(*swapped(slim, last)))
    true, surveys, left = without_stand_ins(named, surveys, beside)
    # what changes often is asked again: no slow thing of another form goes with it
    logged = (
        j.candidate.name
        for j in named.named
        if "covariate" in j.candidate.setting and not logged_often(state.problem.track, j.candidate)
    )
    # a course in time is held against a free one, which explains what is left with it
    stood_in = frozenset(logged) - IN_TIME - frozenset(true.names)
    return Sought(true, surveys, first, last, left, more, stood_in, hidden)
