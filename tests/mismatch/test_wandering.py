"""A gyro's bias that walks more than an ordinary one's has a name; a course that does not, none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.mismatch.engine import diagnose


@pytest.fixture(scope="module")
def track():
    return made(Trial(seed=11, samples=7500, rate_hz=25.0, scenario="wam", noise="white")).track


def test_a_bias_that_walks_a_lot_is_named_and_leaves_nothing(track):
    steps = np.random.default_rng(3).normal(size=(len(track), 3)) * np.sqrt(0.04)
    walked = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + 4e-5 * np.cumsum(steps, axis=0))
    found = diagnose(walked)
    assert [one.effect for one in found.findings] == ["gyro_bias_drift"]
    assert not found.unexplained.detected


def test_a_bias_that_swings_is_no_walk(track):
    swing = 6e-4 * np.sin(2 * np.pi * track.time_s / 37.0)[:, None] * np.array([1.0, -0.5, 0.7])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + swing))
    assert "gyro_bias_drift" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
