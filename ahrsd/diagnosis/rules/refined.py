"""What is left when every name is in, told of what it may be besides a course in time.

The same look is taken twice: beside the names, which leave something of their own forms, and where
nothing at all was found with limits that ask for less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Unexplained
from ahrsd.diagnosis.calibration_fit.descent import NullFit
from ahrsd.diagnosis.calibration_fit.resting import ORDINARY_WALK_RAD_S_SQRT_S, at_rest
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import slowness
from ahrsd.diagnosis.rules.discrepancy import UNIT_GAUSS
from ahrsd.diagnosis.rules.forms import with_forms
from ahrsd.diagnosis.rules.loudness import beside_bursts, in_even_noise
from ahrsd.diagnosis.rules.one_course import smooth_nats
from ahrsd.diagnosis.rules.one_source import (
    ANY_NATS,
    NATS,
    with_any_course,
    with_course,
    with_one_source,
)
from ahrsd.diagnosis.rules.own_form import free_price_of, price_of
from ahrsd.diagnosis.rules.random_effect import effect_nats
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.search import State, formed_basis_of, refitted
from ahrsd.diagnosis.rules.slow_noise import in_its_noise
from ahrsd.diagnosis.rules.spells import with_spells
from ahrsd.diagnosis.rules.unknown import Remainder
from ahrsd.diagnosis.where_and_when.by_heading import heading_columns

#: colour of white noise: 1, and the scatter of its spectrum; a twentieth of its power that forgets
#: within a second has 1.2
WHITE = 1.15
#: correlation with itself a second later that no noise has which forgets within two seconds
STEADY = float(np.exp(-1 / 2))
#: what a smooth course needs where nothing else is: odds of 1000 to 1, and of a million to 1 where
#: noise has a colour, which is more of it at long periods than at those that tell the colour
SMOOTH_NATS, OF_COLOUR = NATS, 2.0
#: what a course that is there needs beside a gyro that may wander: odds of 10 to 1
STILL_NATS = float(np.log(10.0))


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
    as well: the state with that, and what it leaves.  So is a quick course.
    """
    limits = state.problem.limits.alone()
    seen = left
    if not unknown.detected(left, state.problem.limits):
        seen = refined(start, state, left, None, limits)
    slow = unknown.detected(seen, limits)
    if not slow:
        seen = _of_any_course(state, seen)
    if not unknown.detected(seen, limits):
        return state, left, None
    field = seen.strongest.frame != "gyro" or seen.stood_in is not None
    if (slow and field) or state.walk:
        return state, left, seen
    walking = refitted(replace(state, walk=ORDINARY_WALK_RAD_S_SQRT_S), ())
    rest = unknown.remainder(formed_basis_of(walking), with_bins=bool(left.bins))
    rest = refined(start, walking, with_one_source(rest), None, limits)
    still = unknown.detected(_of_any_course(walking, rest, STILL_NATS, STILL_NATS), limits)
    return (state, left, seen) if still else (walking, rest, None)


def heading_nats(basis: Base) -> float:
    """Evidence of a field by the heading (`by_heading`), nats, in noise of the basis's colour."""
    seen = basis.whitened([heading_columns(basis.context)])[0]
    return effect_nats(basis, seen * UNIT_GAUSS)


def _of_any_course(
    state: State, left: Remainder, least: float = ANY_NATS, smooth: float = SMOOTH_NATS
) -> Remainder:
    """The remainder with a quick course where that cannot be slow noise, or with a smooth one.

    A smooth one, in time or by heading, is asked in the model's noise, whose colour counts against
    it.
    """
    basis = formed_basis_of(state)
    if white(left) or slowness(basis) >= STEADY:
        told = with_any_course(left, least)
        if told is not left:
            return told
    smooth *= 1.0 if basis.colour <= WHITE else OF_COLOUR
    nats = smooth_nats(basis)
    nats["sensor"] = max(nats["sensor"], heading_nats(basis))
    frame = max(nats, key=lambda one: nats[one])
    return with_course(left, left.located[frame], nats[frame]) if nats[frame] >= smooth else left


def white(left: Remainder) -> bool:
    """Whether what is left is white noise, but for what its own course explains."""
    return left.basis.rest is None and left.basis.colour <= WHITE
