"""The course of an unlogged source, fitted together with the calibration.

A source that is on for most of a recording is taken for calibration by a fit without it, and what
is left of it then looks like nothing that it is.  Where something is there, its frame's free course
gets into the joint fit, segment by segment, and its values are those of the source.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ahrsd.diagnosis.calibration_fit.descent import FittedTerm
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.rules.locate import group_name
from ahrsd.diagnosis.rules.search import State
from ahrsd.diagnosis.rules.unknown import Remainder
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.diagnosis.where_and_when.locate import Frame, frame_columns, segments, single_source

#: stretches of the free course, as long as this at least
COUNT, SHORTEST_S = 60, 3.0
#: prior deviations of a coefficient: next to none
LOOSE = {"sensor": 0.1, "world": 0.1, "gyro": 0.01}


def with_free_course(state: State, left: Remainder) -> Remainder:
    """The remainder with its strongest frame's course as the joint fit has it."""
    best = left.strongest
    problem = state.problem
    count = int(np.clip(problem.track.duration_s / SHORTEST_S, len(best.cut), COUNT))
    cut = segments(problem.track.time_s, count)
    columns = partial(_columns, frame=best.frame, count=count)
    term = FittedTerm(
        group_name(best.frame), columns, np.zeros(3 * count), np.full(3 * count, LOOSE[best.frame])
    )
    fit = fit_null(
        problem.track,
        problem.spec,
        state.fit.model,
        (*state.fit.terms, term),
        noise=state.walk == 0.0,
        walk=state.walk > 0.0,
    )
    found = fit.terms[-1]
    course = found.value.reshape(-1, 3)
    spread = found.value if found.deviation is None else found.deviation
    deviation = np.sqrt(np.mean(spread.reshape(-1, 3) ** 2, axis=1) * left.basis.colour)
    course = course - np.average(course, axis=0, weights=deviation**-2)
    direction, share = single_source(course, deviation)
    freed = replace(
        best,
        cut=cut,
        course=course,
        deviation=deviation,
        direction=direction,
        single_share=share,
    )
    return replace(left, free=freed)


def _columns(context: Context, frame: Frame, count: int) -> Columns:
    return frame_columns(context, frame, segments(context.track.time_s, count))
