"""Repeated linearisation and search, until the accepted effects no longer change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.components.effect_components import LAG, STEP_PIECES
from ahrsd.diagnosis.inference.decision import decision, members
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.inference.likelihood.directed_noise import DirectedNoise
from ahrsd.diagnosis.inference.likelihood.linearisation import (
    directed_noise_of_residual,
    omit_readings,
)
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis, Space
from ahrsd.diagnosis.inference.search.search_space import search_at_point
from ahrsd.samples import Array

#: largest number of linearisations, each with a search
ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class ModelSearchResult:
    """An answer, and the sets at the last linearisation point, from which it was chosen.

    source: noise along one direction beyond a sensor's own, None if there is none
    """

    answer: decision.Answer
    all_sets: Hypotheses
    space: Space
    source: DirectedNoise | None


def search_until_stable(
    found: richest_model.FittedPoint, library: Mapping[str, Effect]
) -> ModelSearchResult:
    """Search at the richest model, then at the accepted effects, until these no longer change."""
    all_sets, space, best = search_at_point(found, library, (), was_real=True)
    answer = decision.decide(all_sets, space, best, library)
    source = _find_directed_source(all_sets, answer.best)
    for _ in range(ROUNDS - 1):
        before = members.effects_of(all_sets, answer.best)
        reported = [all_sets.component(key) for key in sorted(answer.best.names)]
        effects = [one for one in reported if one.effect is not None and one.key != LAG]
        real = all_sets.is_real(answer.best.names)
        point = all_sets.made.point
        directed = _whitening_source(answer, source, point.directed)
        other_noise = (directed is None) != (point.directed is None)
        if not (effects or other_noise):
            break
        intervals = movement_intervals(all_sets, answer.best)
        point = replace(omit_readings(point, intervals) if intervals else point, directed=directed)
        del all_sets, space  # the sets of the previous point take as much memory
        found = richest_model.converge(point, library, effects)
        all_sets, space, best = search_at_point(found, library, effects, real)
        answer = decision.decide(all_sets, space, best, library)
        source = _find_directed_source(all_sets, answer.best)
        if members.effects_of(all_sets, answer.best) == before and not (intervals or other_noise):
            break
    result = _search_without_movement(ModelSearchResult(answer, all_sets, space, source), library)
    result.all_sets.made.release_candidates()
    return result


def _find_directed_source(all_sets: Hypotheses, best: Hypothesis) -> DirectedNoise | None:
    """Noise along one direction beyond a sensor's own, None if its evidence is too low."""
    found = directed_noise_of_residual(all_sets.made, best.keys, best.at)
    required = priors.DIRECTED_REAL if all_sets.is_real(best.names) else priors.UNKNOWN_ODDS
    return found if found.nats > required else None


def _whitening_source(
    answer: decision.Answer, source: DirectedNoise | None, known: DirectedNoise | None
) -> DirectedNoise | None:
    """The source by whose covariance the rows are whitened, if it exceeds all that is reported.

    A strong effect leaves a residual along its direction if its log or its form is inexact, and is
    still correct.  A free process does so as well.  Directed noise with more evidence than any of
    these is not their residual.

    known: the source by which the rows are whitened already; then the source need not be more
    certain
    """
    reported_nats = [one.evidence_nats for one in answer.findings]
    largest_nats = max([*reported_nats, answer.unexplained.evidence_nats])
    return source if source is not None and (known or source.nats > largest_nats) else None


def _search_without_movement(
    found: ModelSearchResult, library: Mapping[str, Effect]
) -> ModelSearchResult:
    """Repeat the search without the readings of a short unknown source, if a step began within it.

    An object that is brought by hand passes the sensor before it stays, and its field in passing is
    larger than the step.  That looks like a source which is present for some seconds, and with this
    source in the model no step is accepted.
    """
    all_sets, unknown, margin_s = found.all_sets, found.answer.unknown, priors.TRANSITION_S / 2
    active_intervals = [all_sets.component(key).setting.get("spans_s", ()) for key in unknown]
    intervals = [(a - margin_s, b + margin_s) for one in active_intervals for a, b in one]
    if (
        not 0 < len(intervals) < priors.CHANGES
        or max(np.ptp(intervals, axis=1)) > 2 * priors.APPROACH_S
    ):
        return found
    richest = richest_model.converge(omit_readings(all_sets.made.point, intervals), library, ())
    new_sets, space, best = search_at_point(richest, library, (), was_real=True)
    answer = decision.decide(new_sets, space, best, library)
    steps = [one for key in answer.keys if (one := new_sets.component(key)).jumps]
    onsets_s = [time_s for one in steps for time_s in one.moments_s]
    if any(a - margin_s <= time_s <= b + margin_s for time_s in onsets_s for a, b in intervals):
        return ModelSearchResult(
            answer, new_sets, space, _find_directed_source(new_sets, answer.best)
        )
    return found


def movement_intervals(all_sets: Hypotheses, best: Hypothesis) -> list[tuple[float, float]]:
    """Intervals (from, to), s, in which something was moved, so that a step does not describe it.

    A step has both of its levels right.  Its form component has only some pieces and cannot follow
    the movement from one level to the other, so it leaves a large residual, and other effects are
    fitted to it.  If several effects begin within `APPROACH_S` of each other and end so or remain,
    all but their levels belongs to one movement.
    """
    point, half_s = all_sets.made.point, priors.APPROACH_S / 2 / STEP_PIECES
    track, sigma = point.filtered.track, point.filtered.model.sigma_mag_gauss
    read = np.isfinite(track.mag_b_gauss).all(axis=1)
    with_onset = [
        one for key in sorted(best.names) if "onset_s" in (one := all_sets.component(key)).setting
    ]
    out = []
    for step in with_onset:
        form = all_sets.forms.get(step.key)
        if form is None or not step.columns.on_mag:
            continue
        form_sigmas = np.linalg.norm(_added_field(all_sets, best, form), axis=1) / sigma
        for moment_s in step.moments_s:
            parts = [
                one for one in with_onset if one is not step and _is_part_of_movement(one, moment_s)
            ]
            edges = [time_s for one in parts for time_s in _active_interval(one)]
            edges += _same_movement_times(step, moment_s, with_onset)
            if edges:
                edges.append(moment_s)
                out.append((min(edges) - 2 * half_s, max(edges) + 2 * half_s))
            near = read & (np.abs(track.time_s - moment_s) <= priors.APPROACH_S)
            near_sigmas = np.where(near, form_sigmas, 0.0)
            peaks = _runs_with_peak(near_sigmas > priors.MOVED_LEAST, near_sigmas > priors.MOVED)
            out += [(track.time_s[a] - half_s, track.time_s[b - 1] + half_s) for a, b in peaks]
    at_s = track.time_s[read]
    return [(float(a), float(b)) for a, b in out if np.any((at_s >= a) & (at_s <= b))]


def _is_part_of_movement(one: Component, moment_s: float) -> bool:
    """Whether a member begins near a step and lasts no longer than a movement by hand."""
    begin, end = _active_interval(one)
    near = abs(begin - moment_s) <= priors.APPROACH_S
    return near and end - begin <= 2 * priors.APPROACH_S and one.columns.on_mag


def _same_movement_times(
    step: Component, moment_s: float, with_onset: Sequence[Component]
) -> list[float]:
    """Times of other steps of the same movement: same frame, all times within `APPROACH_S`."""
    out = list[float]()
    for one in with_onset:
        if one is step or one.frame != step.frame or len(one.moments_s) != len(step.moments_s):
            continue
        apart_s = np.abs(np.subtract(one.moments_s, step.moments_s))
        if one.jumps and step.jumps and np.all(apart_s <= priors.APPROACH_S):
            out.append(min(one.moments_s, key=lambda at: abs(at - moment_s)))
    return out


def _active_interval(one: Component) -> tuple[float, float]:
    """The interval (from, to), s, in which a member changes."""
    begin, *end = one.moments_s
    return begin, end[0] if end else begin + float(one.setting.get("length_s", 0.0))


def _runs_with_peak(wide: NDArray[np.bool], high: NDArray[np.bool]) -> list[tuple[int, int]]:
    """Runs of rows in `wide` that contain a row in `high`, as (first, last + 1)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if np.any(high[a:b])]


def _added_field(all_sets: Hypotheses, best: Hypothesis, key: str) -> Array:
    """(N, 3) gauss that a member adds to the magnetometer."""
    columns = all_sets.component(key).columns.mag
    if columns is None:
        return np.zeros((len(all_sets.made.context.track), 3))
    return np.asarray(columns @ members.coefficients(all_sets, best, key)[0])
