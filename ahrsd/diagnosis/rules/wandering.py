"""A gyro whose bias wanders more than an ordinary one's.

Four modes of a random walk have 95 % of its power; of a large one the rest is still far above the
noise and nothing in the library explains it.  So where the free course of the gyro's error is more
likely a random walk than values that have nothing to do with each other, and a bias that may walk
as much in the filter leaves nothing, it is that: a bias that wanders.

What it leaves hides what is beside it: iron that remembers was no more than the rest, and what then
was left showed in the sensor (a name of 324 nats).  So where the walk was
among the first names, both are asked together, whatever frame is left, and must be likelier than
the course that is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.calibration_fit.resting import ORDINARY_WALK_RAD_S_SQRT_S
from ahrsd.diagnosis.innovation_filter.evidence import log_bayes
from ahrsd.diagnosis.innovation_filter.score import score
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import locate, unknown
from ahrsd.diagnosis.rules.course_gram import course_gram
from ahrsd.diagnosis.rules.findings import shares_of
from ahrsd.diagnosis.rules.name import judge
from ahrsd.diagnosis.rules.regression import candidate_gram, columns_of
from ahrsd.diagnosis.rules.search import (
    FRAME_LEAD,
    STEPS,
    WANDERING,
    State,
    formed_basis_of,
    refitted,
    settled,
    survey,
    without_term,
)
from ahrsd.diagnosis.rules.selection import likelihood, noise_in
from ahrsd.diagnosis.rules.sought import Sought, sought
from ahrsd.diagnosis.rules.stand_ins import LEAST_SHARE, end_where_they_began

NAME = "gyro_bias_drift"
#: no gyro's bias wanders by more: a degree per second in five minutes
LARGEST_WALK_RAD_S_SQRT_S = 1e-3
#: of that size, which are tried
FACTORS = (1.0, 2.0)
#: nats by which a jump and one back must be likelier than a walk: eight numbers at about four each
THERE_AND_BACK = 32.0
#: nats that the walk's size costs, one of 25 that are tried
SIZE_NATS = 3.2


def wandering(found: Sought) -> Sought:
    """What was found with the name where it is that, else as it was.

    A bias that wanders hides what is small beside it: everything is sought once more beside it.
    """
    state, left, limits = found.state, found.left, found.state.problem.limits
    clear = _of_the_gyro(left) and not _named(state)
    if not _asked(found):
        return found
    size = max(_size(left, limits), _size(_without_the_walk(found.before), limits))
    if size < ORDINARY_WALK_RAD_S_SQRT_S and state.walk:
        size = _size(_with_a_bias_that_stays(state), limits)
    if not ORDINARY_WALK_RAD_S_SQRT_S <= size <= LARGEST_WALK_RAD_S_SQRT_S:
        return found
    for factor in FACTORS:
        wider = settled(refitted(replace(state, walk=factor * size), ()))
        if went_and_came(found.before, wider):
            return found
        beside = sought(wider)
        if unknown.detected(beside.left, limits) or _named(beside.state):
            continue
        if clear or _likelier(beside.state, found):
            named = _with_its_name(beside)
            return found if named is None else replace(named, first=found.first)
    return found


def _asked(found: Sought) -> bool:
    """Whether a wider walk may be what was found, or what was left.

    Beside few modes of a walk that was named, other names may follow what they leave of it.
    """
    state = found.state
    if NAME in state.names:
        return len(state.named) > 1
    if _named(state) or not unknown.detected(found.left, state.problem.limits):
        return False
    return _of_the_gyro(found.left) or NAME in found.before.names


def _of_the_gyro(left: unknown.Remainder) -> bool:
    """Whether what is left is surely an error of the gyro."""
    others = [one.evidence for frame, one in left.located.items() if frame != "gyro"]
    return left.located["gyro"].evidence > max(others) + FRAME_LEAD


def _likelier(beside: State, found: Sought) -> bool:
    """Whether a walk and names beside it are likelier than those found and the course they leave.

    In the noise that the course's own evidence is in, and as surely as a name must be ahead.
    """
    gained, left = likelihood(beside) - likelihood(found.state), found.left
    limits = beside.problem.limits
    bound = left.strongest.evidence if unknown.detected(left, limits) else 0.0
    return bool(beside.named) and gained / left.basis.colour > bound + limits.lead_nats


def _with_its_name(found: Sought) -> Sought | None:
    """The bias that wanders in the filter named, as it is judged where it wanders less.

    None where another name is likelier there.  Of a walk the few modes of the name explain a part:
    it has the nats by which the wider walk in the filter is likelier, if those are more, in the
    noise that the evidence is in.
    """
    names = found.state.named
    ordinary = refitted(replace(found.state, walk=ORDINARY_WALK_RAD_S_SQRT_S), names)
    seen = survey(ordinary)
    mine = next(c for c in seen.candidates if c.name == NAME)
    columns = columns_of(seen.basis, [mine])
    gram = candidate_gram(seen.basis, columns, found.state.problem.block_s)
    judged = judge(
        mine, gram, columns[NAME], seen.basis, len(seen.candidates), found.state.problem.limits
    )
    wider = (likelihood(found.state) - likelihood(ordinary)) / noise_in(seen) - SIZE_NATS
    judged = replace(judged, evidence=max(judged.evidence, wider))
    state = refitted(found.state, (*names, judged))
    if shares_of(state, len(names), seen, found.last)[NAME] <= LEAST_SHARE:
        return None
    return replace(found, state=state, surveys=[*found.surveys, seen])


def went_and_came(before: State, walking: State) -> bool:
    """Whether the bias jumped and jumped back, which has no name, rather than walked.

    before: with the steps that were found and taken out again
    """
    steps = [before.fit.terms[k].value for k, n in enumerate(before.names) if n == STEPS["gyro"]]
    back = len(steps) > 1 and end_where_they_began(steps)
    return back and likelihood(before) > likelihood(walking) + THERE_AND_BACK


def _named(state: State) -> bool:
    return any(name in WANDERING for name in state.names)


def _without_the_walk(state: State) -> unknown.Remainder | None:
    """What the names leave with the walk's first modes put back, where it was named.

    Other names beside it may have been taken out again for what is left of it.
    """
    if NAME not in state.names:
        return None
    k = state.names.index(NAME)
    return unknown.remainder(without_term(state, k), with_bins=False)


def _with_a_bias_that_stays(state: State) -> unknown.Remainder:
    """What the names leave where the bias does not wander: of a walk the filter follows a part."""
    still = refitted(replace(state, walk=0.0), state.named)
    return unknown.remainder(formed_basis_of(still), with_bins=False)


def _size(left: unknown.Remainder | None, limits: Limits) -> float:
    """Size of the walk that the gyro's course is, rad/s per root second; 0 where it is none."""
    if left is None:
        return 0.0
    nats, size = _walks(left)
    return size if nats >= limits.lead_nats else 0.0


def _walks(left: unknown.Remainder) -> tuple[float, float]:
    """Nats by which the gyro's course is a random walk's rather than independent values.

    And the walk's size, rad/s per root second, that is the likeliest.
    """
    gyro, basis = left.located["gyro"], left.basis
    name, unit = locate.group_name("gyro"), locate.UNITS["gyro"]
    gram = course_gram(basis, "gyro", gyro.cut)
    columns = gram.groups[name]
    G, s = gram.total[columns, columns], gram.total[columns, -1]
    what = score(gram, name, np.full(len(s), unit), 1e-3)
    walk = locate.log_bayes_walk(G, s, 3, np.asarray(locate.SPAN) * unit, basis.colour)
    sizes = unit * np.geomspace(locate.SPAN[0], locate.SPAN[-1], 25)
    likely = max(
        sizes, key=lambda size: locate.log_bayes_walk(G, s, 3, np.array([size]), basis.colour)
    )
    # a walk's mean square distance from its own mean is a sixth of its variance at the end
    whole_s = float(gyro.cut.edges_s[-1] - gyro.cut.edges_s[0])
    root = float(np.sqrt(6.0 / whole_s))
    return float(walk - log_bayes(what, basis.colour, locate.SPAN)), float(likely) * root
