"""One diagnosis: null fit, names with a joint refit after each, what is left, what it costs.

hygiene -> null fit -> survey -> (name -> joint refit -> survey)* -> prune -> swap
        -> what no name explains -> findings, or what this recording would have shown
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.mismatch import roles, unknown
from ahrsd.mismatch.diagnosis import (
    Baseline,
    Diagnosis,
    Drawn,
    Limit,
    Unexplained,
)
from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.findings import contribution, finding
from ahrsd.mismatch.limits import LIMITS, Limits
from ahrsd.mismatch.null import NullFit, cold_start, fit_null
from ahrsd.mismatch.regression import Base, candidate_gram
from ahrsd.mismatch.score import score
from ahrsd.mismatch.search import (
    Problem,
    State,
    Survey,
    basis_of,
    forward,
    noise_of_thinned,
    pruned,
    swapped,
)
from ahrsd.mismatch.thin import thin_factor, thinned
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import NullModel, Term
from ahrsd.samples import Array

#: rows per second that the search works with; faster recordings are averaged down to it
WORKING_HZ = 12.0
#: a detection limit is this many standard deviations: what the gate would pass 9 times in 10
DETECTED_AT = 6.5


def diagnose(
    track: Track,
    spec: Spec | None = None,
    *,
    simulation: Track | None = None,
    library: Mapping[str, Effect] = EFFECTS,
    limits: Limits = LIMITS,
    recording: str = "",
) -> Diagnosis:
    """Where the recording and the model differ, and which physics was left out.

    Deterministic.  simulation: the user's own, whose calibration is then the one to start from.
    """
    spec = spec or Spec()
    track, notes = roles.prepared(track)
    problem, start = _prepared(track, spec, library, limits)
    state, first, _ = forward(problem, start)
    state = pruned(problem, state)
    state, surveys = swapped(problem, state)
    basis = basis_of(problem, state)
    left = unknown.remainder(basis)
    found = tuple(finding(library, state, basis, k, seen) for k, seen in enumerate(surveys))
    something = unknown.detected(left, limits)
    unexplained = (
        unknown.described(basis, left, problem.block_s, limits) if something else Unexplained(False)
    )
    return Diagnosis(
        recording=recording,
        baseline=_baseline(start),
        mismatch=bool(found) or something,
        p_value=_p_value(first, left),
        findings=tuple(sorted(found, key=lambda one: -one.heldout.nll_gain_per_sample)),
        unexplained=unexplained,
        posterior_predictive={},
        sensitivity=() if found or something else sensitivity(problem, basis, first),
        notes=notes,
        model=state.fit.model,
        terms=_terms(state),
        drawn=_drawn(start, state, basis, first, left),
    )


def _prepared(
    track: Track, spec: Spec, library: Mapping[str, Effect], limits: Limits
) -> tuple[Problem, NullFit]:
    """The recording at working rate, and the calibration alone fitted to it."""
    cold = cold_start(track, spec)
    m = thin_factor(track, WORKING_HZ)
    work = thinned(track, m, cold)
    known = noise_of_thinned(spec, m)
    root = float(np.sqrt(m))
    start = replace(
        cold,
        sigma_mag_gauss=cold.sigma_mag_gauss / root,
        sigma_gyro_rad_s=cold.sigma_gyro_rad_s / root,
    )
    return Problem(work, known, library, limits), fit_null(work, known, start)


def sensitivity(problem: Problem, basis: Base, first: Survey) -> tuple[Limit, ...]:
    """The smallest value of every parameter that this recording would have shown."""
    gram, _ = candidate_gram(basis, first.candidates, problem.track.duration_s)
    projected = gram.project(list(basis.groups))
    out = []
    for candidate in first.candidates:
        what = score(projected, candidate.name, candidate.scale)
        sigma = np.sqrt(np.diag(what.covariance)) if what.rank else np.zeros(len(candidate.scale))
        hidden = _hidden(what.basis, candidate.scale)
        for k, parameter in enumerate(candidate.effect.parameters):
            smallest = None if hidden[k] else float(DETECTED_AT * sigma[k] * basis.colour**0.5)
            out.append(Limit(candidate.name, parameter.name, smallest, parameter.unit))
    return tuple(out)


def _hidden(directions: Array, scale: Array) -> NDArray[np.bool]:
    """(p,) parameters that are mostly outside the observable directions (p, r)."""
    seen = np.sum((directions / scale[:, None]) ** 2, axis=1)
    return np.asarray(seen < 0.5)


def _baseline(start: NullFit) -> Baseline:
    done = start.filtered
    return Baseline(
        float(np.sqrt(np.mean(done.innovation[done.used] ** 2))),
        float(-np.mean(done.log_likelihood[done.used])),
        done.normalised_innovation,
    )


def _p_value(first: Survey, left: unknown.Remainder) -> float:
    """The smallest family-wise probability of all tests."""
    named = [judged.family_p for judged in first.judged if judged.accepted]
    frames = [min(1.0, 3.0 * one.p_value) for one in left.located.values()]
    bins = [min(1.0, len(left.bins) * p) for _, _, p in left.bins]
    return float(min([1.0, *named, *frames, *bins]))


def _terms(state: State) -> tuple[Term, ...]:
    return tuple(
        Term(
            term.identifier,
            term.value,
            np.zeros_like(term.value) if term.deviation is None else term.deviation,
            term.setting,
        )
        for term in state.fit.terms
    )


def _drawn(
    start: NullFit, state: State, basis: Base, first: Survey, left: unknown.Remainder
) -> Drawn:
    contributions = {
        f"{judged.candidate.name} {k}": contribution(judged, term.value, basis)
        for k, (judged, term) in enumerate(zip(state.named, state.fit.terms, strict=True))
    }
    return Drawn(
        basis.context.track.time_s,
        start.filtered.whitened,
        state.fit.filtered.whitened,
        contributions,
        tuple(left.located.values()),
        {candidate.name: candidate.evidence for candidate in first.candidates},
    )


def model_at_rate(model: NullModel, m: int) -> NullModel:
    """A model of averages of m samples as one of single samples."""
    root = float(np.sqrt(m))
    return replace(
        model,
        sigma_mag_gauss=model.sigma_mag_gauss * root,
        sigma_gyro_rad_s=model.sigma_gyro_rad_s * root,
    )
