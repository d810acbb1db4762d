"""A clock that jumps: no time that passed, no array that grows with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.data_quality.timestamps import LEFT_S, without_jumps
from ahrsd.diagnosis.one_model.diagnose import diagnose
from ahrsd.diagnosis.track import Track


def _jumping(by_s: float, samples: int = 1000) -> Track:
    """A recording in two runs, the clock of the second so much later than it was."""
    track = track_of(experiment("wam", samples=samples))
    row = samples // 2
    time_s, dt_s = track.time_s.copy(), track.dt_s.copy()
    time_s[row:] += by_s
    dt_s[row] = np.nan
    return replace(track, time_s=time_s, dt_s=dt_s, runs=(slice(0, row), slice(row, samples)))


@pytest.mark.parametrize("by_s", [1.7471e9, 3600.0, -2.0, -1e6])
def test_a_jump_is_a_short_break(by_s: float) -> None:
    track = _jumping(by_s)
    done, (words,) = without_jumps(track)
    assert done.time_s[500] - done.time_s[499] == pytest.approx(LEFT_S)
    assert np.diff(done.time_s).min() > 0.0
    assert words.startswith(f"the clock jumps by {by_s + 0.04:+.6g} s behind 20 s")
    assert without_jumps(done) == (done, ())
    epoch = replace(track, time_s=track.time_s + 1.7e9 + 0.125)
    assert "behind 1700000020.125 s" in without_jumps(epoch)[1][0]


def test_a_break_that_may_be_one_stays() -> None:
    track = _jumping(30.0)
    assert without_jumps(track) == (track, ())
    whole = replace(track, runs=track.runs[:1])
    assert without_jumps(whole) == (whole, ())


def test_a_clock_that_is_set_while_it_records_is_diagnosed() -> None:
    """From 1970 to 2025: once more than a terabyte."""
    found = diagnose(_jumping(1.7471e9, samples=2500))
    assert not found.mismatch
    assert found.notes[0].startswith("the clock jumps by +1.7471e+09 s")
