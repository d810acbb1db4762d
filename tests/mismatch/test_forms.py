"""The unknown that has no course: it is told, and in which frame."""

from dataclasses import replace

import numpy as np
from mismatch_trials import Trial, made

from ahrsd.mismatch.engine import diagnose


def test_a_gyro_that_turns_more_to_one_side_is_an_unknown_of_the_gyro():
    track = made(Trial(8, samples=8_000, rate_hz=25.0)).track
    rate = track.gyro_b_rad_s
    uneven = rate + 0.004 * np.maximum(rate, 0.0)
    found = diagnose(replace(track, gyro_b_rad_s=uneven))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
    assert found.unexplained.evidence_nats > 15.0
