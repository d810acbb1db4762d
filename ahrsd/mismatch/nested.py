"""A delay and the eddy currents that contain it: which of the two, or both.

A field by eddy currents is C dh/dt with nine coefficients; C = -tau I is a delay, whose one
coefficient says the same for less.  Beside eddy currents a delay never explains anything, so it is
sought first.  It stays where the whole C is a delay for all but a twentieth of its squares: a
housing's currents differ by more than a quarter from axis to axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.mismatch.delays import DELAYS
from ahrsd.mismatch.name import Judged
from ahrsd.mismatch.regression import Base
from ahrsd.mismatch.search import State, term_group

WIDER = "eddy_current"
ISOTROPIC = 0.95


def simplest(accepted: Sequence[Judged]) -> Judged:
    """The strongest name, or the delay if that contains one."""
    if accepted[0].candidate.name != WIDER:
        return accepted[0]
    delays = (one for one in accepted if one.candidate.name in DELAYS)
    return next(delays, accepted[0])


def without_wider(state: State, number: int, left: Base) -> Base:
    """`left` (without this term) without the eddy currents too, where it is a delay of its own."""
    if state.names[number] not in DELAYS or WIDER not in state.names:
        return left
    wider = state.names.index(WIDER)
    C = state.fit.terms[wider].value.reshape(3, 3) - state.lag_s(number) * np.eye(3)
    if np.trace(C) ** 2 / 3.0 < ISOTROPIC * float(np.sum(C**2)):
        return left
    return left.without(term_group(wider), state.fit.terms[wider].value)
