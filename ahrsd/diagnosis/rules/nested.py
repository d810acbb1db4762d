"""A delay and the eddy currents that contain it: which of the two, or both.

A field by eddy currents is C dh/dt with nine coefficients; C = -tau I is a delay, whose one
coefficient says the same for less.  Beside eddy currents a delay never explains anything, so it is
sought first.  It stays where the whole C is a delay for all but a twentieth of its squares: a
housing's currents differ by more than a quarter from axis to axis.  Where the eddy currents are
still there when all names have been held against what is left, they say it all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.search import State, refitted, term_group

WIDER = "eddy_current"
ISOTROPIC = 0.95


def simplest(accepted: Sequence[Judged]) -> Judged:
    """The strongest name, or the delay if that contains one."""
    if accepted[0].candidate.name != WIDER:
        return accepted[0]
    delays = (one for one in accepted if one.candidate.name in DELAYS)
    return next(delays, accepted[0])


def contained(state: State, number: int) -> bool:
    """Whether a term is a delay beside eddy currents that are more than a delay: they say it all.

    Beside them it has no size of its own; in the joint fit the two run away from each other.
    """
    return _beside_wider(state, number) and not _isotropic(state, number)


def eddies_alone(state: State) -> State:
    """The state without a delay where eddy currents are named beside it: they contain it."""
    kept = tuple(j for k, j in enumerate(state.named) if not _beside_wider(state, k))
    return state if len(kept) == len(state.named) else refitted(state, kept)


def without_wider(state: State, number: int, left: Base) -> Base:
    """`left` (without this term) without the eddy currents too, where it is a delay of its own."""
    if not _beside_wider(state, number) or not _isotropic(state, number):
        return left
    wider = state.names.index(WIDER)
    return left.without(term_group(wider), state.fit.terms[wider].value)


def _beside_wider(state: State, number: int) -> bool:
    return state.names[number] in DELAYS and WIDER in state.names


def _isotropic(state: State, delay: int) -> bool:
    """Whether the eddy currents together with the delay are hardly more than one delay."""
    C = state.fit.terms[state.names.index(WIDER)].value.reshape(3, 3)
    C = C - DELAYS[state.names[delay]] * state.lag_s(delay) * np.eye(3)
    return bool(np.trace(C) ** 2 / 3.0 >= ISOTROPIC * float(np.sum(C**2)))
