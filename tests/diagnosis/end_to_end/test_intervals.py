"""Intervals in which a source departs from its usual level."""

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
def test_intervals_of_a_switching_source_are_reported(undisturbed: Track) -> None:
    spans_s = [(40.0, 71.0), (95.0, 128.0), (171.0, 190.0)]
    on = np.any([(undisturbed.time_s >= a) & (undisturbed.time_s < b) for a, b in spans_s], axis=0)
    field = on[:, None] * np.array([2e-3, 1e-3, -2e-3])
    answer = diagnose(replace(undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + field))
    assert answer.findings == ()
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
    assert np.abs(np.array(where.intervals_s) - spans_s).max() < 2.0


@pytest.mark.slow
def test_interval_of_a_temporary_gyro_bias_is_reported(undisturbed: Track) -> None:
    part = np.clip((undisturbed.time_s - 100.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * part)[:, None] ** 2 * np.array([1e-3, -2e-3, 2e-3])
    answer = diagnose(replace(undisturbed, gyro_b_rad_s=undisturbed.gyro_b_rad_s + bump))
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "gyro"
    (begin, end) = where.intervals_s[0]
    assert begin == pytest.approx(100.0, abs=8.0)
    assert end == pytest.approx(140.0, abs=8.0)
