"""Several names of the motion, none of which is as likely as one source that nobody logged.

On parallel legs a position is a function of the headings before it: a field that differs from place
to place was iron that takes its time, the earth's turn and hysteresis, 99 % sure each.  One source
that is free in time was likelier than any of the three, and they left nothing of it.
"""

from __future__ import annotations

from ahrsd.mismatch import unknown
from ahrsd.mismatch.foretold import in_time_alone
from ahrsd.mismatch.search import State, Survey, formed_basis_of, refitted

#: names from which on it is asked: pairs of effects are seen on vehicles
MANY = 3


def one_for_many(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without names, and that source, where there are three or more; else as it was.

    Names by a logged cause, or with a course in time, are not asked, nor is anything where more is
    left: then there is a source, and names beside it.
    """
    names = [judged.candidate for judged in state.named]
    own = any("covariate" in name.setting or in_time_alone(name) for name in names)
    if len(names) < MANY or own or unknown.detected(left, state.problem.limits):
        return state, surveys, left
    bare = refitted(state, ())
    source = unknown.remainder(formed_basis_of(bare))
    likelier = source.strongest.evidence > max(judged.evidence for judged in state.named)
    if not (likelier and unknown.detected(source, state.problem.limits)):
        return state, surveys, left
    return bare, [], source
