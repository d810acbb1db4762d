"""Forward selection: which name is next, when a bias that changes is noise, steps seen together."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.resting import ORDINARY_WALK_RAD_S_SQRT_S
from ahrsd.diagnosis.innovation_filter.score import Score
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.name import ROBUST, Judged, judge
from ahrsd.diagnosis.rules.nested import simplest
from ahrsd.diagnosis.rules.regression import Candidate, candidate_gram, columns_of, quieter
from ahrsd.diagnosis.rules.search import (
    FRAME_LEAD,
    STEPS,
    WANDERING,
    State,
    Survey,
    added,
    at_model,
    formed_basis_of,
    refitted,
    shaped_again,
    survey,
    term_group,
)
from ahrsd.diagnosis.rules.settings import closest_onset
from ahrsd.diagnosis.rules.unknown import course, detected, remainder
from ahrsd.diagnosis.rules.validate import Gain
from ahrsd.samples import Array

#: names of a changing gyro bias that have a cause or a moment, which a random walk has not
CAUSED = ("gyro_startup", "gyro_bias_temperature", "gyro_bias_step")
#: a field outside that turns slowly
SLOWLY_TURNED = "geomagnetic_drift"
#: effects of one thing of which several logged columns may be measures: vibration, a temperature
ONE_CAUSE = (
    "vibration_rectification",
    "gyro_bias_temperature",
    "mag_bias_temperature",
    "mag_scale_temperature",
)
#: part of the first one's evidence from which a second column is a second cause
SECOND_MEASURE = 0.05
#: walks that a cause is held against, rad/s per root second, up to the most that is noise
WALKS = tuple(noise_fit.WALK_CAP_RAD_S_SQRT_S / 2.0**k for k in (0.0, 1.0, 2.0, 3.0))
#: how often the times of steps are sought again in the joint fit
STEP_PASSES = 2


def forward(state: State) -> tuple[State, Survey, Survey]:
    """Name one effect after the other until nothing passes; the first and the last survey.

    Before a gyro bias that changes is given a name, the null may wander as an ordinary gyro does:
    noise is no physics, unless a cause is far more likely.
    """
    first = last = survey(state)
    closer = 0  # names for which the shapes have been sought again before one came twice
    broken: set[str] = set()  # names that the joint fit does not bear out beside those given
    while len(state.named) < state.problem.limits.most_terms:
        accepted = [j for j in last.judged if j.accepted and j.candidate.name not in broken]
        accepted = [j for j in accepted if not _measured_again(state, j)]
        if not accepted:
            more = _cause_after_all(state, last)
            more = stepped(state) if more is state else more
            if more is state:
                break
            state, last = more, survey(more)
            continue
        best = _which_change(simplest(accepted), state, last, broken)
        if best.candidate.name in state.names and closer < len(state.named):
            state, closer = shaped_again(state, newest=True), len(state.named)
        elif not state.walk and _may_wander(best, last, state.problem.limits):
            state = noise_or_cause(state, best, last)
        else:
            tried = added(state, best)
            if not borne_out(state, tried, best, last):
                broken.add(best.candidate.name)
                continue
            state = tried
        broken, last = set(), survey(state)
    return state, first, last


def _may_wander(best: Judged, seen: Survey, limits: Limits) -> bool:
    """Whether a name may be a gyro's bias that wanders: one of that, or as likely.

    A slow drift of the outside field turns it as the bias does: of 24.6 nats for one, where a bias
    that drifts has 22.4, half a nat is left beside an ordinary walk.
    """
    if best.candidate.name in WANDERING:
        return True
    bias = max((c.evidence for c in seen.candidates if c.name in WANDERING), default=0.0)
    return best.candidate.name == SLOWLY_TURNED and bias > best.evidence - limits.lead_nats


def _which_change(best: Judged, state: State, seen: Survey, broken: Set[str]) -> Judged:
    """Of a gyro bias that surely changes the likeliest name, though few blocks show it.

    broken: names that the joint fit does not bear out

    That the bias changes beyond what an ordinary one wanders is proven by a name that passes.  How
    is for the evidence to say, also of a name whose own blocks are too few to know each other.
    """
    if best.candidate.name != WANDERING[0] or not state.walk:
        return best
    asked = [judged for judged in seen.judged if judged.candidate.name not in broken]
    likeliest = max(asked, key=lambda judged: judged.evidence, default=best)
    few = likeliest.candidate.name in CAUSED and likeliest.refused == (ROBUST,)
    ahead = likeliest.evidence > best.evidence + state.problem.limits.lead_nats
    return likeliest if few and ahead else best


def _measured_again(state: State, judged: Judged) -> bool:
    """Whether a name is there already by another measure of the same cause, and small beside it.

    How it shakes is told by the shaft's speed and by the current, neither exactly: the second says
    what the first is off by, and then neither has a size of its own.
    """
    if judged.candidate.name not in ONE_CAUSE:
        return False
    there = [one.evidence for one in state.named if one.candidate.name == judged.candidate.name]
    return bool(there) and judged.evidence < SECOND_MEASURE * max(there)


def borne_out(state: State, tried: State, judged: Judged, seen: Survey) -> bool:
    """Whether a name still has its evidence after the joint fit with it (`tried`).

    seen: the survey of the state, whose evidence is in the noise that its strongest leaves.

    Evidence is of a linear model.  Where the calibration takes nearly all of an effect, the little
    that is left wants coefficients that are far from linear: its statistic promises what no fit
    gains, and what the fit then leaves would be given names of its own.
    """
    if judged.candidate.name in DELAYS:
        return True  # another track
    gained = likelihood(tried) - likelihood(state)
    gained = max(gained, tried.fit.log_likelihood - state.fit.log_likelihood)
    short = max(0.0, judged.what.statistic / 2 - gained) / noise_in(seen)
    return judged.evidence - short > state.problem.limits.evidence_nats


def noise_in(seen: Survey) -> float:
    """Power of the noise in which a survey's evidence is, over white: what its strongest leaves."""
    strongest = seen.candidates[0]
    return quieter(seen.basis, columns_of(seen.basis, [strongest])[strongest.name]).colour


def noise_or_cause(state: State, judged: Judged, seen: Survey) -> State:
    """The state with a bias that wanders, or with its cause where that is likelier by far.

    A walk is free to follow any cause, and then none is needed.  Nor is one where the few modes of
    a walk explain nearly as much; a step that may be anywhere is what a walk looks like soonest.
    It must gain by as much as what nobody knows would have to, on a walk of the likeliest size.
    """
    noisy = refitted(replace(state, walk=ORDINARY_WALK_RAD_S_SQRT_S), state.named)
    limits = state.problem.limits
    cause = _cause(judged, seen, limits)
    if cause is None:
        return noisy
    named = added(state, cause)
    gained = likelihood(named) - max(likelihood(noisy), *(_wandering(noisy, of) for of in WALKS))
    return named if gained > limits.unknown_nats else noisy


def _cause(judged: Judged, seen: Survey, limits: Limits) -> Judged | None:
    """The name that a walk is held against, if one is: near enough to the few modes of a walk."""
    if judged.candidate.name == STEPS["gyro"]:
        walk = max((c.evidence for c in seen.candidates if c.name == WANDERING[0]), default=0.0)
        return judged if judged.candidate.evidence >= walk + 2.0 * limits.lead_nats else None
    least = judged.evidence - limits.lead_nats
    near = (j for j in seen.judged if j is judged or (j.accepted and j.evidence >= least))
    smooth = (j for j in near if j.candidate.name in CAUSED and j.candidate.name != STEPS["gyro"])
    return max(smooth, key=lambda j: j.evidence, default=None)


def _wandering(state: State, walk: float) -> float:
    """Log likelihood of the state with its bias wandering by that much, rad/s per root second."""
    model = replace(state.fit.model, gyro_walk_rad_s_sqrt_s=walk)
    return likelihood(replace(state, fit=at_model(state.problem.track, model, state.fit.terms)))


def _cause_after_all(state: State, seen: Survey) -> State:
    """The state with a cause in place of the bias that wanders, where that is likelier by now.

    Asked while another name was still missing, a walk had the rest of that to follow, too.
    """
    likeliest = seen.candidates[:1]
    if not state.walk or not likeliest or likeliest[0].name not in CAUSED:
        return state
    if likeliest[0].evidence < state.problem.limits.unknown_nats:
        return state
    still = refitted(replace(state, walk=0.0), state.named)
    again = survey(still)
    accepted = [judged for judged in again.judged if judged.accepted]
    if not accepted or accepted[0].candidate.name != likeliest[0].name:
        return state
    tried = noise_or_cause(still, accepted[0], again)
    return state if tried.walk else shaped_again(tried, newest=True)


def likelihood(state: State) -> float:
    """Log likelihood of a fit with its noise scaled to what it leaves, nats."""
    fit = state.fit
    size, count = fit.filtered.normalised_innovation, 3 * np.count_nonzero(fit.filtered.used)
    return fit.log_likelihood + 0.5 * float(count * (size - 1.0 - np.log(max(size, 1e-12))))


def ahead(one: tuple[State, Judged], other: tuple[State, Judged], seen: Survey) -> float:
    """Nats by which a state with one name is likelier than one with another in its place.

    By the joint fits.  Coefficients are paid for as in the survey without either, `seen`.
    """
    noise = noise_in(seen)

    def nats(state: State, judged: Judged) -> float:
        paid = float(judged.what.statistic) / 2 / noise - judged.evidence
        return likelihood(state) / noise - paid

    return nats(*one) - nats(*other)


def stepped(state: State) -> State:
    """Steps where the strongest frame's course changes, if a few of them explain nearly all of it.

    A large jump, and more so one and back again, spoils the calibration so thoroughly that no test
    of a single step sees it; the course does.  Fitted together, each must still prove itself.
    """
    left = remainder(formed_basis_of(state), with_bins=False)
    limits = state.problem.limits
    effect = state.problem.library.get(STEPS[left.strongest.frame])
    others = [one.evidence for one in left.located.values() if one is not left.strongest]
    clear = left.strongest.evidence > max(others) + FRAME_LEAD
    if effect is None or not clear or not detected(left, limits):
        return state
    seen = course(left)
    if not 0 < len(seen.changes_s) <= limits.most_shaped or seen.covered < limits.coverage:
        return state
    scale = np.array([parameter.scale for parameter in effect.parameters])
    named = tuple(
        _unjudged(Candidate(effect, {"onset_s": time_s}, 1, 0.0), scale)
        for time_s in seen.changes_s
    )
    tried = refitted(state, (*state.named, *named))
    for _ in range(STEP_PASSES):
        tried = _judged_again(tried, len(state.named))
    kept = tuple(j for j in tried.named if j.accepted)
    return refitted(tried, kept) if len(kept) > len(state.named) else state


def _unjudged(candidate: Candidate, scale: Array) -> Judged:
    nothing = np.zeros((0, 0))
    what = Score(
        np.zeros((len(scale), 0)), np.zeros(0), np.zeros(0), nothing, nothing, np.zeros(0), 1.0
    )
    return Judged(candidate, what, 0.0, 1.0, 1.0, Gain(0.0, 0.0), 0.0, 0.0, ("not judged",))


def _judged_again(state: State, first: int) -> State:
    """Terms from number `first` on with their onsets sought again, all fitted and judged."""
    basis = formed_basis_of(state)
    named = list(state.named)
    for k in range(first, len(named)):
        left = basis.without(term_group(k), state.fit.terms[k].value)
        at = named[k].candidate
        near = closest_onset(left, at, 0.02 * state.problem.track.duration_s)
        columns = columns_of(left, [near])
        gram = candidate_gram(left, columns, state.problem.block_s)
        named[k] = judge(near, gram, columns[near.name], left, 1, state.problem.limits)
    return refitted(state, tuple(named))
