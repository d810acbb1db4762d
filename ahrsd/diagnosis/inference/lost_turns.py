"""Turns that are missing in a recording: by undersampling, or because samples were lost.

One gyro sample describes the turn of a step only if the rate hardly changes within the step.  In a
crash, a fall or a blow a slow logger has turns of a radian in a step, and the motion between is
unknown.  A field that jumps sometimes resembles lost turns, and hides real ones.  So lost turns are
sought once more with the accepted effects in the model.  If the two results differ, the more
probable one is kept.
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
    """Lost turns of a recording, given the accepted effects.

    recorded: the recording before any correction
    lost: the lost turns that were corrected before the search; a member that jumps where one of
          them ended may be its remainder, and is left out of the model here
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
    """Log evidence of the readings with these turns corrected; corrections compare by it."""
    return found.answer.best.score + found.all_sets.made.log_whitening - correction_cost(lost)


def split_at_large_turns(track: Track) -> Track:
    """The track with a new run at each step that turns by more than a gyro sample can describe."""
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
