"""Names of the outside field that show for seconds, beside what comes and goes by itself.

Iron that has two states, or a source that switches unseen, is for ten seconds what an object is
that is passed by.  Such a name has the evidence of that one moment; where what no name explains is
as likely as a whole, the moment is a part of it.

So are bumps, steps and drifts, wherever they are, where what is left beside them is a quick source:
a current is on now and then, and more so at first.  Where the source alone is likelier than they
and what they leave of it, it is.
"""

from __future__ import annotations

from ahrsd.mismatch import unknown
from ahrsd.mismatch.along_field import framed
from ahrsd.mismatch.name import LONELY_BLOCKS, Judged
from ahrsd.mismatch.regression import Candidate
from ahrsd.mismatch.rivals import MORE_NATS
from ahrsd.mismatch.search import State, Survey, formed_basis_of
from ahrsd.mismatch.stand_ins import IN_TIME, dropped

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
        return _without_parts(state, surveys, left)
    if burst_nats >= nats:
        return dropped(state, surveys, passing, left)
    slim, others, rest = dropped(state, surveys, passing, left)
    rest = framed(formed_basis_of(slim), rest, limits)
    return (slim, others, rest) if unknown.detected(rest, limits) else (state, surveys, left)


def _passing(judged: Judged, nats: float) -> bool:
    brief = judged.what.effective_blocks < LONELY_BLOCKS
    outside = judged.candidate.effect.family == "world"
    return outside and brief and judged.evidence < LIKELIER * nats


def _without_parts(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without names in time that are parts of a quick source; else as it was."""
    parts = [k for k, judged in enumerate(state.named) if _in_time(judged.candidate)]
    if not parts or not left.one_source:
        return state, surveys, left
    slim, others, rest = dropped(state, surveys, parts, left)
    rest = framed(formed_basis_of(slim), rest, state.problem.limits)
    together = sum(state.named[k].evidence for k in parts) + _nats(left)
    likelier = rest.one_source and _nats(rest) > together + MORE_NATS
    return (slim, others, rest) if likelier else (state, surveys, left)


def _in_time(name: Candidate) -> bool:
    """Whether a name is a course in time that nothing logged bears out."""
    return name.name in IN_TIME and "covariate" not in name.setting


def _nats(left: unknown.Remainder) -> float:
    """Of the likeliest quick course."""
    return max((one.evidence for one in left.quick.values()), default=0.0)
