"""Turns that a recording lost: where its gyro's samples do not tell them, and which it left out.

A step's turn is told by one vector as long as the rate hardly changes within it.  In a crash, a
fall or a blow a slow logger sees turns of a radian a step: what happened between is not known.  A
field that jumps looks like lost turns now and then, and hides those that are; so they are looked
for once more beside what was found, and where the two answers differ, the likelier one is believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.data_quality.dropped_samples import correction_cost, find_lost_turns
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.inference.likelihood.linearisation import Point, step_to_maximum
from ahrsd.diagnosis.inference.recorded_rate import RecordedRateResult, point_at_recorded_rate
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult
from ahrsd.diagnosis.track import Track


def find_lost_turns_given(
    recorded: Track, found: ModelSearchResult, fast: RecordedRateResult, lost: Sequence[Fact]
) -> list[Fact]:
    """Lost turns of a recording as it came, beside what was found.

    lost: those that had been put right before that was found
    """
    if not lost:
        return _find_in_point(fast.point)
    all_sets, best = found.all_sets, found.answer.best
    begin_s = [end for fact in lost if fact.turned is not None for _, end in fact.where.intervals_s]
    jumps_at_gaps = {
        key for key in best.names
        if (one := all_sets.component(key)).jumps
        and any(abs(one.moments_s[0] - at) < priors.TRANSITION_S for at in begin_s)
    }  # fmt: skip
    reduced = all_sets.judge(best.names - jumps_at_gaps, best)
    point = step_to_maximum(all_sets.made, reduced.keys, reduced.at)
    return _find_in_point(
        point_at_recorded_rate(replace(point, problem=replace(point.problem, recorded=recorded)))
    )


def corrected_log_evidence(found: ModelSearchResult, lost: Sequence[Fact]) -> float:
    """How likely the readings are where these turns were put right, as nats that compare."""
    return found.answer.best.score + found.all_sets.made.log_whitening - correction_cost(lost)


def split_at_large_turns(track: Track) -> Track:
    """The track with a run's end ahead of each step that turns too far to be told."""
    step_s = np.nan_to_num(track.dt_s, nan=0.0)
    turn = np.linalg.norm(track.gyro_b_rad_s, axis=1) * step_s
    too_large = np.flatnonzero(turn > priors.SAMPLED_TURN_RAD)
    if not len(too_large):
        return track
    starts = np.union1d([run.start for run in track.runs] or [0], too_large)
    dt_s = track.dt_s.copy()
    dt_s[too_large] = np.nan
    ends = [*starts[1:], len(track)]
    runs = tuple(slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True))
    return replace(track, dt_s=dt_s, runs=runs)


def _find_in_point(point: Point) -> list[Fact]:
    filtered = point.filtered
    return find_lost_turns(filtered, filtered.track.gyro_b_rad_s - filtered.model.gyro_bias_rad_s)
