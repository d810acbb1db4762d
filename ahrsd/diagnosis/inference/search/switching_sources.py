"""Sources that switch: one that comes and goes, and one with a level that changes.

A source that switches on, hits, rings or passes, once or often, shows as bursts of seconds.  A
Gaussian process in time over the whole recording is no model of that, and noise of any colour,
whose level is constant in time, absorbs its evidence.  Here a two-state Markov chain says when the
source is on.  The source is zero while it is off, and a free function of time while it is on:

    x(t) = sum_k w_k cos(pi k (t - t0) / T) in an interval from t0 to t0 + T,  k = 0, 1, ...
    var w_k = size^2 / (1 + (k / T corner)^2)

The second kind has levels of one size between change points, which come at any time.

States and change points are found in the residual of a set; their log probability is a part of the
prior odds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import (
    Component,
    ScaledLaw,
    columns_in_frame,
    log_density,
)
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.where_and_when.locate import Frame, segments_between
from ahrsd.samples import Array

#: frames of such sources
FRAMES: tuple[Frame, ...] = ("sensor", "world")
#: alternations between the size and the states of the chain
_ROUNDS = 8
#: half waves of the trial components that refine an end, and steps tried to each side
_END_WAVES, _END_STEPS = 3, 2


@dataclass(frozen=True, slots=True, eq=False)
class IntervalLaw:
    """psi: logarithms of the size, in `unit`, and of the corner, in half waves a second.

    order (q,): half waves a second of each coefficient, 0 for a mean
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
    """Components for the switching sources in a set's residual, in each frame; may be empty."""
    made = all_sets.made
    residual = made.residual(hypothesis.keys, hypothesis.at) / made.point.loud.amplitude[:, None]
    residual = np.where(made.point.filtered.used[:, None], residual, 0.0)
    rows = max(1, round(priors.SPELL_PIECE_S * made.point.problem.rate_hz))
    intervals, log_odds = _find_intervals(
        residual, made.point.filtered.used, rows, made.point.problem.rate_hz
    )
    # coloured noise would absorb a source that often has the same form: use the sensor's noise
    sensor_noise = replace(
        hypothesis.at, log_noise=np.full(len(hypothesis.at.log_noise), hypothesis.at.log_noise[-1])
    )
    components: list[Component] = []
    if intervals:
        intervals = _refine_interval_ends(all_sets, hypothesis, sensor_noise, intervals, rows)
        # the ends are fitted to a row, not to a piece
        log_odds -= 2 * len(intervals) * float(np.log(rows))
        components += [
            _interval_component(made.context, frame, intervals, log_odds) for frame in FRAMES
        ]
    residual = made.residual(hypothesis.keys, sensor_noise) / made.point.loud.amplitude[:, None]
    residual = np.where(made.point.filtered.used[:, None], residual, 0.0)
    change_rows = change_points(residual, 2 * rows)
    if priors.CHANGES <= len(change_rows) <= priors.MOST_WAVES:
        components += [_level_component(made.context, frame, change_rows) for frame in FRAMES]
    return components


def _find_intervals(
    residual: Array, used: NDArray[np.bool], rows: int, rate_hz: float
) -> tuple[list[tuple[int, int]], float]:
    """Intervals (first row, row behind the last) in which a source is on, and their log odds.

    residual: (N, 3) of unit variance
    """
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
    at: ModelFit,
    intervals: list[tuple[int, int]],
    rows: int,
) -> list[tuple[int, int]]:
    """The intervals with their ends at the largest evidence.

    A filter follows a constant field, and swings back behind it: the residual has other ends.
    """
    made, count = all_sets.made, len(all_sets.made.context.track)
    scan = candidate_scan(made, hypothesis.keys, at)
    for step in (rows, rows, max(1, rows // 2), 1):
        for end in (1, 0):
            interval_by_key: dict[str, tuple[int, tuple[int, int]]] = {}
            candidates = []
            for number, interval in enumerate(intervals):
                for offset in range(-_END_STEPS, _END_STEPS + 1):
                    a, b = (interval[k] + offset * step * (k == end) for k in (0, 1))
                    if not 0 <= a < b - 1 < count:
                        continue
                    component = _interval_component(
                        made.context, "sensor", [(a, b)], 0.0, _END_WAVES
                    )
                    interval_by_key[component.key] = number, (a, b)
                    candidates.append(component)
            trial = made.copy()  # the trial components of a round are not kept
            trial.add(candidates)
            worth = replace(scan, made=trial).log_bayes_factors(list(interval_by_key))
            best: dict[int, float] = {}
            for key, nats in worth.items():
                number, interval = interval_by_key[key]
                if nats > best.get(number, -np.inf):
                    best[number], intervals[number] = nats, interval
    return _merge_overlapping(intervals)


def _merge_overlapping(intervals: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Sorted intervals; those that overlap are merged."""
    merged: list[tuple[int, int]] = []
    for a, b in sorted(intervals):
        if merged and a <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(b, merged[-1][1])
        else:
            merged.append((a, b))
    return merged


def change_points(residual: Array, rows: int) -> list[int]:
    """Rows at which the mean of a residual (N, 3) of unit variance jumps.

    rows: number of rows before and behind whose means are compared
    """
    cumulative = np.vstack([np.zeros(3), np.cumsum(residual, axis=0)])
    middle = np.arange(rows, len(residual) - rows + 1)
    jump = (cumulative[middle + rows] - 2.0 * cumulative[middle] + cumulative[middle - rows]) / rows
    square = 0.5 * rows * np.sum(jump**2, axis=1)
    points: list[int] = []
    for k in np.argsort(-square):
        if square[k] < priors.JUMPS:
            break
        if all(abs(int(middle[k]) - one) >= rows for one in points):
            points.append(int(middle[k]))
        if len(points) > priors.MOST_WAVES:
            break
    return sorted(points)


def _level_component(context: Context, frame: Frame, change_rows: Sequence[int]) -> Component:
    """A constant field between consecutive change points (rows), along each axis of a frame."""
    time_s = context.track.time_s
    edges = np.array([time_s[0], *time_s[list(change_rows)], time_s[-1]])
    segments = segments_between(time_s, edges)

    def indicators() -> Array:
        return np.asarray(segments.index[:, None] == np.arange(len(segments)), np.float64)

    columns = columns_in_frame(context, frame, indicators, len(segments))
    low, high = (np.array([np.log(one)]) for one in priors.COURSE_SIZES)
    unit = priors.COURSE_UNIT[frame]
    law = ScaledLaw(np.full(columns.width, unit), low, high)
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
    """The pieces of time in which a source is on, and the log probability of that chain.

    square (n,): squared norm of the sum of a piece's rows, each of three numbers of unit variance
    count (n,): rows of each piece
    A piece that is on has a mean of its own; all these means have one variance.
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
    """The most probable states of a chain that starts off.

    log_factors (n,): evidence that each piece is on, nats;  log_transition (2, 2): from, to
    """
    score, predecessor = np.array([0.0, -np.inf]), np.zeros((len(log_factors), 2), dtype=np.intp)
    for k, nats in enumerate(log_factors):
        transitions = score[:, None] + log_transition
        predecessor[k] = np.argmax(transitions, axis=0)
        score = np.max(transitions, axis=0) + np.array([0.0, nats])
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
    """A free function of time in each interval (first row, row behind the last), on each axis.

    most_waves: of one interval
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
    columns = columns_in_frame(context, frame, time_functions, sum(counts))
    law = IntervalLaw(np.repeat(np.concatenate(frequencies), 3), priors.COURSE_UNIT[frame])
    spans = tuple((float(time_s[a]), float(time_s[b - 1])) for a, b in intervals)
    key = f"{frame} that is there from and to {spans} s"
    log_prior = float(np.log(priors.COURSE * _frame_probability(frame))) + log_odds
    return Component(key, frame, columns, law, log_prior, setting={"spans_s": spans})


def _interval_cosines(
    rows: int, intervals: Sequence[tuple[int, int]], counts: Sequence[int]
) -> Array:
    """(rows, sum of counts) half waves in each interval, beginning with its mean."""
    cosines = np.zeros((rows, sum(counts)))
    first = 0
    for (a, b), count in zip(intervals, counts, strict=True):
        phase = np.pi * (np.arange(b - a)[:, None] + 0.5) / (b - a)
        cosines[a:b, first : first + count] = np.cos(phase * np.arange(count))
        first += count
    return cosines


def _frame_probability(frame: Frame) -> float:
    """Prior probability of the frame of a switching source."""
    return priors.SWITCHES_OUTSIDE if frame == "world" else 1.0 - priors.SWITCHES_OUTSIDE
