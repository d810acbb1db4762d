"""A gyro whose bias wanders more than an ordinary one's.

Four modes of a random walk have 95 % of its power; of a large one the rest is still far above the
noise and nothing in the library explains it.  So where the free course of the gyro's error is more
likely a random walk than values that have nothing to do with each other, and a bias that may walk
as much in the filter leaves nothing, it is that: a bias that wanders.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.mismatch import locate, unknown
from ahrsd.mismatch.evidence import log_bayes, log_bayes_walk
from ahrsd.mismatch.null import fit_null
from ahrsd.mismatch.regression import group_gram
from ahrsd.mismatch.score import score
from ahrsd.mismatch.search import (
    FRAME_LEAD,
    ORDINARY_WALK_RAD_S_SQRT_S,
    WANDERING,
    State,
    Survey,
    fitted_term,
    formed_basis_of,
    survey,
)

NAME = "gyro_bias_drift"
#: of that size, which are tried
FACTORS = (1.0, 2.0)


def wandering(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state with the name where it is that, else as it was."""
    problem, gyro = state.problem, left.located["gyro"]
    others = [one.evidence for frame, one in left.located.items() if frame != "gyro"]
    clear = gyro.evidence > max(others) + FRAME_LEAD
    if not clear or not unknown.detected(left, problem.limits) or _named(state):
        return state, surveys, left
    nats, size = _walks(left)
    if size < ORDINARY_WALK_RAD_S_SQRT_S or nats < problem.limits.lead_nats:
        return state, surveys, left
    seen = survey(state)
    mine = next((j for j in seen.judged if j.candidate.name == NAME), None)
    if mine is None:
        return state, surveys, left
    terms = (*state.fit.terms, fitted_term(mine.candidate, mine.what.value))
    for factor in FACTORS:
        start = replace(state.fit.model, gyro_walk_rad_s_sqrt_s=factor * size)
        fit = fit_null(problem.track, problem.spec, start, terms, noise=False)
        found = replace(state, fit=fit, named=(*state.named, mine), walk=True)
        rest = unknown.remainder(formed_basis_of(found))
        if not unknown.detected(rest, problem.limits):
            return found, [*surveys, seen], rest
    return state, surveys, left


def _named(state: State) -> bool:
    return any(name in WANDERING for name in state.names)


def _walks(left: unknown.Remainder) -> tuple[float, float]:
    """Nats by which the gyro's course is a random walk's rather than independent values.

    And the walk's size, rad/s per root second, that is the likeliest.
    """
    gyro, basis = left.located["gyro"], left.basis
    name, unit = locate.group_name("gyro"), locate.UNITS["gyro"]
    gram = group_gram(basis, {name: locate.frame_columns(basis.context, "gyro", gyro.cut)})
    columns = gram.groups[name]
    G, s = gram.total[columns, columns], gram.total[columns, -1]
    what = score(gram, name, np.full(len(s), unit), 1e-3)
    walk = log_bayes_walk(G, s, 3, np.asarray(locate.SPAN) * unit, basis.colour)
    sizes = unit * np.geomspace(locate.SPAN[0], locate.SPAN[-1], 25)
    likely = max(sizes, key=lambda size: log_bayes_walk(G, s, 3, np.array([size]), basis.colour))
    # a walk's mean square distance from its own mean is a sixth of its variance at the end
    whole_s = float(gyro.cut.edges_s[-1] - gyro.cut.edges_s[0])
    root = float(np.sqrt(6.0 / whole_s))
    return float(walk - log_bayes(what, basis.colour, locate.SPAN)), float(likely) * root
