"""Names amid a rest, asked once more when all names are in.

A name is held against other forms when it is found.  By then the rest has no frame yet, or another
name had taken a part of it; beside a rest, its spectrum stands for it, in which a slow course is
noise that happens to look like the name.  In the end what is left has a frame.  Where that frame's
course, or another free form, is likelier than a name, which keeps less than half of its evidence
beside it (one by a logged cause, which a course is free to follow, no more than would be an
unknown), the name has only a part of the rest.  And a name that is worth less than the rest,
no larger than what every sensor has of itself, is not said, as beside a real room (`beside`); nor
is one that is worth a small part of the rest, whatever it is.

A step that was found against the spectrum of the rest and is worth more than the rest is not asked:
1500 nats are no part of 700, though in white noise, which a room is not, a course in time is yet
likelier.  Nor, whatever the rest, is what was logged and changes often: the spectrum knows how
often a room does.  Nor is a delay: it follows the turns and no course.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.beside import material
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.locate import UNITS
from ahrsd.diagnosis.rules.name import Judged
from ahrsd.diagnosis.rules.often import OFTEN, logged_often
from ahrsd.diagnosis.rules.own_form import strengths
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.rivals import OWN_SHARE, compared, more
from ahrsd.diagnosis.rules.search import (
    STEPS,
    State,
    Survey,
    formed_basis_of,
    term_group,
    without_term,
)
from ahrsd.diagnosis.rules.stand_ins import dropped, frame_of, wrong_in_form
from ahrsd.diagnosis.where_and_when.locate import coarse_cut, frame_columns
from ahrsd.samples import Array


def without_likelier_forms(
    state: State, surveys: list[Survey], left: unknown.Remainder, beside: Set[str] = frozenset()
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such names, and what is then left; as it was where no rest is.

    beside: names that were found against the spectrum of what is left
    """
    limits = state.problem.limits
    while state.named and unknown.detected(left, limits):
        asked = _asked(state, left, beside)
        wrong = [k for k in wrong_in_form(state, beside=True) if k in asked] if asked else []
        wrong = wrong or _parts_of_the_rest(state, left, asked)
        wrong = wrong or _of_sensors_themselves(state, left, asked)
        wrong = wrong or _next_to_nothing(state, left, asked)
        if not wrong:
            break
        frame = frame_of(state, wrong[0])
        state, surveys, left = dropped(state, surveys, wrong, left)
        if not unknown.detected(left, limits):
            left = replace(left, stood_in=frame)
    return state, surveys, left


def _asked(state: State, left: unknown.Remainder, beside: Set[str]) -> list[int]:
    """Names that may be parts of what is left."""
    rest = left.strongest.evidence
    return [
        k
        for k, one in enumerate(state.named)
        if one.candidate.name not in DELAYS
        and not (one.candidate.name in beside and _sharp(state, one, rest))
    ]


def _sharp(state: State, judged: Judged, rest: float) -> bool:
    """Whether a name changes at moments that the course of a rest of so many nats does not know."""
    step = judged.candidate.name in STEPS.values() and judged.evidence > rest
    return step or logged_often(state.problem.track, judged.candidate, 2 * OFTEN)


def _parts_of_the_rest(state: State, left: unknown.Remainder, asked: list[int]) -> list[int]:
    """Of the names asked those that the course of a frame explains better, and that add little."""
    if not asked:
        return []
    basis, limits = formed_basis_of(state), state.problem.limits
    cut = coarse_cut(basis.context.track)
    frames = [frame for frame, one in left.located.items() if one.evidence > limits.unknown_nats]
    columns = basis.whitened([frame_columns(basis.context, frame, cut) for frame in frames])
    courses = [part * UNITS[frame] for part, frame in zip(columns, frames, strict=True)]
    return [k for k in asked if any(_part(state, k, basis, course) for course in courses)]


def _part(state: State, number: int, basis: Base, course: Array) -> bool:
    """Whether a term is a part of a course (N, 3, q), whitened and in its unit.

    A course is free to follow a slow cause that was logged: such a name may add less to it.
    """
    candidate, limits = state.named[number].candidate, state.problem.limits
    mine = basis.known[:, :, basis.groups[term_group(number)]] * candidate.scale
    noise = max(1.0, basis.colour)
    name, form, both = compared(without_term(state, number, basis), mine, course, noise)
    kept = OWN_SHARE * name
    if "covariate" in candidate.setting:
        kept = min(kept, limits.unknown_nats)
    return form > name + more(name) and both - form < kept


def _of_sensors_themselves(state: State, left: unknown.Remainder, asked: list[int]) -> list[int]:
    """Of the names asked those worth less than the rest that are no larger than sensors' own.

    Of a small rest even the form is not much: they must be beyond doubt there, too.
    """
    least = max(left.strongest.evidence, state.problem.limits.beyond_nats)
    return [
        k
        for k in asked
        if state.named[k].evidence < least
        and not material(state.named[k].candidate, state.fit.terms[k].value)
    ]


def _next_to_nothing(state: State, left: unknown.Remainder, asked: list[int]) -> list[int]:
    """Of the names asked those that are worth a small part of the rest, in time or by regime.

    A field that goes with the heading was a step of the soft iron of 8 nats, beside 264.
    """
    rest = max([left.strongest.evidence, *(evidence for _, evidence, _ in left.bins)])
    least, nats = state.problem.limits.beyond_share * rest, strengths(state)
    return [k for k in asked if nats[k] < least]
