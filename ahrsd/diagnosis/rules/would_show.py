"""What a recording would have shown, had it been there: the smallest value of every parameter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.answer.diagnosis import Limit
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.innovation_filter.score import score
from ahrsd.diagnosis.rules.quick import Quick
from ahrsd.diagnosis.rules.regression import Base, candidate_gram, columns_of
from ahrsd.diagnosis.rules.search import Survey
from ahrsd.samples import Array

#: a detection limit is this many standard deviations: what the gate would pass 9 times in 10
DETECTED_AT = 6.5


def would_show(problem: Problem, basis: Base, first: Survey, fast: Quick) -> tuple[Limit, ...]:
    """What the search would have shown, and what only the recorded rate shows."""
    quickly = _sensitivity(fast.state.problem, fast.last.basis, fast.last)
    slowly = _sensitivity(problem, basis, first)
    told = {(limit.effect, limit.parameter) for limit in slowly}
    return (*slowly, *(one for one in quickly if (one.effect, one.parameter) not in told))


def _sensitivity(problem: Problem, basis: Base, first: Survey) -> tuple[Limit, ...]:
    """The smallest value of every parameter that this recording would have shown."""
    columns = columns_of(basis, first.candidates)
    gram = candidate_gram(basis, columns, problem.track.duration_s)
    projected = gram.project(list(basis.groups))
    out = []
    for candidate in first.candidates:
        what = score(projected, candidate.name, candidate.scale, candidate.effect.least_information)
        sigma = np.sqrt(np.diag(what.covariance)) if what.rank else np.zeros(len(candidate.scale))
        hidden = _hidden(what.basis, candidate.scale)
        for k, parameter in enumerate(candidate.effect.parameters):
            smallest = None if hidden[k] else float(DETECTED_AT * sigma[k] * basis.colour**0.5)
            out.append(Limit(candidate.name, parameter.name, smallest, parameter.unit))
    return tuple(out)


def _hidden(directions: Array, scale: Array) -> NDArray[np.bool]:
    """(p,) parameters that are mostly outside the observable directions (p, r)."""
    seen = np.sum((directions / scale[:, None]) ** 2, axis=1)
    return np.asarray(seen < 0.5)
