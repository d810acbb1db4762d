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

from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.evidence import colour
from ahrsd.mismatch.limits import Limits
from ahrsd.mismatch.name import Judged, judge
from ahrsd.mismatch.null import FittedTerm, NullFit, fit_null
from ahrsd.mismatch.regression import (
    Base,
    Candidate,
    base,
    best_settings,
    candidate_gram,
)
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import NullModel
from ahrsd.samples import Array

BLOCKS = 80
BLOCK_S = (2.0, 10.0)
#: candidates that are held against the gate in one round, strongest first
LOOKED_AT = 8
#: prior of a term in the joint fit, in its own prior deviations: next to none
LOOSE = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is asked: the track, what is known of the sensor, the library, the thresholds."""

    track: Track
    spec: Spec
    library: Mapping[str, Effect]
    limits: Limits

    @property
    def rate_hz(self) -> float:
        """Rows per second."""
        return 1.0 / float(np.nanmedian(self.track.dt_s))

    @property
    def block_s(self) -> float:
        """Length of the Gram's blocks: about 80, longer than correlated noise where possible."""
        return float(np.clip(self.track.duration_s / BLOCKS, *BLOCK_S))


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A fit with its named terms, in the order in which they were named."""

    fit: NullFit
    named: tuple[Judged, ...] = ()

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


def basis_of(problem: Problem, state: State) -> Base:
    """Whitened columns of calibration and terms at the state's fit."""
    context = state.fit.context()
    terms = [(term_group(k), term.columns(context)) for k, term in enumerate(state.fit.terms)]
    whitened = state.fit.filtered.whitened
    return base(context, state.fit.filtered, terms, colour(whitened, problem.rate_hz))


def survey(problem: Problem, state: State, basis: Base | None = None) -> Survey:
    """Every effect in its best setting, and the strongest of them held against the gate."""
    basis = basis or basis_of(problem, state)
    taken = [(j.candidate.name, j.candidate.setting) for j in state.named]
    candidates = best_settings(basis, problem.library, taken)
    near = [c for c in candidates if c.evidence > problem.limits.evidence_nats][:LOOKED_AT]
    if not near:
        return Survey(basis, tuple(candidates), ())
    gram, columns = candidate_gram(basis, near, problem.block_s)
    judged = [judge(c, gram, columns[c.name], basis, len(candidates), problem.limits) for c in near]
    return Survey(basis, tuple(candidates), tuple(judged))


def forward(problem: Problem, start: NullFit) -> tuple[State, Survey, Survey]:
    """Name one effect after the other until nothing passes; the first and the last survey."""
    state = State(start)
    first = last = survey(problem, state)
    while len(state.named) < problem.limits.most_terms:
        accepted = [judged for judged in last.judged if judged.accepted]
        if not accepted:
            break
        state = added(problem, state, accepted[0])
        last = survey(problem, state)
    return state, first, last


def added(problem: Problem, state: State, judged: Judged) -> State:
    """The state with one more term, everything fitted together."""
    return refitted(problem, state.fit.model, (*state.named, judged), state.fit.terms)


def refitted(
    problem: Problem,
    start: NullModel,
    named: tuple[Judged, ...],
    terms: tuple[FittedTerm, ...] = (),
) -> State:
    """Calibration, noise and the given terms fitted together, from where the last fit ended."""
    known = {(term.identifier, str(term.setting)): term for term in terms}
    fitted = []
    for judged in named:
        term = fitted_term(judged.candidate, judged.what.value)
        fitted.append(known.get((term.identifier, str(term.setting)), term))
    return State(fit_null(problem.track, problem.spec, start, tuple(fitted)), named)


def fitted_term(candidate: Candidate, value: Array) -> FittedTerm:
    """A candidate as a term of the joint fit."""
    return FittedTerm(
        identifier=candidate.name,
        columns=partial(candidate.effect.columns, setting=candidate.setting),
        value=value,
        scale=LOOSE * candidate.scale,
        setting=dict(candidate.setting),
    )


def pruned(problem: Problem, state: State) -> State:
    """Terms that the others have made superfluous taken out, one at a time."""
    while state.named:
        weakest, evidence = None, problem.limits.evidence_nats
        basis = basis_of(problem, state)
        for k, judged in enumerate(state.named):
            left = basis.without(term_group(k), state.fit.terms[k].value)
            gram, columns = candidate_gram(left, [judged.candidate], problem.block_s)
            again = judge(
                judged.candidate, gram, columns[judged.candidate.name], left, 1, problem.limits
            )
            if again.evidence < evidence:
                weakest, evidence = k, again.evidence
        if weakest is None:
            break
        kept = tuple(j for k, j in enumerate(state.named) if k != weakest)
        state = refitted(problem, state.fit.model, kept, state.fit.terms)
    return state


def swapped(problem: Problem, state: State) -> tuple[State, list[Survey]]:
    """Each term held against every other name for what it explains; surveys without each term.

    A term gives way to another that explains the same better by the lead that makes a name
    certain; the new one is fitted in its place.
    """
    surveys: list[Survey] = []
    for k in range(len(state.named)):
        basis = basis_of(problem, state)
        left = basis.without(term_group(k), state.fit.terms[k].value)
        others = tuple(j for i, j in enumerate(state.named) if i != k)
        seen = survey(problem, State(state.fit, others), left)
        mine = max(
            (c.evidence for c in seen.candidates if c.name == state.named[k].candidate.name),
            default=0.0,
        )
        better = [
            j
            for j in seen.judged
            if j.accepted
            and j.evidence > mine + problem.limits.lead_nats
            and j.candidate.name != state.named[k].candidate.name
        ]
        if better:
            named = (*state.named[:k], better[0], *state.named[k + 1 :])
            state = refitted(problem, state.fit.model, named, state.fit.terms)
        surveys.append(seen)
    return state, surveys


def noise_of_thinned(spec: Spec, m: int) -> Spec:
    """What is known of the noise, for averages of m samples."""
    root = float(np.sqrt(m))
    return replace(
        spec,
        sigma_mag_gauss=None if spec.sigma_mag_gauss is None else spec.sigma_mag_gauss / root,
        sigma_gyro_rad_s=None if spec.sigma_gyro_rad_s is None else spec.sigma_gyro_rad_s / root,
    )
