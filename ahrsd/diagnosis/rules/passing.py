"""Names of the outside field that show for seconds, beside what comes and goes by itself.

Iron that has two states, or a source that switches unseen, is for ten seconds what an object is
that is passed by.  Such a name has the evidence of that one moment; where what no name explains is
as likely as a whole, the moment is a part of it.
"""

from __future__ import annotations

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import framed
from ahrsd.diagnosis.rules.name import LONELY_BLOCKS, Judged
from ahrsd.diagnosis.rules.search import State, Survey, formed_basis_of
from ahrsd.diagnosis.rules.stand_ins import dropped

#: by which such a name must be likelier than what is left
LIKELIER = 2.0


def without_passing(
    state: State, surveys: list[Survey], left: unknown.Remainder, burst_nats: float = 0.0
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such names, where what is left is in another frame; else as it was.

    burst_nats: evidence of bursts of no frame's course, where they are what is left
    """
    limits = state.problem.limits
    course = unknown.detected(left, limits) and left.strongest.frame != "world"
    nats = max(burst_nats, left.strongest.evidence if course else 0.0)
    passing = [k for k, judged in enumerate(state.named) if _passing(judged, nats)]
    if not passing:
        return state, surveys, left
    if burst_nats >= nats:
        return dropped(state, surveys, passing, left)
    slim, others, rest = dropped(state, surveys, passing, left)
    rest = framed(formed_basis_of(slim), rest, limits)
    return (slim, others, rest) if unknown.detected(rest, limits) else (state, surveys, left)


def _passing(judged: Judged, nats: float) -> bool:
    brief = judged.what.effective_blocks < LONELY_BLOCKS
    outside = judged.candidate.effect.family == "world"
    return outside and brief and judged.evidence < LIKELIER * nats
