"""A strong current with noise in its column, and a gyro with instantaneous rates, in averaged
rows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from tracks import experiment, track_of

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

FIELD_PER_A = np.array([7.5e-3, -3.75e-3, 7.5e-3])


def _motor(track: Track) -> Array:
    """(N,) A: a mean of 5 A, whose field is forty times the magnetometer's noise."""
    rng = np.random.default_rng(3)
    slow = gaussian_filter1d(rng.normal(size=len(track)), 1.0 / track.step_s)
    return np.maximum(5.0 + 3.5 * slow / np.std(slow), 0.0)


@pytest.fixture(scope="module")
def driven() -> Track:
    """20 Hz, averaged in pairs: the hard iron of a cold start is wrong by 40 mG."""
    track = track_of(experiment("wam", seed=4, samples=4800, rate_hz=20.0))
    rate = track.gyro_b_rad_s
    at_instants = np.vstack([(rate[:-1] + rate[1:]) / 2, rate[-1:]])
    logged = _motor(track) + np.random.default_rng(4).normal(0.0, 0.05, len(track))
    mag = track.mag_b_gauss + np.outer(_motor(track), FIELD_PER_A)
    track = replace(track, mag_b_gauss=mag, gyro_b_rad_s=at_instants)
    return track.with_columns({"motor_current_a": logged})


@pytest.mark.slow
def test_current_and_half_a_step_of_delay_are_the_only_findings(driven: Track) -> None:
    found = diagnose(driven)
    names = {one.effect: one for one in found.findings}
    assert names.keys() in ({"motor_current_field", "gyro_integration"},
                            {"motor_current_field", "mag_time_lag"})  # fmt: skip
    for told, true in zip(names["motor_current_field"].parameters, FIELD_PER_A, strict=True):
        assert abs(told.value - true) < 4 * told.std < 1e-4
    assert not found.unexplained.detected
    assert any("motor_current_a is noisy" in note for note in found.notes)
