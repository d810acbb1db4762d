"""Bursts of a second are located and remain unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def undisturbed() -> Track:
    return replace(made(Trial(seed=8, samples=6000)).track, covariates={})


@pytest.mark.slow
def test_bursts_are_an_unknown_cause_with_their_intervals(undisturbed: Track) -> None:
    times = np.array([31.0, 62.0, 75.5, 120.0, 171.0, 203.0])
    on = np.any(np.abs(undisturbed.time_s[:, None] - times) < 0.6, axis=1)[:, None]
    answer = diagnose(
        replace(undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + on * np.array([4e-3, 0, -3e-3]))
    )
    assert answer.findings == ()
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
    assert len(where.intervals_s) == 6
    ends = np.array(where.intervals_s)
    assert np.abs(ends - times[:, None] - [-0.6, 0.6]).max() < 0.25
    assert answer.omnibus["normality"].p_before < 1e-6
