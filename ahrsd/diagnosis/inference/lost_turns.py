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
from ahrsd.diagnosis.inference.recorded_rate import Quick, at_recorded_rate
from ahrsd.diagnosis.inference.search_rounds import Searched
from ahrsd.diagnosis.track import Track


def lost_beside(came: Track, found: Searched, fast: Quick, lost: Sequence[Fact]) -> list[Fact]:
    """Lost turns of a recording as it came, beside what was found.

    lost: those that had been put right before that was found
    """
    if not lost:
        return _turns(fast.left)
    all_sets, best = found.all_sets, found.answer.best
    begin_s = [end for fact in lost if fact.turned is not None for _, end in fact.where.intervals_s]
    answers = {
        key for key in best.names
        if (one := all_sets.component(key)).jumps
        and any(abs(one.moments_s[0] - at) < priors.TRANSITION_S for at in begin_s)
    }  # fmt: skip
    rest = all_sets.judge(best.names - answers, best)
    point = step_to_maximum(all_sets.made, rest.keys, rest.at)
    return _turns(at_recorded_rate(replace(point, problem=replace(point.problem, recorded=came))))


def nats(found: Searched, lost: Sequence[Fact]) -> float:
    """How likely the readings are where these turns were put right, as nats that compare."""
    return found.answer.best.score + found.all_sets.made.log_whitening - correction_cost(lost)


def broken_where_unsampled(track: Track) -> Track:
    """The track with a run's end ahead of each step that turns too far to be told."""
    step_s = np.nan_to_num(track.dt_s, nan=0.0)
    turn = np.linalg.norm(track.gyro_b_rad_s, axis=1) * step_s
    unknown = np.flatnonzero(turn > priors.SAMPLED_TURN_RAD)
    if not len(unknown):
        return track
    starts = np.union1d([run.start for run in track.runs] or [0], unknown)
    dt_s = track.dt_s.copy()
    dt_s[unknown] = np.nan
    ends = [*starts[1:], len(track)]
    runs = tuple(slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True))
    return replace(track, dt_s=dt_s, runs=runs)


def _turns(fast: Point) -> list[Fact]:
    done = fast.filtered
    return find_lost_turns(done, done.track.gyro_b_rad_s - done.model.gyro_bias_rad_s)
