"""What is said of a quiet recording."""

from __future__ import annotations

from dataclasses import replace

import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def quiet() -> Track:
    return replace(made(Trial(seed=8, samples=5000)).track, covariates={})


def test_nothing_is_said_of_a_quiet_recording_but_what_it_would_have_shown(quiet: Track) -> None:
    answer = diagnose(quiet)
    assert not answer.mismatch
    assert answer.findings == ()
    limits = {(one.effect, one.parameter): one.smallest for one in answer.sensitivity}
    lag_s = limits["mag_time_lag", "lag"]
    assert lag_s is not None and 0.0 < lag_s < 0.01
    assert any("stuck" in note for note in answer.notes)
    assert all(test.p_after > 1e-6 for test in answer.omnibus.values())
