"""Forward selection with a joint refit after each name, then pruning and swapping.

A name changes what all the others explain, and outside the linear range (a misalignment of three
degrees) an unrefitted model invents terms: so every accepted term is fitted together with the
calibration before the library is asked again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd.mismatch import noise_fit
from ahrsd.mismatch.delays import DELAYS, plain
from ahrsd.mismatch.late import in_time
from ahrsd.mismatch.locate import Frame
from ahrsd.mismatch.name import Judged, judge
from ahrsd.mismatch.null import FittedTerm, NullFit, fit_null
from ahrsd.mismatch.problem import Problem
from ahrsd.mismatch.regression import (
    Base,
    Candidate,
    base,
    best_settings,
    candidate_gram,
    closest_onset,
    closest_scale,
    columns_of,
    scale_of,
)
from ahrsd.mismatch.score import Score
from ahrsd.mismatch.unknown import course, detected, remainder
from ahrsd.mismatch.validate import Gain
from ahrsd.samples import Array

#: candidates that are held against the gate in one round, strongest first
LOOKED_AT = 8
#: prior of a term in the joint fit, in its own prior deviations: next to none
LOOSE = 30.0
#: 1 - |mean direction| of the field in the sensor: directions within about 5 degrees
REST_SPREAD = 4e-3
#: nats by which a frame must lead before steps in it are believed
FRAME_LEAD = 10.0
#: a jump in each frame, and how often its time is sought again in the joint fit
STEPS: Mapping[Frame, str] = {
    "sensor": "hard_iron_step",
    "world": "field_step",
    "gyro": "gyro_bias_step",
}
STEP_PASSES = 2
#: by how much a time constant's logarithm may still change in the joint fit
SCALE_AGAIN = 0.3
#: steps that cancel to this share are one thing that was put on and taken off again
CANCELS = 0.25
#: nats that such a coincidence of three coefficients is worth
COUNTERPART_NATS = 3 * float(np.log(1 / CANCELS))
SMALL_LAG_S = 2e-3
LAG_STEPS = 3
#: a gyro bias that wanders by 20 deg/h in 400 s is noise of an ordinary gyro and gets no name
ORDINARY_WALK_RAD_S_SQRT_S = 5e-6
#: names of a gyro bias that changes with time alone
WANDERING = ("gyro_bias_drift", "gyro_bias_step", "gyro_startup", "gyro_bias_temperature")


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A fit with its named terms, in the order in which they were named.

    problem: with the lag that is taken out;  walk: whether the gyro's bias may wander
    """

    problem: Problem
    fit: NullFit
    named: tuple[Judged, ...] = ()
    walk: bool = False

    def lag_s(self, number: int) -> float:
        """The whole delay that a delay's term stands for, in the term's own sign."""
        term = self.fit.terms[number]
        return DELAYS[term.identifier] * self.problem.lag_s + float(term.value[0])

    @property
    def names(self) -> tuple[str, ...]:
        """Identifiers."""
        return tuple(judged.candidate.name for judged in self.named)


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """The library held against one state: all candidates, and those near the top judged."""

    basis: Base
    candidates: tuple[Candidate, ...]
    judged: tuple[Judged, ...]


def term_group(number: int) -> str:
    """Group of a named term in a Gram."""
    return f"term {number}"


def basis_of(state: State) -> Base:
    """Whitened columns of calibration and terms at the state's fit."""
    fit = state.fit
    if "basis" not in fit.made:
        context = fit.context()
        terms = [(term_group(k), term.columns(context)) for k, term in enumerate(fit.terms)]
        fit.made["basis"] = base(context, fit.filtered, terms, state.problem.rate_hz)
    basis: Base = fit.made["basis"]
    return basis


def survey(state: State, basis: Base | None = None) -> Survey:
    """Every effect in its best setting, and the strongest of them held against the gate."""
    problem = state.problem
    basis = basis or basis_of(state)
    taken = [(j.candidate.name, j.candidate.setting) for j in state.named]
    library = problem.library
    if at_rest(state.fit):
        library = {name: effect for name, effect in library.items() if effect.family == "gyro"}
    if any(name in DELAYS for name in state.names):
        library = {name: effect for name, effect in library.items() if name not in DELAYS}
    candidates = tuple(in_time(basis, c) for c in best_settings(basis, library, taken))
    near = [c for c in candidates if c.evidence > problem.limits.evidence_nats][:LOOKED_AT]
    if not near:
        return Survey(basis, candidates, ())
    columns = columns_of(basis, near)
    gram = candidate_gram(basis, columns, problem.block_s)
    judged = [judge(c, gram, columns[c.name], basis, len(candidates), problem.limits) for c in near]
    return Survey(basis, candidates, tuple(judged))


def at_rest(fit: NullFit) -> bool:
    """Whether the field hardly turns in the sensor: then only the gyro can be told about."""
    field = fit.filtered.nominal_b
    unit = field / np.maximum(np.linalg.norm(field, axis=1, keepdims=True), 1e-300)
    return bool(1.0 - np.linalg.norm(unit.mean(axis=0)) < REST_SPREAD)


def forward(state: State) -> tuple[State, Survey, Survey]:
    """Name one effect after the other until nothing passes; the first and the last survey.

    Before a gyro bias that changes is given a name, the null may wander as an ordinary gyro does:
    noise is no physics.
    """
    first = last = survey(state)
    while len(state.named) < state.problem.limits.most_terms:
        accepted = [judged for judged in last.judged if judged.accepted]
        if not accepted:
            more = stepped(state)
            if more is state:
                break
            state, last = more, survey(more)
            continue
        if accepted[0].candidate.name in WANDERING and not state.walk:
            state = refitted(replace(state, walk=True), state.named)
        else:
            state = added(state, accepted[0])
        last = survey(state)
    return state, first, last


def stepped(state: State) -> State:
    """Steps where the strongest frame's course changes, if a few of them explain nearly all of it.

    A large jump, and more so one and back again, spoils the calibration so thoroughly that no test
    of a single step sees it; the course does.  Fitted together, each must still prove itself.
    """
    left = remainder(basis_of(state), with_bins=False)
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
    basis = basis_of(state)
    named = list(state.named)
    for k in range(first, len(named)):
        left = basis.without(term_group(k), state.fit.terms[k].value)
        at = named[k].candidate
        near = closest_onset(left, at, 0.02 * state.problem.track.duration_s)
        columns = columns_of(left, [near])
        gram = candidate_gram(left, columns, state.problem.block_s)
        named[k] = judge(near, gram, columns[near.name], left, 1, state.problem.limits)
    return refitted(state, tuple(named))


def added(state: State, judged: Judged) -> State:
    """The state with one more term, everything fitted together."""
    name = judged.candidate.name
    if name not in DELAYS:
        return _scaled_again(refitted(state, (*state.named, judged)))
    step_s = float(np.nanmedian(state.problem.track.dt_s)) / 2
    lag_s = DELAYS[name] * float(judged.what.value[0])
    lag_s *= step_s if name == "gyro_integration" else 1.0
    effect = state.problem.library[plain(lag_s)]
    lag = replace(judged, candidate=replace(judged.candidate, effect=effect, setting={}))
    return _lag_taken_out(state, lag, lag_s)


def _scaled_again(state: State) -> State:
    """The newest term's time constant or radius sought once more, beside the fit with it."""
    last = len(state.named) - 1
    judged = state.named[last]
    if scale_of(judged.candidate) is None:
        return state
    left = basis_of(state).without(term_group(last), state.fit.terms[last].value)
    closer = closest_scale(left, judged.candidate, SCALE_AGAIN)
    if closer.setting == judged.candidate.setting:
        return state
    candidate = replace(judged.candidate, setting=closer.setting)
    return refitted(state, (*state.named[:last], replace(judged, candidate=candidate)))


def refitted(state: State, named: tuple[Judged, ...]) -> State:
    """Calibration, noise and the given terms fitted together, from where the last fit ended."""
    known = {(term.identifier, str(term.setting)): term for term in state.fit.terms}
    fitted = []
    for judged in named:
        value = judged.what.value
        if judged.candidate.name in DELAYS:  # the delay itself is out of the track
            value = np.zeros(1)
        term = fitted_term(judged.candidate, value)
        fitted.append(known.get((term.identifier, str(term.setting)), term))
    start, problem = state.fit.model, state.problem
    if state.walk:
        start = replace(start, gyro_walk_rad_s_sqrt_s=ORDINARY_WALK_RAD_S_SQRT_S)
    fit = fit_null(
        problem.track, problem.spec, start, tuple(fitted), noise=not state.walk, walk=state.walk
    )
    return replace(state, fit=fit, named=named)


def settled(state: State) -> State:
    """The state with its noise as large as it is where a walking bias has taken over a part of it.

    While names are sought it stays as it was: what is still to be named would count as noise.
    """
    if not state.walk:
        return state
    fit, problem = state.fit, state.problem
    again = noise_fit.rescaled(fit.filtered, problem.spec)
    if again.sigma_mag_gauss > fit.model.sigma_mag_gauss * (1 - noise_fit.SAME):
        return state
    fit = fit_null(problem.track, problem.spec, again, fit.terms, noise=False)
    return replace(state, fit=fit)


def _lag_taken_out(state: State, judged: Judged, lag_s: float) -> State:
    """A delay taken out of the track until what is left is linear; its term stays in the fit.

    State.lag_s is the whole of it.
    """
    sign = DELAYS[judged.candidate.name]
    named = (*state.named, judged)
    for _ in range(LAG_STEPS):
        problem = state.problem.lagging(state.problem.lag_s + lag_s)
        rest = fitted_term(judged.candidate, np.zeros(1))
        fit = replace(state.fit, terms=(*state.fit.terms[: len(named) - 1], rest))
        state = refitted(replace(state, problem=problem, fit=fit), named)
        lag_s = sign * float(state.fit.terms[len(named) - 1].value[0])
        if abs(lag_s) < SMALL_LAG_S:
            break
    return state


def fitted_term(candidate: Candidate, value: Array) -> FittedTerm:
    """A candidate as a term of the joint fit."""
    return FittedTerm(
        identifier=candidate.name,
        columns=partial(candidate.effect.columns, setting=candidate.setting),
        value=value,
        scale=LOOSE * candidate.scale,
        setting=dict(candidate.setting),
    )


def pruned(state: State) -> State:
    """Terms that the others have made superfluous taken out, one at a time."""
    while len(state.named) > 1:
        basis = basis_of(state)
        evidence = []
        for k, judged in enumerate(state.named):
            left = without_term(state, k, basis)
            columns = columns_of(left, [judged.candidate])
            gram = candidate_gram(left, columns, state.problem.block_s)
            own = columns[judged.candidate.name]
            again = judge(judged.candidate, gram, own, left, 1, state.problem.limits)
            evidence.append(again.evidence)
        weakest = int(np.argmin(evidence))
        if evidence[weakest] > state.problem.limits.evidence_nats:
            break
        state = refitted(state, tuple(j for k, j in enumerate(state.named) if k != weakest))
    return state


def swapped(state: State, last: Survey) -> tuple[State, list[Survey], Survey]:
    """Each term held against every other name for what it explains; surveys without each term.

    A term gives way to another that explains the same better by the lead that makes a name
    certain; the new one is fitted in its place.  last: the survey of the state, renewed if need be.
    """
    surveys: list[Survey] = []
    for k in range(len(state.named)):
        name = state.named[k].candidate.name
        seen, mine = _without(state, k, last.basis)
        least = mine + state.problem.limits.lead_nats
        better = [
            j
            for j in seen.judged
            if j.accepted and j.candidate.name != name and in_its_place(j.candidate, last) > least
        ]
        if better and name not in DELAYS and counterpart(state, k) is None:
            state = refitted(state, (*state.named[:k], better[0], *state.named[k + 1 :]))
            last = survey(state)
            seen, _ = _without(state, k, last.basis)
        surveys.append(seen)
    return state, surveys, last


def counterpart(state: State, number: int) -> int | None:
    """The step that takes back what this one brought, or the other way round."""
    name = state.names[number]
    if name not in STEPS.values():
        return None
    value = state.fit.terms[number].value
    for k, other in enumerate(state.names):
        if k != number and other == name:
            whole = np.linalg.norm(value) + np.linalg.norm(state.fit.terms[k].value)
            if 2 * np.linalg.norm(value + state.fit.terms[k].value) < CANCELS * whole:
                return k
    return None


def in_its_place(candidate: Candidate, last: Survey) -> float:
    """Evidence that a candidate has without a term and no more has with it: what both explain."""
    beside = {c.name: c.evidence for c in last.candidates}.get(candidate.name, 0.0)
    return candidate.evidence - max(0.0, beside)


def without_term(state: State, number: int, basis: Base | None = None) -> Base:
    """The basis with one term left out and all that it explains put back."""
    basis = basis or basis_of(state)
    value = state.fit.terms[number].value
    if state.named[number].candidate.name in DELAYS:
        value = np.array([state.lag_s(number)])
    return basis.without(term_group(number), value)


def _without(state: State, number: int, basis: Base) -> tuple[Survey, float]:
    """The survey without one term of the state's basis, and the term's own evidence in it."""
    left = without_term(state, number, basis)
    others = tuple(j for i, j in enumerate(state.named) if i != number)
    seen = survey(replace(state, named=others), left)
    name = state.named[number].candidate.name
    return seen, max((c.evidence for c in seen.candidates if c.name == name), default=0.0)
