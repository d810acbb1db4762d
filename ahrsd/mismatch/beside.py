"""Names that stand out beside what no name explains.

A real recording always leaves something: against white noise it hides what is weaker, and spoils
the first names that are tried.  Here the random effects of `discrepancy` are whitened out of the
innovations and of every column, and the library is held against what is then left.  What a name
says must be more than other sizes of the random effects would say.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.mismatch import unknown
from ahrsd.mismatch.discrepancy import beyond, discrepancy
from ahrsd.mismatch.exam import IMITATORS
from ahrsd.mismatch.name import Judged
from ahrsd.mismatch.search import State, Survey, added, formed_basis_of, survey
from ahrsd.mismatch.stand_ins import TIME_SHAPED, wrong_in_form

#: what a room or an unlogged source does from place to place and from minute to minute, and what a
#: sensor does that is not quite linear: beside a rest such names say no more than the rest does
OF_THE_REST = (
    *IMITATORS,
    *(name for names in TIME_SHAPED.values() for name in names if name != "switched_device"),
    "field_gradient",
    "onboard_calibration_active",
    "flexible_mount",
    "mag_cross_axis",
    "mag_nonlinearity",
)


def named_beside(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state with the names that stand out beside the rest, where there is one."""
    limits = state.problem.limits
    while len(state.named) < limits.most_terms and unknown.detected(left, limits):
        found = _standing_out(state)
        if found is None:
            break
        more = added(state, found[0])
        if len(state.named) in wrong_in_form(more, beside=True):
            break  # a mount that bends is no misalignment, not even a part of one
        state = more
        surveys = [*surveys, found[1]]
        left = unknown.remainder(formed_basis_of(state))
    return state, surveys, left


def _standing_out(state: State) -> tuple[Judged, Survey] | None:
    """The strongest name beside the rest, and the survey in which it was found."""
    problem, basis = state.problem, formed_basis_of(state)
    found = discrepancy(basis)
    library = {name: e for name, e in problem.library.items() if name not in OF_THE_REST}
    asked = replace(state, problem=replace(problem, library=library))
    seen = survey(asked, found.softened())
    for judged in (one for one in seen.judged if one.accepted):
        columns = judged.candidate.effect.columns(basis.context, judged.candidate.setting)
        alone = basis.whitened([columns])[0]
        if beyond(found, basis, alone, judged.candidate.scale) > problem.limits.beside_nats:
            return judged, seen
    return None
