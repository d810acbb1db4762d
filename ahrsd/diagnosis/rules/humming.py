"""A band of frequencies far louder than those beside it: what turns or sways at no one rate.

A propeller whose revolutions nobody logged, or cargo that swings, has no line (a line is named) and
no burst, and its mean is nothing.  To the noise law it is colour.  But noise of a sensor is colour
that rises or falls over octaves: a band that stands several times above both of its sides is a
source.  It is looked for where nothing else is left, at the rate of the recording.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Unexplained
from ahrsd.diagnosis.rules.own_form import free_price_of
from ahrsd.diagnosis.rules.quick import Quick
from ahrsd.diagnosis.rules.regression import Base, residual
from ahrsd.diagnosis.rules.ringing import ringing
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.where_and_when.narrow_band import loudest_band, of_band


def heard(state: State, fast: Quick) -> Unexplained:
    """What rings in what a search leaves, or hums at the recorded rate beside what is `fast`."""
    seen = ringing(formed_basis_of(state)) or humming(fast.state, fast.last.basis)
    return seen or Unexplained(False)


def humming(state: State, basis: Base) -> Unexplained | None:
    """What the names leave, if a band of it stands out by more than their own forms do, else None.

    basis: the state's
    """
    left = residual(basis.known, basis.innovation)
    # of readings that repeat, what is slow is seen a second time around the rate of the new ones
    highest_hz = 0.5 * basis.rate_hz * float(np.mean(basis.filtered.used))
    found = loudest_band(left, basis.rate_hz, highest_hz)
    if found is None:
        return None
    low, high, nats = found
    nats -= free_price_of(state)
    if nats < state.problem.limits.unknown_nats:
        return None
    return of_band(basis.context, left, basis.rate_hz, (low, high), nats)
