"""A flexible mount with a noisy accelerometer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.mark.slow
def test_compliance_of_a_mount_is_unbiased_with_a_noisy_accelerometer() -> None:
    """From the unsmoothed force the effect is not found at all."""
    one = made(Trial(7, (("flexible_mount", 2.0),), samples=9000, sigma_gyro=2e-3))
    rng = np.random.default_rng(3)
    noisy = one.track.accel_b_m_s2 + 0.5 * rng.standard_normal((9000, 3))
    answer = diagnose(replace(one.track, accel_b_m_s2=noisy, covariates={}))
    assert [found.effect for found in answer.findings] == ["flexible_mount"]
    values = answer.findings[0].parameters
    off_diagonal = [1, 2, 3, 5, 6, 7]
    z = np.array([(values[k].value - one.truth[0][1][k]) / values[k].std for k in off_diagonal])
    assert np.abs(z).max() < 3.0
