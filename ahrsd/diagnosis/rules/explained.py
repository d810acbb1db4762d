"""The name of a rest that stands alone, where one of the library's explains all of it.

The block-robust test guards against noise that only looks like an effect, and has little to go by
where few blocks show one.  Where a free course says that something is there, it is no longer the
question whether, but what; and a name that explains as much as the free course, with a tenth of its
coefficients, is more likely it than something that nobody knows.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.free_source import free_nats, hardly_likelier
from ahrsd.diagnosis.rules.name import ROBUST, Judged
from ahrsd.diagnosis.rules.refined import white
from ahrsd.diagnosis.rules.search import WANDERING, State, Survey, added, formed_basis_of, survey
from ahrsd.diagnosis.rules.selection import borne_out, noise_or_cause
from ahrsd.diagnosis.rules.unknown import Remainder

#: times its limit that the block-robust probability may be
ROBUST_SLACK = 20.0


def explained(
    state: State, left: Remainder, limits: Limits
) -> tuple[State, list[Survey], Survey, Remainder] | None:
    """The state with the one name that leaves nothing of the rest, if there is one.

    And the surveys without it and with it, and what is left.

    state: without names, to which none was ever given;  left: its rest, which is there
    limits: those by which it is
    """
    seen = survey(state)
    rest = max(left.strongest.evidence, limits.unknown_nats, state.problem.limits.unknown_nats)
    best = max(
        (judged for judged in seen.judged if _but_for_blocks(judged, state.problem.limits)),
        key=lambda judged: judged.evidence,
        default=None,
    )
    if best is None or best.evidence < rest:
        return None
    tried = _with(state, best, seen)
    if not borne_out(state, tried, best, seen):
        return None
    after = unknown.remainder(formed_basis_of(tried))
    free = free_nats(left, quick=white(after))
    if unknown.detected(after, limits) or free > best.evidence + limits.lead_nats:
        return None
    if hardly_likelier(tried)[0]:
        return None
    return tried, [seen] * len(tried.named), survey(tried), after


def _with(state: State, judged: Judged, seen: Survey) -> State:
    """The state with the name, or with a gyro's bias that wanders as an ordinary one's does."""
    if judged.candidate.name in WANDERING:
        return noise_or_cause(state, judged, seen)
    return added(state, replace(judged, refused=()))


def _but_for_blocks(judged: Judged, limits: Limits) -> bool:
    """Whether nothing speaks against it but that few blocks show it."""
    slack = judged.robust_family_p < ROBUST_SLACK * limits.robust_family_p
    return judged.refused == (ROBUST,) and slack
