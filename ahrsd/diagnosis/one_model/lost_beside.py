"""Lost turns beside everything that was named, and which of two searches is believed.

A field that jumps looks like lost turns now and then, and hides those that are.  So they are looked
for once more in the recording as it came, beside what was found; and where the two answers differ,
the likelier of the two models is it, each turn that was put right paid for.

A step that is named where a turn was put right may be no more than the answer to a turn that was
never lost: beside it the same turn would be found again, and so it is left out here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ahrsd.diagnosis.data_quality.dropped_samples import missing_turns, price
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.one_model import priors
from ahrsd.diagnosis.one_model.linearised import Point, moved
from ahrsd.diagnosis.one_model.recorded_rate import Quick, at_recorded_rate
from ahrsd.diagnosis.one_model.search_rounds import Searched
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
    point = moved(all_sets.made, rest.keys, rest.at)
    return _turns(at_recorded_rate(replace(point, problem=replace(point.problem, recorded=came))))


def _turns(fast: Point) -> list[Fact]:
    done = fast.filtered
    return missing_turns(done, done.track.gyro_b_rad_s - done.model.gyro_bias_rad_s)


def nats(found: Searched, lost: Sequence[Fact]) -> float:
    """How likely the readings are where these turns were put right, as nats that compare."""
    return found.answer.best.score + found.all_sets.made.log_whitening - price(lost)
