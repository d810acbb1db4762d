"""Names that only stand in for a course in time: steps, drifts and bumps of an unlogged source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ahrsd.mismatch import unknown
from ahrsd.mismatch.findings import added_value
from ahrsd.mismatch.locate import Frame
from ahrsd.mismatch.regression import Base, evidence_of
from ahrsd.mismatch.search import State, Survey, basis_of, refitted, term_group

#: names that are a course in time and nothing else, by the frame that they act in
TIME_SHAPED: Mapping[Frame, tuple[str, ...]] = {
    "sensor": ("hard_iron_step", "hard_iron_drift", "switched_device", "soft_iron_step"),
    "world": ("field_step", "geomagnetic_drift", "field_anomaly"),
    "gyro": ("gyro_bias_step", "gyro_startup", "gyro_bias_drift"),
}


def without_stand_ins(
    state: State, surveys: list[Survey]
) -> tuple[State, list[Survey], unknown.Remainder]:
    """Names that only stand in for a course in time taken out again, and what is then left.

    Steps, drifts and bumps can imitate any course roughly.  They may stay where they explain nearly
    all of what their frame's own coefficients explain, and where a few of them do.  A gyro whose
    bias wanders as an ordinary one's does is noise.
    """
    limits = state.problem.limits
    left = unknown.remainder(basis_of(state))
    if not state.walk and left.strongest.frame == "gyro" and unknown.detected(left, limits):
        state = refitted(replace(state, walk=True), state.named)
        left = unknown.remainder(basis_of(state))
    for frame, names in TIME_SHAPED.items():
        shaped = [k for k, name in enumerate(state.names) if name in names]
        doubtful = shaped if len(shaped) > limits.most_shaped else []
        if shaped and not doubtful:
            doubtful = shaped if _stand_in(state, frame, shaped, left) else []
        state, surveys, left = _dropped(state, surveys, doubtful, left)
    return state, surveys, left


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
    if len(terms) > 1:  # on and off again: neither proves much without the other
        return False
    evidence = evidence_of(before.basis, state.named[terms[0]].candidate)
    return free.evidence > evidence + limits.lead_nats


def _bare(state: State, terms: list[int]) -> Base:
    """The basis without these terms, what they explain put back."""
    bare = basis_of(state)
    for k in terms:
        bare = bare.without(term_group(k), added_value(state, k))
    return bare


def _dropped(
    state: State, surveys: list[Survey], terms: list[int], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    if not terms:
        return state, surveys, left
    kept = [k for k in range(len(state.named)) if k not in terms]
    before = unknown.remainder(_bare(state, terms))
    state = refitted(state, tuple(state.named[k] for k in kept))
    after = unknown.remainder(basis_of(state))
    # without the names, what they stood for may have become noise
    left = after if unknown.detected(after, state.problem.limits) else before
    return state, [surveys[k] for k in kept], left
