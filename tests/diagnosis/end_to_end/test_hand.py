"""Readings taken while a hand puts on a magnet have no weight, and the other effects are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.delay import delayed_gyro
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track

MAGNET = np.array([0.07, -0.1, 0.5])

ON_S, OFF_S, HAND_S = 60.0, 110.0, 1.2

LAG_S = 0.012


def handled(lag_s: float = 0.0) -> Track:
    """A magnet put on and taken off by a hand, which brings it from the side."""
    track = track_of(experiment("wam", motion="rov", samples=4000))
    time_s = track.time_s - track.time_s[0]
    on, off = (np.clip((time_s - at) / HAND_S + 0.5, 0.0, 1.0) for at in (ON_S, OFF_S))
    aside = np.sin(np.pi * on) ** 2 - 0.6 * np.sin(np.pi * off) ** 2
    field = (on - off)[:, None] * MAGNET + aside[:, None] * np.array([0.2, 0.15, 0.0])
    return delayed_gyro(replace(track, mag_b_gauss=track.mag_b_gauss + field), -lag_s)


@pytest.mark.xfail(strict=True, reason="magnet and lag are one unknown while the magnet is there")
@pytest.mark.slow
def test_delay_is_found_with_its_value_when_a_hand_puts_on_a_magnet() -> None:
    found = diagnose(handled(LAG_S))
    steps = [one for one in found.findings if one.effect == "hard_iron_step"]
    (lag,) = (one for one in found.findings if one.effect != "hard_iron_step")
    assert len(steps) == 2
    assert lag.effect == "mag_time_lag"
    (told,) = lag.parameters
    assert abs(told.value - LAG_S) < max(3 * told.std, 3e-4)
    assert told.std < 1e-3
    assert not found.unexplained.detected
    assert any("left out" in note for note in found.notes)
