"""Sources that switch: one that comes and goes, and one that goes from level to level.

Of the first there is nothing for most of the time, and for spells a field of its own.

What switches now and then, hits, rings or passes, once or often, shows as bursts of seconds.  A
course in time over the whole recording is no law of that, and beside noise of any colour, which is
as loud all of the time, no evidence of it is left.  Here the time is a chain of two states, and
while it is on the source is a free course:

    x(t) = sum_k w_k cos(pi k (t - t0) / T) in a spell from t0 to t0 + T,  k from 0 on
    var w_k = size^2 / (1 + (k / T corner)^2)

The other has levels of one size between moments at which it changes, which come at any time.

States and moments are found in the residual of a set, and paid with their probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import Component, Sized, in_frame, log_density
from ahrsd.diagnosis.inference.likelihood.candidates import beside
from ahrsd.diagnosis.inference.likelihood.evidence import At
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.where_and_when.locate import (
    Frame,
    frame_columns,
    segments_between,
)
from ahrsd.samples import Array

#: frames in which such a source is asked
FRAMES: tuple[Frame, ...] = ("sensor", "world")
#: rounds in which size and states are found of each other
_ROUNDS = 8
#: half waves with which ends are sought, and steps to each side
_END_WAVES, _END_STEPS = 3, 2


@dataclass(frozen=True, slots=True, eq=False)
class IntervalLaw:
    """psi: logarithms of the size, in `unit`, and of the corner, in half waves a second.

    order (q,): half waves a second of each coefficient, 0 of a mean
    """

    order: Array
    unit: float

    @property
    def start(self) -> Array:
        """Where a search begins."""
        return np.array([0.0, 0.0])

    @property
    def low(self) -> Array:
        """Lowest psi."""
        return np.log([priors.COURSE_SIZES[0], priors.SPELL_CORNERS[0]])

    @property
    def high(self) -> Array:
        """Highest psi."""
        return np.log([priors.COURSE_SIZES[1], priors.SPELL_CORNERS[1]])

    @property
    def stiffness(self) -> Array:
        """(k,) curvature of minus the log density of psi."""
        return np.zeros(2)

    def log_variance(self, psi: Array) -> Array:
        """(q,) logarithms."""
        shape = -np.log1p((self.order * np.exp(-psi[1])) ** 2)
        return np.asarray(2 * np.log(self.unit) + 2 * psi[0] + shape)

    def slope(self, psi: Array) -> Array:
        """(q, k) of the log variances."""
        ratio = (self.order * np.exp(-psi[1])) ** 2
        return np.column_stack([np.full(len(ratio), 2.0), 2.0 * ratio / (1.0 + ratio)])

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density of psi and its gradient (k,)."""
        terms = [
            log_density(value, 0.0, 0.0, low, high)
            for value, low, high in zip(psi, self.low, self.high, strict=True)
        ]
        return sum(nats for nats, _ in terms), np.concatenate([slope for _, slope in terms])


def find_switching_sources(all_sets: Hypotheses, hypothesis: Hypothesis) -> list[Component]:
    """What a set leaves as sources that switch, in each frame; none where nothing does."""
    made = all_sets.made
    residual = made.left_by(hypothesis.keys, hypothesis.at) / made.point.loud.amplitude[:, None]
    residual = np.where(made.point.filtered.used[:, None], residual, 0.0)
    rows = max(1, round(priors.SPELL_PIECE_S * made.point.problem.rate_hz))
    intervals, log_odds = _find_intervals(
        residual, made.point.filtered.used, rows, made.point.problem.rate_hz
    )
    # of what is often alike noise of a colour would leave nothing
    sensor_noise = replace(
        hypothesis.at, log_noise=np.full(len(hypothesis.at.log_noise), hypothesis.at.log_noise[-1])
    )
    components: list[Component] = []
    if intervals:
        intervals = _refine_interval_ends(all_sets, hypothesis, sensor_noise, intervals, rows)
        log_odds -= (
            2 * len(intervals) * float(np.log(rows))
        )  # ends are sought to a row, not a piece
        components += [
            _interval_component(made.context, frame, intervals, log_odds) for frame in FRAMES
        ]
    residual = made.left_by(hypothesis.keys, sensor_noise) / made.point.loud.amplitude[:, None]
    residual = np.where(made.point.filtered.used[:, None], residual, 0.0)
    moments = change_points(residual, 2 * rows)
    if priors.CHANGES <= len(moments) <= priors.MOST_WAVES:
        components += [_level_component(made.context, frame, moments) for frame in FRAMES]
    return components


def _find_intervals(
    residual: Array, used: NDArray[np.bool], rows: int, rate_hz: float
) -> tuple[list[tuple[int, int]], float]:
    """Rows from and to which a source is on, of a residual of unit variance, and their odds."""
    starts = np.arange(0, len(residual), rows)
    sums = np.add.reduceat(residual, starts)
    count = np.add.reduceat(used.astype(float), starts)
    on, log_odds = most_probable_states(np.sum(sums**2, axis=1), count, rows / rate_hz)
    if np.mean(on) > priors.MOST_ON:
        return [], 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]]))).reshape(-1, 2)
    return [(int(a) * rows, min(int(b) * rows, len(residual))) for a, b in edges], log_odds


def _refine_interval_ends(
    all_sets: Hypotheses,
    hypothesis: Hypothesis,
    at: At,
    intervals: list[tuple[int, int]],
    rows: int,
) -> list[tuple[int, int]]:
    """Spells with their ends where the readings are likeliest.

    A filter follows what stays, and swings back behind it: a residual has other ends.
    """
    made, count = all_sets.made, len(all_sets.made.context.track)
    scan = beside(made, hypothesis.keys, at)
    for step in (rows, rows, max(1, rows // 2), 1):
        for end in (1, 0):
            interval_by_key: dict[str, tuple[int, tuple[int, int]]] = {}
            candidates = []
            for number, interval in enumerate(intervals):
                for offset in range(-_END_STEPS, _END_STEPS + 1):
                    a, b = (interval[k] + offset * step * (k == end) for k in (0, 1))
                    if not 0 <= a < b - 1 < count:
                        continue
                    one = _interval_component(made.context, "sensor", [(a, b)], 0.0, _END_WAVES)
                    interval_by_key[one.key] = number, (a, b)
                    candidates.append(one)
            trial = made.copied()  # what was tried ends with its round
            trial.add(candidates)
            worth = replace(scan, made=trial).worth(list(interval_by_key))
            best: dict[int, float] = {}
            for key, nats in worth.items():
                number, interval = interval_by_key[key]
                if nats > best.get(number, -np.inf):
                    best[number], intervals[number] = nats, interval
    return _merge_overlapping(intervals)


def _merge_overlapping(intervals: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """In their order, and those that overlap as one."""
    merged: list[tuple[int, int]] = []
    for a, b in sorted(intervals):
        if merged and a <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(b, merged[-1][1])
        else:
            merged.append((a, b))
    return merged


def change_points(residual: Array, rows: int) -> list[int]:
    """Rows at which the mean of a residual of unit variance (N, 3) jumps.

    rows: before and behind, of which means are held against each other
    """
    cumulative = np.vstack([np.zeros(3), np.cumsum(residual, axis=0)])
    candidates = np.arange(rows, len(residual) - rows + 1)
    jump = (
        cumulative[candidates + rows] - 2.0 * cumulative[candidates] + cumulative[candidates - rows]
    ) / rows
    square = 0.5 * rows * np.sum(jump**2, axis=1)
    points: list[int] = []
    for k in np.argsort(-square):
        if square[k] < priors.JUMPS:
            break
        if all(abs(int(candidates[k]) - one) >= rows for one in points):
            points.append(int(candidates[k]))
        if len(points) > priors.MOST_WAVES:
            break
    return sorted(points)


def _level_component(context: Context, frame: Frame, change_rows: Sequence[int]) -> Component:
    """One field from each moment (a row) to the next, along each axis of a frame."""
    time_s = context.track.time_s
    edges = np.array([time_s[0], *time_s[list(change_rows)], time_s[-1]])
    columns = frame_columns(context, frame, segments_between(time_s, edges))
    low, high = (np.array([np.log(one)]) for one in priors.COURSE_SIZES)
    unit = priors.COURSE_UNIT[frame]
    law = Sized(np.full(columns.width, unit), low, high)
    duration_s = float(time_s[-1] - time_s[0])
    log_odds = (
        float(np.log(priors.COURSE * _frame_probability(frame))) - duration_s / priors.BETWEEN_S
    )
    log_odds += len(change_rows) * float(np.log(duration_s / len(time_s) / priors.BETWEEN_S))
    key = f"{frame} that changes {len(change_rows)} times from {edges[1]:.3f} s on"
    return Component(key, frame, columns, law, log_odds, setting={"edges_s": tuple(edges.tolist())})


def most_probable_states(
    square: Array, count: Array, piece_s: float
) -> tuple[NDArray[np.bool], float]:
    """Which pieces of time a source is on in, and the log probability of such a chain.

    square (n,): of the sum of a piece's rows, each of three numbers of unit variance
    count (n,): rows of each
    A piece that is on has a mean of its own, of one variance for all.
    """
    stay_on, stay_off = np.exp(-piece_s / priors.SPELL_S), np.exp(-piece_s / priors.BETWEEN_S)
    log_transition = np.log([[stay_off, 1.0 - stay_off], [1.0 - stay_on, stay_on]])
    variance = float(np.quantile(square / np.maximum(count, 1.0) ** 2, 0.99)) / 3.0
    on = np.zeros(len(square), dtype=bool)
    for _ in range(_ROUNDS):
        scale = 1.0 + count * variance
        log_factors = 0.5 * square * variance / scale - 1.5 * np.log(scale)
        previous, on = on, _viterbi(log_factors, log_transition)
        if not on.any() or np.array_equal(previous, on):
            break
        mean_square = square[on] / np.maximum(count[on], 1.0) ** 2 - 3.0 / np.maximum(
            count[on], 1.0
        )
        variance = max(float(np.mean(mean_square)) / 3.0, 1e-12)
    states = on.astype(int)
    return on, float(np.sum(log_transition[states[:-1], states[1:]])) + float(
        log_transition[0, states[0]]
    )


def _viterbi(log_factors: Array, log_transition: Array) -> NDArray[np.bool]:
    """The likeliest states of a chain that begins off; worth (n,): of being on, nats."""
    score, predecessor = np.array([0.0, -np.inf]), np.zeros((len(log_factors), 2), dtype=np.intp)
    for k, nats in enumerate(log_factors):
        candidates = score[:, None] + log_transition
        predecessor[k] = np.argmax(candidates, axis=0)
        score = np.max(candidates, axis=0) + np.array([0.0, nats])
    states = np.zeros(len(log_factors), dtype=np.intp)
    state = int(np.argmax(score))
    for k in range(len(log_factors) - 1, -1, -1):
        states[k], state = state, int(predecessor[k, state])
    return states.astype(bool)


def _interval_component(
    context: Context,
    frame: Frame,
    intervals: Sequence[tuple[int, int]],
    log_odds: float,
    most_waves: int = priors.MOST_WAVES,
) -> Component:
    """A free course in each spell, rows from and to, along each axis of a frame.

    most: half waves of one
    """
    time_s = context.track.time_s
    step_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    total_s = step_s * sum(b - a for a, b in intervals)
    shortest_s = max(priors.SPELL_PIECE_S, total_s / priors.MOST_WAVES)
    counts = [
        int(np.clip(round(step_s * (b - a) / shortest_s), 1, most_waves)) for a, b in intervals
    ]
    frequencies = [
        np.arange(count) / (step_s * (b - a))
        for (a, b), count in zip(intervals, counts, strict=True)
    ]
    time_functions = partial(_interval_cosines, len(time_s), tuple(intervals), counts)
    columns = in_frame(context, frame, time_functions, sum(counts))
    law = IntervalLaw(np.repeat(np.concatenate(frequencies), 3), priors.COURSE_UNIT[frame])
    spans = tuple((float(time_s[a]), float(time_s[b - 1])) for a, b in intervals)
    key = f"{frame} that is there from and to {spans} s"
    log_prior = float(np.log(priors.COURSE * _frame_probability(frame))) + log_odds
    return Component(key, frame, columns, law, log_prior, setting={"spans_s": spans})


def _interval_cosines(
    rows: int, intervals: Sequence[tuple[int, int]], counts: Sequence[int]
) -> Array:
    """(rows, sum of counts) half waves in each spell, from its mean on."""
    cosines = np.zeros((rows, sum(counts)))
    first = 0
    for (a, b), count in zip(intervals, counts, strict=True):
        phase = np.pi * (np.arange(b - a)[:, None] + 0.5) / (b - a)
        cosines[a:b, first : first + count] = np.cos(phase * np.arange(count))
        first += count
    return cosines


def _frame_probability(frame: Frame) -> float:
    """How often a source that switches is of a frame."""
    return priors.SWITCHES_OUTSIDE if frame == "world" else 1.0 - priors.SWITCHES_OUTSIDE
