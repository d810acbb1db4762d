"""Effects with similar smooth time courses."""

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_two_smooth_effects_are_both_found(seed):
    effects = (("hard_iron_drift", 3.0), ("mag_scale_temperature", 1.0))
    found = diagnose(made(Trial(seed, effects, samples=6000)).track)
    assert {one.effect for one in found.findings} == {name for name, _ in effects}
