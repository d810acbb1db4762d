"""Names that only stand in for something else: steps, drifts and bumps for the course of an
unlogged source, any name for what has another form (`rivals`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.calibration_fit.resting import ORDINARY_WALK_RAD_S_SQRT_S
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.bursts import bursts
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.findings import added_value, shares_of, where
from ahrsd.diagnosis.rules.one_course import of_one_course
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.rivals import of_another_form
from ahrsd.diagnosis.rules.search import (
    CANCELS,
    STEPS,
    State,
    Survey,
    counterpart,
    formed_basis_of,
    refitted,
    survey,
    term_group,
)
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.where_and_when.locate import FRAMES, Frame
from ahrsd.samples import Array

#: names that are a course in time and nothing else, by the frame that they act in
TIME_SHAPED: Mapping[Frame, tuple[str, ...]] = {
    "sensor": ("hard_iron_step", "hard_iron_drift", "switched_device", "soft_iron_step"),
    "world": ("field_step", "geomagnetic_drift", "field_anomaly"),
    "gyro": ("gyro_bias_step", "gyro_startup", "gyro_bias_drift"),
}
#: all of them
IN_TIME = frozenset(name for names in TIME_SHAPED.values() for name in names)
#: share of the probability below which a name is not said
LEAST_SHARE = 1 / 3
#: a bump of the outside field
BUMP = "field_anomaly"


def without_unlikely(
    state: State, surveys: list[Survey], last: Survey
) -> tuple[State, list[Survey], Survey]:
    """The state without the names that hold less than a third of the probability.

    What holds more could not pass the gate: then there is no name to say.
    """
    kept = [
        k
        for k, name in enumerate(state.names)
        if name in DELAYS or shares_of(state, k, surveys[k], last)[name] > LEAST_SHARE
    ]
    if len(kept) == len(state.named):
        return state, surveys, last
    state = refitted(state, tuple(state.named[k] for k in kept))
    return state, [surveys[k] for k in kept], survey(state)


def without_stand_ins(
    state: State, surveys: list[Survey], beside: bool
) -> tuple[State, list[Survey], unknown.Remainder]:
    """Names that only stand in for a course in time taken out again, and what is then left.

    Steps, drifts and bumps can imitate any course roughly.  They may stay where they explain nearly
    all of what their frame's own coefficients explain, and where a few of them do.  A gyro whose
    bias wanders as an ordinary one's does is noise.  Every name is held against what has another
    form; beside: whether more is left than the names explain.
    """
    limits = state.problem.limits
    left = unknown.remainder(formed_basis_of(state))
    if not state.walk and left.strongest.frame == "gyro" and unknown.detected(left, limits):
        state = refitted(replace(state, walk=ORDINARY_WALK_RAD_S_SQRT_S), state.named)
        left = unknown.remainder(formed_basis_of(state))
    for frame, names in TIME_SHAPED.items():
        shaped = [k for k, name in enumerate(state.names) if name in names]
        doubtful = shaped if len(shaped) > limits.most_shaped else []
        if shaped and not doubtful:
            doubtful = shaped if _stand_in(state, frame, shaped, left) else []
        state, surveys, left = dropped(state, surveys, doubtful, left)
    bumps, one_course = _bumps(state, left)
    state, surveys, left = dropped(state, surveys, bumps, left)
    if one_course:
        left = replace(left, stood_in="world")
    parts, whose = of_one_course(state, formed_basis_of(state))
    state, surveys, left = dropped(state, surveys, parts, left)
    if parts and not unknown.detected(left, limits):
        left = replace(left, stood_in=whose)
    if state.named:
        wrong = wrong_in_form(state, beside)
        if wrong:
            frame = frame_of(state, wrong[0])
            state, surveys, left = dropped(state, surveys, wrong, left)
            if not unknown.detected(left, limits):
                left = replace(left, stood_in=frame)
    return state, surveys, left


def wrong_in_form(state: State, beside: bool) -> list[int]:
    """Terms that come and go as nothing in the library does, or are of another form."""
    basis = formed_basis_of(state)
    # a magnet is put on and taken off again; a gyro's bias does not come back
    steps = [k for k, name in enumerate(state.names) if name == STEPS["gyro"]]
    back = [k for k in steps if counterpart(state, k) is not None]
    if len(steps) > 1 and end_where_they_began([state.fit.terms[k].value for k in steps]):
        back = steps
    return sorted({*back, *of_another_form(state, basis, IN_TIME, beside=beside)})


def end_where_they_began(steps: Sequence[Array]) -> bool:
    """Whether steps (3,) end where they began: what swells and fades, in a few levels."""
    whole = sum(float(np.linalg.norm(one)) for one in steps)
    return 2 * float(np.linalg.norm(np.sum(steps, axis=0))) < CANCELS * whole


def _bumps(state: State, left: unknown.Remainder) -> tuple[list[int], bool]:
    """Bumps of the outside field that are part of a longer course: of the rest, or of one another.

    The second says that it is the latter.  One that repeats at its place is told by that.
    """
    bumps = [k for k, name in enumerate(state.names) if name == BUMP]
    if not bumps:
        return [], False
    basis = formed_basis_of(state)
    once = [
        k for k in bumps if len(where(state.named[k], added_value(state, k), basis).intervals_s) < 2
    ]
    rest = unknown.detected(left, state.problem.limits) and left.strongest.frame != "gyro"
    if rest or bursts(basis) is not None:
        return once, False
    loose = [k for k in once if "place_m" not in state.named[k].candidate.setting]
    return (loose, True) if len(loose) > 1 else ([], False)


def frame_of(state: State, number: int) -> Frame:
    """The frame in which a term acts."""
    effect = state.named[number].candidate.effect
    frame = effect.frame or effect.family
    return next((known for known in FRAMES if known == frame), "sensor")


def _stand_in(state: State, frame: Frame, terms: list[int], left: unknown.Remainder) -> bool:
    """Whether the terms explain less than true names would.

    They do if what they leave fires and is more than the part that a true name may leave, or, a
    single one, if the frame's free course is likelier, however many its coefficients.
    """
    limits = state.problem.limits
    before = unknown.remainder(_bare(state, terms), with_bins=False)
    free = before.located[frame]
    if not unknown.detected(before, limits):
        return False  # there is no course that they could stand in for
    fires = unknown.detected(left, limits)
    if fires and left.located[frame].statistic > (1 - limits.coverage) * free.statistic:
        return True
    # a wave of any length and phase is most of any slow course: what it leaves there is the rest
    waves = any(state.named[k].candidate.setting.get("shape") == "wave" for k in terms)
    if fires and waves and left.strongest.frame == frame:
        return True
    if len(terms) > 1:  # on and off again: neither proves much without the other
        return False
    evidence = evidence_of(before.basis, state.named[terms[0]].candidate)
    return free.evidence > evidence + limits.lead_nats


def _bare(state: State, terms: list[int]) -> Base:
    """The basis without these terms, what they explain put back."""
    bare = formed_basis_of(state)
    for k in terms:
        bare = bare.without(term_group(k), added_value(state, k))
    return bare


def dropped(
    state: State, surveys: list[Survey], terms: list[int], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state and surveys without these terms, and what is then left."""
    if not terms:
        return state, surveys, left
    kept = [k for k in range(len(state.named)) if k not in terms]
    before = unknown.remainder(_bare(state, terms))
    state = refitted(state, tuple(state.named[k] for k in kept))
    after = unknown.remainder(formed_basis_of(state))
    # without the names, what they stood for may have become noise
    left = after if unknown.detected(after, state.problem.limits) else before
    return state, [surveys[k] for k in kept], left
