"""A magnet that is put on and taken off is one vector over an interval."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.delay import delayed_gyro
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track

MAGNET_GAUSS = np.array([4e-3, -12e-3, 8e-3])


def _with_magnet(track: Track, begin_s: float, end_s: float) -> Track:
    there = (track.time_s >= begin_s) & (track.time_s < end_s)
    return replace(track, mag_b_gauss=track.mag_b_gauss + np.outer(there, MAGNET_GAUSS))


@pytest.mark.slow
def test_temporary_magnet_is_one_step_with_an_end():
    track = track_of(experiment("wam", seed=14, samples=2000))
    begin_s, end_s = float(track.time_s[600]), float(track.time_s[1300])
    found = diagnose(_with_magnet(track, begin_s, end_s))
    (magnet,) = found.findings
    assert magnet.effect == "hard_iron_step"
    ((first, last),) = magnet.where.intervals_s
    assert first == pytest.approx(begin_s, abs=0.3)
    assert last == pytest.approx(end_s, abs=0.3)
    for told, true in zip(magnet.parameters, MAGNET_GAUSS, strict=True):
        assert abs(told.value - true) < 4 * told.std < 2e-3
    assert not found.unexplained.detected


@pytest.mark.slow
def test_temporary_magnet_brought_by_hand_is_one_step_with_an_end():
    # stronger than the field itself, and moved for a second: no single instant is that of a step
    track = track_of(experiment("wam", motion="rov", samples=2400))
    since_s = track.time_s - track.time_s[0]
    on, off = (np.clip((since_s - at) / 1.2 + 0.5, 0.0, 1.0) for at in (35.0, 65.0))
    aside = np.sin(np.pi * on) ** 2 - 0.6 * np.sin(np.pi * off) ** 2
    way = np.outer(on - off, [0.07, -0.1, 0.5]) + np.outer(aside, [0.2, 0.15, 0.0])
    late = delayed_gyro(replace(track, mag_b_gauss=track.mag_b_gauss + way), -0.012)
    found = {one.effect: one for one in diagnose(late).findings}
    assert set(found) == {"hard_iron_step", "mag_time_lag"}
    ((first, last),) = found["hard_iron_step"].where.intervals_s
    assert first == pytest.approx(track.time_s[0] + 35.0, abs=2.0)
    assert last == pytest.approx(track.time_s[0] + 65.0, abs=2.0)
    for told, true in zip(found["hard_iron_step"].parameters, (0.07, -0.1, 0.5), strict=True):
        assert abs(told.value - true) < max(4 * told.std, 1e-3)
    (lag,) = found["mag_time_lag"].parameters
    assert lag.value == pytest.approx(0.012, abs=max(4 * lag.std, 3e-4))


@pytest.mark.slow
def test_permanent_magnet_is_a_step_without_an_end():
    track = track_of(experiment("wam", seed=15, samples=4000))
    begin_s = float(track.time_s[1200])
    (magnet,) = diagnose(_with_magnet(track, begin_s, np.inf)).findings
    assert magnet.effect == "hard_iron_step"
    assert "end_s" not in magnet.setting
    ((first, last),) = magnet.where.intervals_s
    assert first == pytest.approx(begin_s, abs=0.3)
    assert last == pytest.approx(track.time_s[-1], abs=0.2)
