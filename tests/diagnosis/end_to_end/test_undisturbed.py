"""Diagnosis of an undisturbed recording."""

from __future__ import annotations

from dataclasses import replace

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def undisturbed() -> Track:
    return replace(made(Trial(seed=8, samples=5000)).track, covariates={})


def test_undisturbed_recording_has_no_finding_and_reports_its_sensitivity(
    undisturbed: Track,
) -> None:
    answer = diagnose(undisturbed)
    assert not answer.mismatch
    assert answer.findings == ()
    limits = {(one.effect, one.parameter): one.smallest for one in answer.sensitivity}
    lag_s = limits["mag_time_lag", "lag"]
    assert lag_s is not None and 0.0 < lag_s < 0.01
    assert any("stuck" in note for note in answer.notes)
    assert all(test.p_after > 1e-6 for test in answer.omnibus.values())
