"""Several names of the motion, none of which is as likely as one source that nobody logged.

On parallel legs a position is a function of the headings before it: a field that differs from place
to place was iron that takes its time, the earth's turn and hysteresis, 99 % sure each.  One source
that is free in time was likelier than any of the three, and they left nothing of it.  On another
such path one of them had 444 nats and left 211: a source free in time had 676 at once.
"""

from __future__ import annotations

from ahrsd.mismatch import unknown
from ahrsd.mismatch.foretold import in_time_alone
from ahrsd.mismatch.rivals import MORE_NATS
from ahrsd.mismatch.search import State, Survey, formed_basis_of, refitted

#: names from which on it is asked where they leave nothing: pairs of effects are seen on vehicles
MANY = 3


def one_for_many(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without names, and that source, where it is likelier; else as it was.

    Than each of three or more, or than all and what they leave.  Names by a logged cause, or with a
    course in time, are not asked.
    """
    names = [judged.candidate for judged in state.named]
    own = any("covariate" in name.setting or in_time_alone(name) for name in names)
    rest = unknown.detected(left, state.problem.limits)
    if own or not names or (len(names) < MANY and not rest):
        return state, surveys, left
    nats = [judged.evidence for judged in state.named]
    other = sum(nats) + left.strongest.evidence + MORE_NATS if rest else max(nats)
    bare = refitted(state, ())
    source = unknown.remainder(formed_basis_of(bare))
    likelier = source.strongest.evidence > other
    if not (likelier and unknown.detected(source, state.problem.limits)):
        return state, surveys, left
    return bare, [], source
