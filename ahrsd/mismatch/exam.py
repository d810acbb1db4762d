"""Names held against what the whole model leaves, which on a real recording is never nothing."""

from __future__ import annotations

import numpy as np

from ahrsd.mismatch.discrepancy import Discrepancy, beyond, discrepancy
from ahrsd.mismatch.regression import Base
from ahrsd.mismatch.search import STEPS, State, basis_of, refitted, term_group, without_term
from ahrsd.samples import Array

#: steps that cancel to this share are one thing that was put on and taken off again
CANCELS = 0.25


def examined(state: State) -> State:
    """The state without the names that are no more than what the model leaves anyway.

    One at a time, the weakest first, everything else fitted anew after each.
    """
    limits = state.problem.limits
    while state.named:
        basis = basis_of(state)
        found = discrepancy(basis)
        if found.nats < limits.unknown_nats:
            break
        worth = [_worth(state, basis, found, k) for k in range(len(state.named))]
        weakest = int(np.argmin(worth))
        if worth[weakest] > limits.beyond_nats:
            break
        kept = tuple(judged for k, judged in enumerate(state.named) if k != weakest)
        state = refitted(state, kept)
    return state


def _worth(state: State, basis: Base, found: Discrepancy, number: int) -> float:
    """Nats by which a name, with its counterpart if it has one, is more than what is left."""
    judged = state.named[number]
    bounds = np.array([parameter.bound for parameter in judged.candidate.effect.parameters])
    if np.any(np.abs(state.fit.terms[number].value) > bounds):
        return -np.inf
    left, columns = without_term(state, number, basis), _columns(basis, number)
    scale = judged.candidate.scale
    other = counterpart(state, number)
    if other is not None:
        left = left.without(term_group(other), state.fit.terms[other].value)
        columns = np.concatenate([columns, _columns(basis, other)], axis=2)
        scale = np.concatenate([scale, scale])
    return beyond(found, left, columns, scale)


def counterpart(state: State, number: int) -> int | None:
    """The step that takes back what this one brought, or the other way round."""
    name = state.names[number]
    if name not in STEPS.values():
        return None
    value = state.fit.terms[number].value
    for k, other in enumerate(state.names):
        if k != number and other == name:
            whole = np.linalg.norm(value) + np.linalg.norm(state.fit.terms[k].value)
            if 2 * np.linalg.norm(value + state.fit.terms[k].value) < CANCELS * whole:
                return k
    return None


def _columns(basis: Base, number: int) -> Array:
    return np.asarray(basis.known[:, :, basis.groups[term_group(number)]])
