"""Whole diagnoses by one model: nothing on a null, a step at its time, a source that is hidden."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from odd_tracks import standing, warming
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.repaired_model.forward import context_along, terms_contribution
from ahrsd.diagnosis.repaired_model.model_file import from_text, repaired_model_of, to_text
from ahrsd.diagnosis.track import NothingToFit
from ahrsd.simulation import ScenarioSettings, simulate


@pytest.mark.parametrize("scenario", ["wam", pytest.param("mam", marks=pytest.mark.slow)])
def test_a_null_has_no_name_and_no_unknown(scenario):
    found = diagnose(track_of(experiment(scenario, seed=3, samples=4000)))
    assert found.findings == ()
    assert not found.unexplained.detected
    assert not found.mismatch
    # how far from another answer: no name's odds reach what is asked whatever was assumed
    (near,) = (
        note for note in found.notes if note.startswith("the effect nearest to a finding is ")
    )
    assert max(float(odds) for odds in re.findall(r"[+-]\d+\.\d", near)) < 3.0
    assert {limit.effect for limit in found.sensitivity} >= {"hard_iron_step", "sync_pulses"}
    assert all(check.inside_after for check in found.posterior_predictive.values())


def test_a_step_of_the_hard_iron_is_dated_and_sized():
    track = track_of(experiment("wam", seed=4, samples=2000))
    step = np.array([8e-3, -5e-3, 3e-3])
    later = track.time_s[:, None] >= 35.0
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + later * step))
    assert [one.effect for one in found.findings] == ["hard_iron_step"]
    (one,) = found.findings
    assert one.setting["onset_s"] == pytest.approx(35.0, abs=0.5)
    assert "end_s" not in one.setting
    ((first, last),) = one.where.intervals_s
    assert first == pytest.approx(35.0, abs=0.5)
    assert last == pytest.approx(track.time_s[-1], abs=0.2)
    np.testing.assert_allclose([p.value for p in one.parameters], step, atol=6e-4)
    # without it the hard iron is the mean over the recording, of which it is on in 58 %
    mean_gauss = np.linalg.norm(step) * np.mean(later)
    assert one.cost_if_left_out.hard_iron_shift_gauss == pytest.approx(mean_gauss, rel=0.3)
    assert one.cost_if_left_out.heading_error_deg > 0.3
    assert not found.unexplained.detected


def test_a_current_that_nobody_logged_is_unknown_on_the_sensor():
    track = track_of(experiment("wam", seed=5, samples=2000))
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


_TOLD = """
import sys
import numpy as np
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track
steps = {key: row for key, row in EFFECTS.items() if row.jumps or "drift" in key}
known = np.load(sys.argv[1])
rows = (slice(0, len(known["time_s"])),)
track = Track(**known, accel_b_m_s2=None, runs=rows)
print(diagnose(track, library=steps).to_json())
"""


def test_the_answer_is_the_same_in_another_process(tmp_path):
    """Names are strings, and where a set of them begins differs from process to process."""
    track = track_of(experiment("wam", seed=6, samples=900))
    later = track.time_s[:, None] >= 20.0
    mag = track.mag_b_gauss + later * np.array([8e-3, -5e-3, 3e-3])
    parts = {"time_s": track.time_s, "dt_s": track.dt_s, "gyro_b_rad_s": track.gyro_b_rad_s}
    np.savez(tmp_path / "track.npz", **parts, mag_b_gauss=mag)
    told = [
        subprocess.run(
            [sys.executable, "-c", _TOLD, str(tmp_path / "track.npz")],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for seed in ("1", "2")
    ]
    assert "hard_iron_step" in told[0]
    assert told[0] == told[1]


@pytest.mark.slow
def test_a_gyro_bias_that_walks_is_a_drift_whatever_its_course():
    track = track_of(experiment("wam", seed=7, samples=2000))
    walk = np.cumsum(np.random.default_rng(3).normal(size=(len(track), 3)), axis=0)
    walk *= 2e-3 / np.std(walk, axis=0)
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + walk))
    assert [one.effect for one in found.findings] == ["gyro_bias_drift"]
    assert not found.unexplained.detected
    (drift,) = found.findings
    assert drift.confidence > 0.99
    assert drift.where.frame == "gyro"
    modes = np.array([p.value for p in drift.parameters]).reshape(-1, 3)
    t = (track.time_s - track.time_s[0]) / track.duration_s
    told = np.sin(np.pi * np.outer(t, np.arange(len(modes)) + 0.5)) @ modes
    told, truth = (one - one.mean(axis=0) for one in (told, walk))
    assert np.linalg.norm(told - truth) < 0.6 * np.linalg.norm(truth)


@pytest.mark.slow
def test_pulses_that_averaging_loses_are_named_at_the_recorded_rate():
    track = track_of(experiment("wam", seed=9, samples=2000))
    since_s = track.time_s - track.time_s[0]
    hit = np.mod(since_s - 0.5, 2.0) < 0.06
    pulse = np.array([3e-3, -2e-3, 1.5e-3])
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + hit[:, None] * pulse))
    assert [one.effect for one in found.findings] == ["sync_pulses"]
    (one,) = found.findings
    assert one.setting["period_s"] == pytest.approx(2.0, abs=0.01)
    np.testing.assert_allclose([p.value for p in one.parameters], pulse, atol=6e-4)


@pytest.mark.slow
def test_the_bias_of_a_gyro_that_stands_is_told_without_the_field():
    warmth = warming(2400)
    slope = np.array([5e-5, -2e-5, -1.5e-4])
    found = diagnose(standing(1e-3 + (warmth - 12.0)[:, None] * slope, warmth))
    told = [one for one in found.findings if one.effect == "gyro_bias_temperature"]
    assert len(told) == 1
    np.testing.assert_allclose([p.value for p in told[0].parameters], slope, atol=3e-5)
    assert any("hardly turned" in note for note in found.notes)


def test_a_dead_sensor_is_refused_in_words():
    track = track_of(experiment("wam", seed=3, samples=2000))
    with pytest.raises(NothingToFit, match="stuck or was not logged"):
        diagnose(replace(track, gyro_b_rad_s=np.zeros_like(track.gyro_b_rad_s)))


def test_a_recording_with_facts_that_stop_is_told_them_and_nothing_else():
    track = track_of(experiment("wam", seed=3, samples=2000))
    swapped = track.gyro_b_rad_s[:, [1, 0, 2]] * np.array([1.0, 1.0, 1.0])
    found = diagnose(replace(track, gyro_b_rad_s=swapped))
    assert [one.effect for one in found.findings] == ["frame_error"]
    assert found.model is None
    assert found.mismatch


@pytest.mark.slow
def test_half_a_step_of_delay_is_told_with_what_would_tell_it_from_a_lag():
    size = {"samples": 1400, "rate_hz": 12.5}
    made_one = made(Trial(seed=31, effects=(("gyro_integration", 1.0),), **size))
    (one,) = diagnose(made_one.track).findings
    assert one.effect == "gyro_integration"
    assert one.parameters[0].value == pytest.approx(1.0, abs=0.05)
    assert one.where.frame == "gyro"
    others = {share.effect: share.confidence for share in one.alternatives}
    assert others.keys() == {"mag_time_lag", "mag_low_pass"}
    assert one.confidence + sum(others.values()) == pytest.approx(1.0, abs=1e-6)
    assert "two rates" in one.separate_from


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "strength"),
    [("mag_low_pass", 3.0), ("gyro_time_lag", 2.0)],
)
def test_a_delay_of_any_kind_is_in_the_repaired_model_as_it_was(name, strength):
    one = made(Trial(seed=34, effects=((name, strength),), samples=2500, rate_hz=12.5))
    found = diagnose(one.track)
    (term,) = found.terms
    assert term.identifier == name
    _, value, _ = one.truth[0]
    np.testing.assert_allclose(term.value, value, rtol=0.06)
    kept = from_text(to_text(repaired_model_of(found)))
    clean = context_along(one.track, kept.calibration)
    mag, gyro = terms_contribution(clean, kept.terms)
    # as large as the field turns in that time
    if name == "mag_low_pass":
        late = np.linalg.norm(clean.field_dot_b, axis=1) * float(value[0])
        assert np.median(np.linalg.norm(mag, axis=1)) == pytest.approx(np.median(late), rel=0.2)
    else:
        assert np.max(np.abs(gyro)) > 1e-3


def test_a_current_that_comes_late_into_the_log_is_named_and_moved_to_its_time():
    """Held against the field as it was logged it explains nothing."""
    track = track_of(experiment("wam", seed=10, samples=3000))
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("varies", [0.0, 1.5])
def test_a_name_whose_coefficient_varies_by_as_much_as_itself_is_not_told(varies):
    track = made(Trial(seed=31, effects=(), samples=4000)).track
    amps, since_s = track.covariates["motor_current_a"], track.time_s - track.time_s[0]
    by = 1.0 + varies * np.cos(2 * np.pi * since_s / track.duration_s)
    axis = np.array([0.6, -0.7, 0.39])
    added = 1e-3 * (amps * by)[:, None] * axis
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    if varies == 0.0:
        assert [one.effect for one in found.findings] == ["motor_current_field"]
        assert not found.unexplained.detected
        return
    assert found.findings == ()
    left = found.unexplained
    assert left.detected
    assert left.where.frame == "sensor"
    assert abs(np.array(left.where.direction) @ axis) > 0.99
    at, source = np.array(left.course).T
    put = np.interp(at, track.time_s, 1e-3 * amps * by)
    assert abs(np.corrcoef(source, put)[0, 1]) > 0.9


@pytest.mark.slow
def test_a_line_that_wanders_in_frequency_is_no_alternating_field_but_unknown():
    track = track_of(experiment("wam", seed=9, samples=2000))
    since_s = track.time_s - track.time_s[0]
    turns = 8.0 * since_s + 1.5 * np.sin(2 * np.pi * since_s / 60.0)
    added = 4e-3 * np.cos(2 * np.pi * turns)[:, None] * [0.6, -0.7, 0.39]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "sensor"


@pytest.mark.slow
def test_eddy_currents_that_differ_by_axis_are_named_without_a_delay():
    # the vehicle yaws: its field along one axis hardly changes, and a factor of that is none
    one = made(Trial(seed=54, effects=(("eddy_current", 1.0),), samples=2000, rate_hz=25.0))
    found = diagnose(one.track)
    assert [finding.effect for finding in found.findings] == ["eddy_current"]
    assert not found.unexplained.detected
    _, truth, _ = one.truth[0]
    size = np.array([p.value for p in found.findings[0].parameters])
    np.testing.assert_allclose(size, truth, atol=3e-3)


@pytest.mark.slow
def test_a_delay_is_no_eddy_current():
    one = made(Trial(seed=44, effects=(("mag_time_lag", 3.0),), samples=3000, rate_hz=25.0))
    found = diagnose(one.track)
    assert [finding.effect for finding in found.findings] == ["mag_time_lag"]
    assert found.findings[0].parameters[0].value == pytest.approx(0.06, abs=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("aligned", [0.0, 1.0])
def test_a_mount_that_was_aligned_under_its_load_is_no_crooked_gyro_as_well(aligned):
    run = simulate(ScenarioSettings("mam", "rov", 47, 6000, 25.0, 0.0, 0.0))
    track, rng = track_of(run), np.random.default_rng(47)
    rest_g = aligned * track.accel_b_m_s2.mean(axis=0) / 9.80665
    bend = np.array([[0.004, 0.016, -0.006], [-0.018, 0.003, 0.008], [0.004, -0.006, 0.002]])
    load_g = track.accel_b_m_s2 / 9.80665 - rest_g
    turned = np.einsum("nij,nj->ni", so3.exp(load_g @ bend.T), run.field_b)
    mag = track.mag_b_gauss + (turned - run.field_b) @ run.truth.soft_iron.T
    mag = mag + 3e-4 * rng.normal(size=mag.shape)
    gyro = track.gyro_b_rad_s + 3e-4 * rng.normal(size=mag.shape)
    found = diagnose(replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro))
    assert [one.effect for one in found.findings] == ["flexible_mount"]
    np.testing.assert_allclose(
        found.findings[0].setting.get("straight_g", np.zeros(3)), rest_g, atol=0.1
    )
    assert not found.unexplained.detected


@pytest.mark.slow
def test_a_scale_that_creeps_is_no_compensation_on_board():
    """A compensation takes hard iron away: a part of it below a hundredth is another source."""
    track = track_of(experiment("wam", seed=12, samples=4000))
    since_s = track.time_s - track.time_s[0]
    warmer = 0.012 * (1.0 - np.exp(-since_s / 50.0))
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss * (1.0 + warmer[:, None])))
    assert found.findings == ()
    assert found.unexplained.detected
    one = made(Trial(seed=62, effects=(("onboard_calibration_active", 1.0),), samples=4000))
    (told,) = diagnose(one.track).findings
    assert told.effect == "onboard_calibration_active"
    assert told.parameters[0].value == pytest.approx(one.truth[0][1][0], abs=0.1)


@pytest.mark.slow
def test_beside_a_large_unknown_of_one_sensor_a_small_name_of_the_other_is_not_told():
    track = made(Trial(seed=71, effects=(("gyro_g_sensitivity", 1.0),), samples=3000)).track
    assert [one.effect for one in diagnose(track).findings] == ["gyro_g_sensitivity"]
    t = track.time_s - track.time_s[0]
    level = sum(np.sin(2 * np.pi * t / period + k) for k, period in enumerate((23.0, 41.0, 71.0)))
    added = 3e-3 * level[:, None] * [0.6, -0.7, 0.39]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    assert found.unexplained.where.frame == "sensor"
