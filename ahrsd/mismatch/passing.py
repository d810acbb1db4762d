"""Names of the outside field that show for seconds, beside what comes and goes by itself.

Iron that has two states, or a source that switches unseen, is for ten seconds what an object is
that is passed by.  Such a name has the evidence of that one moment; where what no name explains is
as likely as a whole, the moment is a part of it.
"""

from __future__ import annotations

from ahrsd.mismatch import unknown
from ahrsd.mismatch.along_field import framed
from ahrsd.mismatch.name import LONELY_BLOCKS, Judged
from ahrsd.mismatch.search import State, Survey, formed_basis_of
from ahrsd.mismatch.stand_ins import dropped

#: by which such a name must be likelier than what is left
LIKELIER = 2.0


def without_passing(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such names, where what is left is in another frame; else as it was."""
    limits = state.problem.limits
    if not unknown.detected(left, limits) or left.strongest.frame == "world":
        return state, surveys, left
    passing = [k for k, judged in enumerate(state.named) if _passing(judged, left)]
    if not passing:
        return state, surveys, left
    slim, others, rest = dropped(state, surveys, passing, left)
    rest = framed(formed_basis_of(slim), rest, limits)
    return (slim, others, rest) if unknown.detected(rest, limits) else (state, surveys, left)


def _passing(judged: Judged, left: unknown.Remainder) -> bool:
    brief = judged.what.effective_blocks < LONELY_BLOCKS
    outside = judged.candidate.effect.family == "world"
    return outside and brief and judged.evidence < LIKELIER * left.strongest.evidence
