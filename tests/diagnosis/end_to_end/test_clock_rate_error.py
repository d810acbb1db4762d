"""A clock-rate error looks like an isotropic gyro scale error."""

from __future__ import annotations

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.mark.slow
def test_clock_rate_error_shares_its_posterior_with_an_isotropic_gyro_scale():
    trial = Trial(3, (("clock_rate", 1.0),), samples=8_000, rate_hz=25.0)
    found = diagnose(made(trial).track)
    (one,) = found.findings
    assert one.effect == "clock_rate"
    gyro = next(other for other in one.alternatives if other.effect == "gyro_scale")
    assert gyro.confidence == pytest.approx(one.confidence / 2, rel=0.01)
    assert one.separate_from == "compare with the host's time"
