"""Three steps along one line are the levels of one source that nobody logged.

A payload that is put on jumps once, and back when it is taken off.  A current without a column that
holds a few levels is as many steps of the hard iron, each with all that a name needs, but all of
them point the same way: that is one source fixed to the vehicle, which has no name.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import framed
from ahrsd.diagnosis.rules.search import STEPS, State, Survey, formed_basis_of
from ahrsd.diagnosis.rules.stand_ins import dropped

#: steps of one name that are looked at, and the share of their squares along one line
FEWEST, ALONG = 3, 0.95


def without_levels(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such steps, where an unknown is left instead; else as it was."""
    levels = [k for name in STEPS.values() for k in _levels(state, name)]
    if not levels:
        return state, surveys, left
    slim, others, rest = dropped(state, surveys, levels, left)
    rest = framed(formed_basis_of(slim), rest, state.problem.limits)
    if not unknown.detected(rest, state.problem.limits):
        return state, surveys, left
    return slim, others, rest


def _levels(state: State, name: str) -> list[int]:
    """Numbers of the steps of a name that are all along one line; none where there are few."""
    steps = [k for k, named in enumerate(state.names) if named == name]
    if len(steps) < FEWEST:
        return []
    sizes = np.array([state.fit.terms[k].value for k in steps])
    squares = np.linalg.svd(sizes, compute_uv=False) ** 2
    return steps if squares[0] > ALONG * squares.sum() else []
