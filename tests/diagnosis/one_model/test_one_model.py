"""Whole diagnoses by one model: nothing on a null, a step at its time, a source that is hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.one_model.diagnose import diagnose


@pytest.mark.parametrize("scenario", ["wam", "mam"])
def test_a_null_has_no_name_and_no_unknown(scenario):
    found = diagnose(track_of(experiment(scenario, seed=3, samples=4000)))
    assert found.findings == ()
    assert not found.unexplained.detected
    assert not found.mismatch


def test_a_step_of_the_hard_iron_is_dated_and_sized():
    track = track_of(experiment("wam", seed=4, samples=4000))
    step = np.array([8e-3, -5e-3, 3e-3])
    later = track.time_s[:, None] >= 67.0
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + later * step))
    assert [one.effect for one in found.findings] == ["hard_iron_step"]
    (one,) = found.findings
    assert one.setting["onset_s"] == pytest.approx(67.0, abs=0.5)
    np.testing.assert_allclose([p.value for p in one.parameters], step, atol=6e-4)
    assert not found.unexplained.detected


def test_a_current_that_nobody_logged_is_unknown_on_the_sensor():
    track = track_of(experiment("wam", seed=5, samples=4000))
    t = track.time_s - track.time_s[0]
    level = sum(np.sin(2 * np.pi * t / period + k) for k, period in enumerate((23.0, 41.0, 71.0)))
    axis = np.array([0.6, -0.7, 0.39])
    added = 5e-3 * level[:, None] * axis
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    left = found.unexplained
    assert left.detected
    assert left.where is not None
    assert left.where.frame == "sensor"
    assert left.where.direction is not None
    assert abs(np.array(left.where.direction) @ axis) > 0.95
    at, source = np.array(left.course).T
    logged = np.interp(at, t + track.time_s[0], level)
    assert abs(np.corrcoef(source, logged)[0, 1]) > 0.9


def test_the_answer_is_the_same_again():
    track = track_of(experiment("mam", seed=6, samples=3000))
    first, again = (diagnose(track).to_json() for _ in range(2))
    assert first == again
