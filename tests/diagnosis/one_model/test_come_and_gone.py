"""What is put on and taken off again is one vector, there for a while."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.one_model.diagnose import diagnose
from ahrsd.diagnosis.track import Track

MAGNET_GAUSS = np.array([4e-3, -12e-3, 8e-3])


def _with_magnet(track: Track, begin_s: float, end_s: float) -> Track:
    there = (track.time_s >= begin_s) & (track.time_s < end_s)
    return replace(track, mag_b_gauss=track.mag_b_gauss + np.outer(there, MAGNET_GAUSS))


def test_a_magnet_that_is_put_on_and_taken_off_is_one_step_with_its_end():
    track = track_of(experiment("wam", seed=14, samples=4000))
    begin_s, end_s = float(track.time_s[1200]), float(track.time_s[2600])
    found = diagnose(_with_magnet(track, begin_s, end_s))
    (magnet,) = found.findings
    assert magnet.effect == "hard_iron_step"
    ((first, last),) = magnet.where.intervals_s
    assert first == pytest.approx(begin_s, abs=0.3)
    assert last == pytest.approx(end_s, abs=0.3)
    for told, true in zip(magnet.parameters, MAGNET_GAUSS, strict=True):
        assert abs(told.value - true) < 4 * told.std < 2e-3
    assert not found.unexplained.detected


def test_a_magnet_that_stays_has_no_end():
    track = track_of(experiment("wam", seed=15, samples=4000))
    begin_s = float(track.time_s[1200])
    (magnet,) = diagnose(_with_magnet(track, begin_s, np.inf)).findings
    assert magnet.effect == "hard_iron_step"
    assert "end_s" not in magnet.setting
    ((first, last),) = magnet.where.intervals_s
    assert first == pytest.approx(begin_s, abs=0.3)
    assert last == pytest.approx(track.time_s[-1], abs=0.2)
