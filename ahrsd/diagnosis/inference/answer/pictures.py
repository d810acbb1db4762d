"""The data that a report plots: innovations, contributions of the terms, unexplained processes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Contribution, Drawn
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.inference.answer.visibility import EffectEvidence
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.decision.members import coefficients, contribution_of
from ahrsd.diagnosis.inference.likelihood.linearisation import step_to_maximum
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult
from ahrsd.diagnosis.where_and_when.locate import (
    FRAMES,
    Frame,
    Located,
    coarse_segments,
    single_source_direction,
)
from ahrsd.samples import Array


def plot_data(
    start: NullFit,
    found: ModelSearchResult,
    residual: Array,
    contributions: Sequence[Contribution],
    processes: tuple[Located, ...],
    single_effects: Sequence[EffectEvidence],
) -> Drawn:
    """The data of the plots.

    start: the calibration alone;  found: the answer, all of which is removed for `after`
    residual: (N, 3) what remains then, white if the model is right
    """
    best = found.answer.best
    after = step_to_maximum(found.all_sets.made, best.keys, best.at).filtered
    return Drawn(
        after.track.time_s,
        start.filtered.whitened,
        residual,
        start.filtered.innovation,
        after.innovation,
        tuple(contributions),
        processes,
        {one.row.identifier: one.nats for one in single_effects},
    )


def contributions(all_sets: Hypotheses, answer: Answer) -> list[Contribution]:
    """What each term of an answer adds to the readings, in the order of the terms."""
    time_s = all_sets.made.context.track.time_s
    return [
        Contribution(term.identifier, time_s, *contribution_of(all_sets, answer.best, key))
        for key, term in zip(answer.keys, answer.terms, strict=True)
    ]


def locate_processes(all_sets: Hypotheses, best: Hypothesis) -> tuple[Located, ...]:
    """The free process of each frame given the answer, in segments of the recording."""
    fitted = all_sets.made.seen
    return tuple(_locate_process(all_sets, best, f) for f in FRAMES if f"free {f}" in fitted)


def _locate_process(all_sets: Hypotheses, best: Hypothesis, frame: Frame) -> Located:
    key, track = f"free {frame}", all_sets.made.context.track
    included = key in best.names
    with_it = best if included else all_sets.judge(best.names | {key}, best)
    without = all_sets.judge(best.names - {key}, best) if included else best
    value, deviations = (part.reshape(-1, 3) for part in coefficients(all_sets, with_it, key))
    cut = coarse_segments(track)
    phase = np.pi * (cut.middle_s - track.time_s[0]) / track.duration_s
    waves = np.cos(phase[:, None] * np.arange(1, len(value) + 1))
    course, deviation = waves @ value, np.sqrt(np.mean(waves**2 @ deviations**2, axis=1))
    direction, _ = single_source_direction(course, deviation)
    nats = max(with_it.at.nats - without.at.nats, 0.0)
    return Located(
        frame=frame,
        evidence=nats,
        cut=cut,
        course=course,
        deviation=deviation,
        direction=direction,
    )
