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
    # without it the hard iron is the mean over the recording, of which it is on in 58 %
    mean_gauss = np.linalg.norm(step) * np.mean(later)
    assert one.cost_if_left_out.hard_iron_shift_gauss == pytest.approx(mean_gauss, rel=0.3)
    assert one.cost_if_left_out.heading_error_deg > 0.3
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


def test_a_gyro_bias_that_walks_is_a_drift_whatever_its_course():
    track = track_of(experiment("wam", seed=7, samples=4000))
    walk = np.cumsum(np.random.default_rng(3).normal(size=(len(track), 3)), axis=0)
    walk *= 2e-3 / np.std(walk, axis=0)
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + walk))
    assert [one.effect for one in found.findings] == ["gyro_bias_drift"]
    assert not found.unexplained.detected
    (drift,) = found.findings
    assert drift.where.frame == "gyro"
    modes = np.array([p.value for p in drift.parameters]).reshape(-1, 3)
    t = (track.time_s - track.time_s[0]) / track.duration_s
    told = np.sin(np.pi * np.outer(t, np.arange(len(modes)) + 0.5)) @ modes
    told, truth = (one - one.mean(axis=0) for one in (told, walk))
    assert np.linalg.norm(told - truth) < 0.6 * np.linalg.norm(truth)


def test_pulses_that_averaging_loses_are_named_at_the_recorded_rate():
    track = track_of(experiment("wam", seed=9, samples=4000))
    since_s = track.time_s - track.time_s[0]
    hit = np.mod(since_s - 0.5, 2.0) < 0.06
    pulse = np.array([3e-3, -2e-3, 1.5e-3])
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + hit[:, None] * pulse))
    assert [one.effect for one in found.findings] == ["sync_pulses"]
    (one,) = found.findings
    assert one.setting["period_s"] == pytest.approx(2.0, abs=0.01)
    np.testing.assert_allclose([p.value for p in one.parameters], pulse, atol=6e-4)


def test_a_current_that_comes_late_into_the_log_is_named_and_moved_to_its_time():
    """Held against the field as it was logged it explains nothing."""
    track = track_of(experiment("wam", seed=10, samples=4000))
    rng = np.random.default_rng(4)
    changes = np.sort(rng.uniform(track.time_s[0], track.time_s[-1], size=160))
    levels = rng.uniform(0.0, 12.0, size=161)
    level = levels[np.searchsorted(changes, track.time_s)]
    true_a, logged_a = (np.interp(track.time_s - by, track.time_s, level) for by in (0.0, 0.3))
    per_ampere = np.array([1.2e-3, -0.7e-3, 0.5e-3])
    mag = track.mag_b_gauss + true_a[:, None] * per_ampere
    logged = {**track.covariates, "motor_current_a": logged_a}
    found = diagnose(replace(track, mag_b_gauss=mag, covariates=logged))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    (one,) = found.findings
    assert one.setting["late_s"] == pytest.approx(0.3, abs=0.03)
    np.testing.assert_allclose([p.value for p in one.parameters], per_ampere, rtol=0.1)
    assert not found.unexplained.detected


def test_the_way_of_a_hand_with_a_magnet_is_no_name_beside_its_step():
    track = track_of(experiment("wam", seed=11, samples=4000))
    t = track.time_s - track.time_s[0]
    near = 0.3 * np.exp(-0.5 * ((t - 65.5) / 0.5) ** 2)  # it passes the sensor, and is put on
    put = near[:, None] * [0.5, 0.8, -0.3] + (t > 66.5)[:, None] * [0.04, -0.03, 0.02]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + put))
    assert [one.effect for one in found.findings] == ["hard_iron_step"]
    (one,) = found.findings
    assert one.setting["onset_s"] == pytest.approx(track.time_s[0] + 66.0, abs=2.0)
    np.testing.assert_allclose([p.value for p in one.parameters], [0.04, -0.03, 0.02], atol=2e-3)
    assert not found.unexplained.detected
