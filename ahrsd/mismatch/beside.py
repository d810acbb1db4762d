"""Names that stand out beside what no name explains.

A real recording always leaves something: against white noise it hides what is weaker, and spoils
the first names that are tried.  Here the random effects of `discrepancy` are whitened out of the
innovations and of every column, and the library is held against what is then left.  What a name
says must be more than other sizes of the random effects would say.
"""

from __future__ import annotations

import numpy as np

from ahrsd.mismatch import unknown
from ahrsd.mismatch.discrepancy import beyond, discrepancy, places
from ahrsd.mismatch.exam import IMITATORS
from ahrsd.mismatch.name import Judged
from ahrsd.mismatch.regression import Base
from ahrsd.mismatch.search import State, Survey, added, formed_basis_of, survey

#: what a room does by itself from place to place and from minute to minute, and what a sensor does
#: that is not quite linear: beside a rest of that kind such names say no more than the rest does
OF_THE_REST = (
    *IMITATORS,
    "field_step",
    "field_anomaly",
    "geomagnetic_drift",
    "field_gradient",
    "onboard_calibration_active",
    "hard_iron_drift",
    "soft_iron_step",
    "flexible_mount",
    "mag_cross_axis",
    "mag_nonlinearity",
)
#: such names that are put to the rest before a name is given up
MOST_OF_THE_REST = 4
#: a step this near to the beginning or end of a rest is another place
AT_A_PLACE_S = 2.0


def named_beside(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state with the names that stand out beside the rest, where there is one."""
    limits = state.problem.limits
    while len(state.named) < limits.most_terms and unknown.detected(left, limits):
        found = _standing_out(state)
        if found is None:
            break
        state = added(state, found[0])
        surveys = [*surveys, found[1]]
        left = unknown.remainder(formed_basis_of(state))
    return state, surveys, left


def _standing_out(state: State) -> tuple[Judged, Survey] | None:
    """The strongest name beside the rest, and the survey in which it was found.

    What is stronger and of the rest itself goes to the rest: its neighbours among the names, which
    explain the same, are then no stronger than noise.
    """
    basis, limits = formed_basis_of(state), state.problem.limits
    found = discrepancy(basis)
    soft = found.softened()
    for number in range(MOST_OF_THE_REST):
        seen = survey(state, soft)
        for judged in (one for one in seen.judged if one.accepted):
            columns = judged.candidate.effect.columns(basis.context, judged.candidate.setting)
            if judged.candidate.name in OF_THE_REST or _another_place(judged, basis):
                soft = soft.beside(f"of the rest {number}", soft.whitened([columns])[0])
                break
            alone = basis.whitened([columns])[0]
            if beyond(found, basis, alone, judged.candidate.scale) > limits.beside_nats:
                return judged, seen
        else:
            return None
    return None


def _another_place(judged: Judged, basis: Base) -> bool:
    """Whether it begins where a rest begins or ends."""
    onset_s = judged.candidate.setting.get("onset_s")
    if onset_s is None:
        return False
    index, time_s = places(basis.context).index, basis.context.track.time_s
    edges_s = time_s[1:][np.diff(index) != 0]
    return bool(np.any(np.abs(edges_s - onset_s) < AT_A_PLACE_S))
