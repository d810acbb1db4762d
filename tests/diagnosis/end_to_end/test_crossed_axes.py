"""Cross-axis sensitivity of the magnetometer."""

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.fixture(scope="module")
def crossed():
    return made(Trial(3, (("mag_cross_axis", 2.0),), samples=6000)).track


@pytest.mark.slow
def test_cross_axis_sensitivity_is_a_single_finding(crossed):
    assert [one.effect for one in diagnose(crossed).findings] == ["mag_cross_axis"]
