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
from ahrsd.mismatch.findings import contribution, finding, whole_term
from ahrsd.mismatch.limits import LIMITS, Limits
from ahrsd.mismatch.locate import Frame
from ahrsd.mismatch.null import NullFit, fit_null
from ahrsd.mismatch.regression import Base, candidate_gram
from ahrsd.mismatch.score import score
from ahrsd.mismatch.search import (
    Problem,
    State,
    Survey,
    basis_of,
    forward,
    problem_of,
    pruned,
    refitted,
    survey,
    swapped,
    term_group,
)
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import NullModel
from ahrsd.samples import Array

#: names that are a course in time and nothing else, by the frame that they act in
TIME_SHAPED: Mapping[Frame, tuple[str, ...]] = {
    "sensor": ("hard_iron_step", "hard_iron_drift", "switched_device", "soft_iron_step"),
    "world": ("field_step", "geomagnetic_drift", "field_anomaly"),
    "gyro": ("gyro_bias_step", "gyro_startup", "gyro_bias_drift"),
}
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
    problem, cold = problem_of(track, spec, library, limits)
    start = fit_null(problem.track, problem.spec, cold, walk=False)
    state, first, last = forward(State(problem, start))
    slim = pruned(state)
    last = last if slim.names == state.names else survey(slim)
    state, surveys, last = swapped(slim, last)
    state, surveys, left = without_stand_ins(state, surveys)
    basis = basis_of(state)
    found = tuple(finding(state, basis, k, seen, last) for k, seen in enumerate(surveys))
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
        terms=tuple(whole_term(state, basis, k, one.effect) for k, one in enumerate(found)),
        drawn=_drawn(start, state, basis, first, left),
    )


def without_stand_ins(
    state: State, surveys: list[Survey]
) -> tuple[State, list[Survey], unknown.Remainder]:
    """Names that only stand in for a course in time taken out again, and what is then left.

    Steps, drifts and bumps can imitate any course roughly.  They may stay where they explain nearly
    all of what their frame's own coefficients explain, and where a few of them do.
    """
    limits = state.problem.limits
    basis = basis_of(state)
    left = unknown.remainder(basis)
    for frame, names in TIME_SHAPED.items():
        shaped = [k for k, name in enumerate(state.names) if name in names]
        if not shaped:
            continue
        fires = unknown.detected(left, limits)
        bare = basis
        for k in shaped:
            bare = bare.without(term_group(k), state.fit.terms[k].value)
        before = unknown.remainder(bare, with_bins=False).located[frame].statistic
        covered = 1.0 - left.located[frame].statistic / max(before, 1e-300)
        if (fires and covered < limits.coverage) or len(shaped) > limits.most_shaped:
            kept = [k for k in range(len(state.named)) if k not in shaped]
            state = refitted(state, tuple(state.named[k] for k in kept))
            surveys = [surveys[k] for k in kept]
            basis = basis_of(state)
            left = unknown.remainder(basis)
    return state, surveys, left


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
