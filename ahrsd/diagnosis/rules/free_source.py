"""Names that no logged column bears out, against one source that is free in time.

A current is on now and then, a speed swells and fades, a path crosses a field that differs from
place to place: what nobody logged is roughly a bump, a step or iron that takes its time.  On
parallel legs a position is a function of the headings before it: a field that differs from place to
place was iron that takes its time, the earth's turn and hysteresis, 99 % sure each.  A course that
is free in time has to pay for every one of its coefficients; where it is likelier all the same than
such names and what they leave, it is the answer (a speed as a bump).

A slow course is smooth as well, which costs it less: a field that differs from place to place on
parallel legs was iron that remembers, of 430 nats, and the smooth course had 24 more.
A name whose form was sought must be likelier than that by odds of its own.

What changes within seconds counts where noise cannot be such a course: where noise is white beside
the names, or where with and without them it is one source.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import framed
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.findings import added_value
from ahrsd.diagnosis.rules.foretold import in_time_alone
from ahrsd.diagnosis.rules.one_course import as_smooth
from ahrsd.diagnosis.rules.one_source import (
    NATS,
    with_any_course,
    with_gyro_course,
    with_one_source,
)
from ahrsd.diagnosis.rules.refined import white
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.rivals import MORE_NATS
from ahrsd.diagnosis.rules.search import STEPS, State, Survey, formed_basis_of, term_group
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.stand_ins import BUMP, TIME_SHAPED, dropped
from ahrsd.diagnosis.where_and_when.locate import Frame

#: names of a field outside that is elsewhere from a moment on, as it is once a gyro's bias has come
#: and gone: of a true one a quick course of the gyro's error explains little
TURNED = (STEPS["world"], BUMP)
#: names whose form was sought, in time or in what the vehicle did before, and is smooth or nearly;
#: a trend is a smooth course itself
SOUGHT = (*TURNED, "hard_iron_step", "soft_iron_step", "viscous_magnetisation", "hysteresis")
#: names of the motion from which on the source must only be likelier than each of them: pairs of
#: effects are seen on vehicles
MANY = 3


def without_names_of_a_source(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such names, and the source, where it is likelier; else as it was.

    left: told of quick sources (`along_field.framed`)
    """
    state, surveys, left = _without_smooth(state, surveys, left)
    asked = [k for k, judged in enumerate(state.named) if _of_no_column(judged.candidate)]
    if not asked or state.walk:
        return state, surveys, left
    turned = any(state.named[k].candidate.name in TURNED for k in asked)
    if not unknown.detected(left, state.problem.limits):
        # names that leave nothing are the rule, and cost less to be asked without a new fit
        linear = unknown.remainder(_without(state, asked), with_bins=False)
        if not _likelier(state, asked, _told(linear, turned=turned), left):
            return state, surveys, left
    slim, others, source = dropped(state, surveys, asked, left)
    source = framed(formed_basis_of(slim), source, state.problem.limits)
    source = with_any_course(_told(source, turned=turned)) if white(left) else source
    there = unknown.detected(source, state.problem.limits)
    likelier = there and _likelier(state, asked, source, left)
    return (slim, others, source) if likelier else (state, surveys, left)


def _without_smooth(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without the names that are hardly likelier than a smooth course in one frame."""
    terms, frame = hardly_likelier(state)
    if not terms:
        return state, surveys, left
    state, surveys, left = dropped(state, surveys, terms, left)
    if not unknown.detected(left, state.problem.limits):
        left = replace(left, stood_in=frame)
    return state, surveys, left


def hardly_likelier(state: State) -> tuple[list[int], Frame | None]:
    """Numbers of the terms whose sought form is hardly likelier than a smooth course: its frame.

    Those of one name are asked as one: a magnet put on in a room and taken off again has 41
    nats more than the course, and its end beside its beginning less than that (`broad/36`).
    """
    asked: dict[tuple[int, ...], float] = {}
    for name in SOUGHT:
        terms = tuple(k for k, one in enumerate(state.named) if one.candidate.name == name)
        if terms:
            short = in_time_alone(state.named[terms[0]].candidate)
            asked[terms] = state.problem.limits.lead_nats if short else NATS
    return as_smooth(state, formed_basis_of(state), asked)


def _without(state: State, asked: list[int]) -> Base:
    """The basis without these names."""
    basis = formed_basis_of(state)
    for k in asked:
        basis = basis.without(term_group(k), added_value(state, k))
    return basis


def _together(state: State, asked: list[int], noise: float) -> float:
    """Evidence of these names as one, nats, in noise of such a power, or what they leave if less.

    Of each beside those before it, at least what all had when they were found: two that share what
    they explain have less beside one another than they have as one.
    """
    basis, nats = formed_basis_of(state), 0.0
    basis = replace(basis, colour=min(basis.colour, noise))
    for k in reversed(asked):
        basis = basis.without(term_group(k), added_value(state, k))
        candidate = state.named[k].candidate
        nats += evidence_of(basis, candidate) - candidate.paid
    found = sum(float(state.named[k].evidence) for k in asked)
    return max(nats, found)


def _likelier(
    state: State, asked: list[int], source: unknown.Remainder, left: unknown.Remainder
) -> bool:
    """Whether the source is likelier than the names that are asked and what they leave.

    In the same noise: of 6400 nats two hundredths more of it cost 130 (a
    slow drift of the outside field that was unknown).  A source needs no lead before names that
    leave nothing: none that was true in three opened rings is less than nine nats ahead of one.
    """
    nats = _together(state, asked, source.basis.colour)
    limits, names = state.problem.limits, state.named
    free = free_nats(source, quick=white(left) or (left.one_source and source.one_source))
    if unknown.detected(left, limits):
        return free > nats + free_nats(left, quick=True) + MORE_NATS
    own = any(in_time_alone(one.candidate) or not _of_no_column(one.candidate) for one in names)
    if len(names) >= MANY and not own:
        return free > max(one.evidence for one in names)
    return free > nats


def _told(left: unknown.Remainder, *, turned: bool) -> unknown.Remainder:
    """The remainder told of quick courses; of the gyro's, too, where a jump may be one."""
    seen = left if left.quick else with_one_source(left)
    return with_gyro_course(seen) if turned else seen


def _of_no_column(name: Candidate) -> bool:
    """Whether nothing that was logged bears a name out.

    A delay follows the turns, and a bias that changes is held against its own course (`stand_ins`).
    """
    other = name.name in DELAYS or name.name in TIME_SHAPED["gyro"]
    return "covariate" not in name.setting and not other


def free_nats(left: unknown.Remainder, *, quick: bool) -> float:
    """Of the likeliest course, quick ones among them or not; 0 where none is likelier than none."""
    seen = [*left.located.values(), *(left.quick.values() if quick else ())]
    return max([0.0, *(float(one.evidence) for one in seen)])
