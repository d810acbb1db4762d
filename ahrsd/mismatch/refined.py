"""What is left when every name is in, told of what it may be besides a course in time.

The same look is taken twice: beside the names, which leave something of their own forms, and where
nothing at all was found with limits that ask for less.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.mismatch import unknown
from ahrsd.mismatch.diagnosis import Unexplained
from ahrsd.mismatch.forms import with_forms
from ahrsd.mismatch.limits import Limits
from ahrsd.mismatch.loudness import beside_bursts, in_even_noise
from ahrsd.mismatch.null import NullFit
from ahrsd.mismatch.own_form import free_price_of, price_of
from ahrsd.mismatch.search import (
    ORDINARY_WALK_RAD_S_SQRT_S,
    State,
    at_rest,
    formed_basis_of,
    refitted,
)
from ahrsd.mismatch.slow_noise import in_its_noise
from ahrsd.mismatch.spells import with_spells
from ahrsd.mismatch.unknown import Remainder


def refined(
    start: NullFit, state: State, left: Remainder, short: Unexplained | None, limits: Limits
) -> Remainder:
    """What is left, in its own noise, beyond what names leave of their forms, by its own form.

    short: bursts, where they are what is left
    """
    left = in_its_noise(formed_basis_of(state), with_spells(left), limits)
    left = in_even_noise(formed_basis_of(state), left, limits)
    left = beside_bursts(state, left, limits)
    left = unknown.beside_names(left, price_of(state), limits)
    if short is None and not at_rest(start):
        left = with_forms(left, free_price_of(state), limits)
    return left


def left_alone(
    start: NullFit, state: State, left: Remainder
) -> tuple[State, Remainder, Remainder | None]:
    """What is left where nothing is named, by the limits of that: the last one, None for nothing.

    state: without names.  A course of the gyro's bias is nothing where an ordinary one's walk does
    as well: the state with that, and what it leaves.
    """
    limits = state.problem.limits.alone()
    seen = left
    if not unknown.detected(left, state.problem.limits):
        seen = refined(start, state, left, None, limits)
    if not unknown.detected(seen, limits):
        return state, left, None
    if seen.strongest.frame != "gyro" or seen.stood_in is not None or state.walk:
        return state, left, seen
    walking = refitted(replace(state, walk=ORDINARY_WALK_RAD_S_SQRT_S), ())
    rest = unknown.remainder(formed_basis_of(walking), with_bins=bool(left.bins))
    rest = refined(start, walking, rest, None, limits)
    return (state, left, seen) if unknown.detected(rest, limits) else (walking, rest, None)
