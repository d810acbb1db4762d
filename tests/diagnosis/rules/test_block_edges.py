"""Cuts by time, where the clock jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tracks import experiment, track_of

from ahrsd.diagnosis.answer.predictive import segments_of
from ahrsd.diagnosis.rules.gram import block_edges
from ahrsd.diagnosis.track import Track


def _jumping(by_s: float, samples: int = 1000) -> Track:
    """A recording in two runs, the clock of the second so much later than it was."""
    track = track_of(experiment("wam", samples=samples))
    row = samples // 2
    time_s, dt_s = track.time_s.copy(), track.dt_s.copy()
    time_s[row:] += by_s
    dt_s[row] = np.nan
    return replace(track, time_s=time_s, dt_s=dt_s, runs=(slice(0, row), slice(row, samples)))


def test_cuts_by_time_are_bounded_by_the_rows() -> None:
    track = _jumping(1.7471e9)
    assert len(block_edges(track.time_s, 2.0)) <= len(track) + 1
    assert segments_of(track).max() < len(track)
