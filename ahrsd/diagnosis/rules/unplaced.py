"""A slow wave of the field outside, where nobody logged the position.

The way of a vehicle through a field that differs from place to place is a slow course of the
outside field, and most of any slow course is a wave of some length and phase: without positions it
is not to be told from a pulsation of the Earth's field, and is no name.  Bumps of the outside
field and iron that remembers, beside such a wave, are the rest of that course unless they are
likelier than the whole of it: on parallel legs a place is a function of the headings before it.
"""

from __future__ import annotations

from dataclasses import replace

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, Survey, formed_basis_of, refitted
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.stand_ins import TIME_SHAPED, frame_of

#: names that a course in the world and the headings on it have in common
REMEMBER = ("viscous_magnetisation", "hysteresis", "earth_rotation")


def without_unplaced(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such a wave, and without what is only the rest of its course."""
    names = [judged.candidate for judged in state.named]
    waves = [k for k, name in enumerate(names) if name.setting.get("shape") == "wave"]
    if not waves or "position_north_m" in state.problem.track.covariates:
        return state, surveys, left
    doubtful = [k for k, name in enumerate(names) if k in waves or _of_such_a_course(name)]
    bare = refitted(state, tuple(j for k, j in enumerate(state.named) if k not in doubtful))
    whole = unknown.remainder(formed_basis_of(bare))
    likelier = whole.strongest.evidence
    others = [k for k in doubtful if k not in waves]
    if any(evidence_of(whole.basis, names[k]) > likelier for k in others):
        doubtful = waves
        bare = refitted(state, tuple(j for k, j in enumerate(state.named) if k not in waves))
        whole = unknown.remainder(formed_basis_of(bare))
    kept = [one for k, one in enumerate(surveys) if k not in doubtful]
    if not unknown.detected(whole, state.problem.limits):
        whole = replace(whole, stood_in=frame_of(state, waves[0]))
    return bare, kept, whole


def _of_such_a_course(name: Candidate) -> bool:
    return name.name in (*TIME_SHAPED["world"], *REMEMBER) and "place_m" not in name.setting
