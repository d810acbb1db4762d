"""A clock that is off looks like a gyro whose axes are all off alike."""

from __future__ import annotations

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.mark.slow
def test_a_clock_that_is_off_shares_with_a_gyro_whose_axes_are_all_off_alike():
    trial = Trial(3, (("clock_rate", 1.0),), samples=8_000, rate_hz=25.0)
    found = diagnose(made(trial).track)
    (one,) = found.findings
    assert one.effect == "clock_rate"
    gyro = next(other for other in one.alternatives if other.effect == "gyro_scale")
    assert gyro.confidence == pytest.approx(one.confidence / 2, rel=0.01)
    assert one.separate_from == "compare with the host's time"
