"""A hard iron that settles is a single finding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


@pytest.mark.slow
def test_unlogged_warm_up_is_a_single_drift() -> None:
    quiet = replace(made(Trial(seed=8, samples=6000)).track, covariates={})
    passed_s = quiet.time_s - quiet.time_s[0]
    part = -np.expm1(-passed_s / 90.0) / -np.expm1(-passed_s[-1] / 90.0)
    field = part[:, None] * np.array([2e-3, -3e-3, 1.5e-3])
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + field))
    assert [one.effect for one in answer.findings] == ["hard_iron_drift"]
    assert not answer.unexplained.detected
    found = [one.value for one in answer.findings[0].parameters]
    assert found == pytest.approx([2e-3, -3e-3, 1.5e-3], abs=2e-4)
    assert answer.findings[0].setting["time_constant_s"] == pytest.approx(90.0, rel=0.2)
