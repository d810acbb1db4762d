"""When a source is away from its usual level: states, boxes and waves, and none in noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def quiet() -> Track:
    return replace(made(Trial(seed=8, samples=6000)).track, covariates={})


@pytest.mark.slow
def test_what_comes_and_goes_is_told_from_beginning_to_end(quiet: Track) -> None:
    spans_s = [(40.0, 71.0), (95.0, 128.0), (171.0, 190.0)]
    on = np.any([(quiet.time_s >= a) & (quiet.time_s < b) for a, b in spans_s], axis=0)
    field = on[:, None] * np.array([2e-3, 1e-3, -2e-3])
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + field))
    assert answer.findings == ()
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
    assert np.abs(np.array(where.intervals_s) - spans_s).max() < 2.0


@pytest.mark.slow
def test_a_bump_of_the_gyro_is_told_where_it_is(quiet: Track) -> None:
    part = np.clip((quiet.time_s - 100.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * part)[:, None] ** 2 * np.array([1e-3, -2e-3, 2e-3])
    answer = diagnose(replace(quiet, gyro_b_rad_s=quiet.gyro_b_rad_s + bump))
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "gyro"
    (begin, end) = where.intervals_s[0]
    assert begin == pytest.approx(100.0, abs=8.0)
    assert end == pytest.approx(140.0, abs=8.0)
