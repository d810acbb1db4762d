"""Whether a logged cause changes so often that nothing slow goes with it.

A room, a box that warms up, a day: what they do has the course of any other slow thing, a column
that drifts among them.  A motor that is throttled up and down a few times has its own; and what
changes within a second does so at a moment that is known, which says as much once more.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

#: changes from one side of the middle to the other at least; twice as many are often by any course
OFTEN = 4
_SMOOTHED_S = 1.0
#: how far from the middle a side begins, in deviations: noise that crosses it changes nothing
_SIDE = 0.25
#: a change at a known moment: through this part of its range within so long
_SUDDEN_S, _SUDDEN_PART = 1.0, 0.5


def logged_often(track: Track, candidate: Candidate, least: int = OFTEN) -> bool:
    """Whether a candidate is driven by a column of the recording that changes sides so often."""
    values = track.covariates.get(str(candidate.setting.get("covariate")))
    return values is not None and changes(values, track.step_s) >= least


def changes(values: Array, step_s: float) -> int:
    """How often (N,), smoothed over a second, goes from one side of its middle to the other.

    Changes through half of its range within a second count twice.
    """
    width = max(1, round(_SMOOTHED_S / step_s))
    if len(values) < 2 * width or not np.isfinite(values).all():
        return 0
    smooth = np.convolve(values, np.full(width, 1.0 / width), mode="valid")
    away = smooth - (np.quantile(smooth, 0.25) + np.quantile(smooth, 0.75)) / 2
    side = np.sign(away)[np.abs(away) > _SIDE * float(np.std(smooth))]
    return int(np.count_nonzero(np.diff(side))) + _sudden(values, step_s)


def _sudden(values: Array, step_s: float) -> int:
    """How often (N,) goes through a good part of its range within a second."""
    apart = max(1, round(_SUDDEN_S / step_s))
    far = np.abs(values[apart:] - values[:-apart]) > _SUDDEN_PART * max(float(np.ptp(values)), 1e-9)
    return int(np.count_nonzero(np.diff(np.concatenate([[False], far]).astype(int)) == 1))
