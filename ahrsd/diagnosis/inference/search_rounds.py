"""Searches at one linearisation after the other, until what is found stays."""

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

#: linearisations with a search each, at most
ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class ModelSearchResult:
    """An answer, and the sets at the last linearisation that it was chosen of.

    source: what is louder along one direction than a sensor's noise is, None where nothing is
    """

    answer: decision.Answer
    all_sets: Hypotheses
    space: Space
    source: DirectedNoise | None


def search_until_stable(
    found: richest_model.FittedPoint, library: Mapping[str, Effect]
) -> ModelSearchResult:
    """Searched at the richest model, and again at what was found, until that stays."""
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
        del all_sets, space  # what was asked at the point before is as much again
        found = richest_model.converge(point, library, effects)
        all_sets, space, best = search_at_point(found, library, effects, real)
        answer = decision.decide(all_sets, space, best, library)
        source = _find_directed_source(all_sets, answer.best)
        if members.effects_of(all_sets, answer.best) == before and not (intervals or other_noise):
            break
    return _search_without_movement(ModelSearchResult(answer, all_sets, space, source), library)


def _find_directed_source(all_sets: Hypotheses, best: Hypothesis) -> DirectedNoise | None:
    """What is louder along one direction than a sensor's noise is, None where that is not sure."""
    found = directed_noise_of_residual(all_sets.made, best.keys, best.at)
    required = priors.DIRECTED_REAL if all_sets.is_real(best.names) else priors.UNKNOWN_ODDS
    return found if found.nats > required else None


def _whitening_source(
    answer: decision.Answer, source: DirectedNoise | None, known: DirectedNoise | None
) -> DirectedNoise | None:
    """The source beside whose noise names are judged: one that is surer than all that is told.

    A strong name whose log or form is not exact leaves a rest, and is no worse for it, and so does
    a course of what is unknown; what a source has more of than all of these have is not theirs.
    """
    reported_nats = [one.evidence_nats for one in answer.findings]
    largest_nats = max([*reported_nats, answer.unexplained.evidence_nats])
    return source if source is not None and (known or source.nats > largest_nats) else None


def _search_without_movement(
    found: ModelSearchResult, library: Mapping[str, Effect]
) -> ModelSearchResult:
    """The search anew without the readings of a spell of seconds, where a step began in it.

    What a hand brings passes the sensor before it stays, and the passing is louder than the step:
    a source that is there for a spell, and beside it no step would be told.
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
    """When something was moved, (from, to) s: where the way of a step's source is far off a step.

    A step has its two levels right, but a form of some pieces is not the way from one to the other:
    what it leaves is louder than all else, and other names are told for it.  Of names that begin
    within a hand's time of each other, and end so or stay, all but the levels is the way.
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
    """Whether a member begins beside a step and does not outlast what a hand does there."""
    begin, end = _active_interval(one)
    near = abs(begin - moment_s) <= priors.APPROACH_S
    return near and end - begin <= 2 * priors.APPROACH_S and one.columns.on_mag


def _same_movement_times(
    step: Component, moment_s: float, with_onset: Sequence[Component]
) -> list[float]:
    """When steps of the same vector as one at a moment are there: all moments are those of it."""
    out = list[float]()
    for one in with_onset:
        if one is step or one.frame != step.frame or len(one.moments_s) != len(step.moments_s):
            continue
        apart_s = np.abs(np.subtract(one.moments_s, step.moments_s))
        if one.jumps and step.jumps and np.all(apart_s <= priors.APPROACH_S):
            out.append(min(one.moments_s, key=lambda at: abs(at - moment_s)))
    return out


def _active_interval(one: Component) -> tuple[float, float]:
    """From when to when a member changes, s."""
    begin, *end = one.moments_s
    return begin, end[0] if end else begin + float(one.setting.get("length_s", 0.0))


def _runs_with_peak(wide: NDArray[np.bool], high: NDArray[np.bool]) -> list[tuple[int, int]]:
    """Runs of rows of the first kind that have one of the second, first and behind the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if np.any(high[a:b])]


def _added_field(all_sets: Hypotheses, best: Hypothesis, key: str) -> Array:
    """(N, 3) gauss that a member puts on the magnetometer."""
    columns = all_sets.component(key).columns.mag
    if columns is None:
        return np.zeros((len(all_sets.made.context.track), 3))
    return np.asarray(columns @ members.coefficients(all_sets, best, key)[0])
