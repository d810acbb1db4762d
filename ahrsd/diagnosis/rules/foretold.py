"""Names that say nothing of parts of the recording to which they were not fitted.

A term of evidence E explains (lambda + p) / 2 nats in all, of which its p coefficients cost about
half the logarithm of what is known of each: more than the p / 2 (1 + 1 / 4) that they cost where
fifths are held out.  So a true name gains E or more there, give or take sqrt(lambda).  A name that
gains a small part of it, and no more than nothing or than its own copies moved in time, has the
form of something else as it happened to be once.

That holds for what is driven by the motion or by a logged cause: every fifth has its own, and the
coefficients are the same.  It does not for a course in time.  A step with its onset in the last
fifth is zero in the others; one after which the vehicle stands has its size from the very
rows that are held out; a bump lies in one fifth alone.  Those are never asked.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.findings import added_value, with_all_else
from ahrsd.diagnosis.rules.heldout import gain_of
from ahrsd.diagnosis.rules.often import logged_often
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.reweighted import reweighted
from ahrsd.diagnosis.rules.search import WANDERING, State, Survey
from ahrsd.diagnosis.rules.stand_ins import IN_TIME, dropped, frame_of
from ahrsd.diagnosis.rules.validate import Gain

#: part of its evidence that a name must gain on what was held out, if it gains no more than its
#: moved copies.  Of 181 names of 279 simulated and real recordings nine gained no more: six field
#: steps, which are not asked, a true rotor with all of its evidence, and two false names with 0.14
#: of it and less; of true names that gained no more, another had 0.62
FORETOLD = 0.25
#: share of the rows with a reading below which nothing is asked: a fifth with a hole in it is not
#: like the others (a true current whose column has a hole gained less than nothing)
READ = 0.95


def without_unforetold(
    state: State, surveys: list[Survey], left: unknown.Remainder, *, known: int
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without such names, one at a time, the worst first; what they explained is unknown.

    known: how many of the names, the first ones, were found in white noise, the others against the
           spectrum of what is left.  A delay among those is not asked: in white noise what is left
           bends the calibration of four fifths by more than it is worth in the fifth
    """
    beside = len(state.named) > known
    while True:
        rest = left.strongest.evidence if unknown.detected(left, state.problem.limits) else 0.0
        shares = [
            1.0
            if _logged_amid(state, k, rest) or (k >= known and state.names[k] in DELAYS)
            else share_foretold(state, k, seen)
            for k, seen in enumerate(surveys)
        ]
        worst = min(range(len(shares)), key=lambda k: shares[k], default=0)
        if not shares or shares[worst] >= FORETOLD:
            return state, surveys, left
        frame, known = frame_of(state, worst), known - (worst < known)
        state, surveys, left = dropped(state, surveys, [worst], left)
        if beside and state.named:
            state = reweighted(state)
        if not unknown.detected(left, state.problem.limits):
            left = replace(left, stood_in=frame)


def _logged_amid(state: State, number: int, rest: float) -> bool:
    """Whether it is a strong name by a logged cause that changes often, amid a rest.

    The rest bends the calibration of four fifths by more than the name is worth in the fifth.
    A weak name may be what a moment of the rest has in common with the cause.
    """
    judged, limits = state.named[number], state.problem.limits
    strong = max(limits.beyond_nats, rest / 10) < judged.evidence < 2 * rest
    return strong and logged_often(state.problem.track, judged.candidate)


def share_foretold(state: State, number: int, seen: Survey) -> float:
    """Part of a name's evidence that it gains on what was held out; 1 where nothing is to be asked.

    Nor is anything where it gains more than nothing and than its moved copies.
    """
    judged, used = state.named[number], state.fit.filtered.used
    if in_time_alone(judged.candidate) or np.mean(used) < READ:
        return 1.0
    value, scale = added_value(state, number), judged.candidate.scale
    gain = gain_of(state.fit, number, value, scale, white=True)  # evidence has paid for the colour
    if gain is None:
        return 1.0
    count = int(np.count_nonzero(used))
    return part_of(gain, with_all_else(judged, seen).placebo_gain, judged.evidence, count)


def part_of(gain: Gain, placebo_gain: float, evidence: float, count: int) -> float:
    """The same of a gain and its copies', nats per row of `count`."""
    if gain.nats_per_sample > max(0.0, placebo_gain):
        return 1.0
    return gain.nats_per_sample * count / max(evidence, 1e-9)


def in_time_alone(candidate: Candidate) -> bool:
    """Whether a candidate begins at a moment of its own, or is a course in time."""
    return "onset_s" in candidate.setting or candidate.name in {*WANDERING, *IN_TIME}
