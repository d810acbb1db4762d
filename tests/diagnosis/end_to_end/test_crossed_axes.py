"""Axes of the magnetometer that read a part of each other."""

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.fixture(scope="module")
def crossed():
    return made(Trial(3, (("mag_cross_axis", 2.0),), samples=6000)).track


@pytest.mark.slow
def test_crossed_axes_are_one_name(crossed):
    assert [one.effect for one in diagnose(crossed).findings] == ["mag_cross_axis"]
