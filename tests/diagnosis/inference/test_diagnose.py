"""Whole diagnoses: nothing for a null, effects with time and size, and unknown sources."""

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
def test_null_recording_has_no_finding_and_no_unknown_cause(scenario):
    found = diagnose(track_of(experiment(scenario, seed=3, samples=4000)))
    assert found.findings == ()
    assert not found.unexplained.detected
    assert not found.mismatch
    # distance to another answer: no effect's odds reach the threshold under any assumed prior
    (near,) = (
        note for note in found.notes if note.startswith("the effect nearest to a finding is ")
    )
    assert max(float(odds) for odds in re.findall(r"[+-]\d+\.\d", near)) < 3.0
    assert {limit.effect for limit in found.sensitivity} >= {"hard_iron_step", "sync_pulses"}
    assert all(check.inside_after for check in found.posterior_predictive.values())


def test_hard_iron_step_is_found_with_onset_and_size():
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
    # without it the hard iron is the mean over the recording; the step is on in 58 % of it
    mean_gauss = np.linalg.norm(step) * np.mean(later)
    assert one.cost_if_left_out.hard_iron_shift_gauss == pytest.approx(mean_gauss, rel=0.3)
    assert one.cost_if_left_out.heading_error_deg > 0.3
    assert not found.unexplained.detected


def test_unlogged_current_is_an_unknown_cause_on_the_sensor():
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


_SCRIPT = """
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


@pytest.mark.slow
def test_answer_is_the_same_in_another_process(tmp_path):
    """The order of a set of strings differs from process to process."""
    track = track_of(experiment("wam", seed=6, samples=900))
    later = track.time_s[:, None] >= 20.0
    mag = track.mag_b_gauss + later * np.array([8e-3, -5e-3, 3e-3])
    parts = {"time_s": track.time_s, "dt_s": track.dt_s, "gyro_b_rad_s": track.gyro_b_rad_s}
    np.savez(tmp_path / "track.npz", **parts, mag_b_gauss=mag)
    told = [
        subprocess.run(
            [sys.executable, "-c", _SCRIPT, str(tmp_path / "track.npz")],
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
def test_random_walk_of_the_gyro_bias_is_a_drift():
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
def test_pulses_lost_by_averaging_are_found_at_the_recorded_rate():
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
def test_temperature_dependent_gyro_bias_is_found_at_rest():
    warmth = warming(2400)
    slope = np.array([5e-5, -2e-5, -1.5e-4])
    found = diagnose(standing(1e-3 + (warmth - 12.0)[:, None] * slope, warmth))
    told = [one for one in found.findings if one.effect == "gyro_bias_temperature"]
    assert len(told) == 1
    np.testing.assert_allclose([p.value for p in told[0].parameters], slope, atol=3e-5)
    assert any("hardly turned" in note for note in found.notes)


def test_dead_sensor_is_refused_with_a_reason():
    track = track_of(experiment("wam", seed=3, samples=2000))
    with pytest.raises(NothingToFit, match="stuck or was not logged"):
        diagnose(replace(track, gyro_b_rad_s=np.zeros_like(track.gyro_b_rad_s)))


def test_facts_that_stop_the_diagnosis_are_the_only_findings():
    track = track_of(experiment("wam", seed=3, samples=2000))
    swapped = track.gyro_b_rad_s[:, [1, 0, 2]] * np.array([1.0, 1.0, 1.0])
    found = diagnose(replace(track, gyro_b_rad_s=swapped))
    assert [one.effect for one in found.findings] == ["frame_error"]
    assert found.model is None
    assert found.mismatch


@pytest.mark.slow
def test_half_a_step_of_delay_is_found_with_advice_to_separate_it_from_a_lag():
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
def test_repaired_model_contains_the_delay_with_its_value(name, strength):
    one = made(Trial(seed=34, effects=((name, strength),), samples=2500, rate_hz=12.5))
    found = diagnose(one.track)
    (term,) = found.terms
    assert term.identifier == name
    _, value, _ = one.truth[0]
    np.testing.assert_allclose(term.value, value, rtol=0.06)
    kept = from_text(to_text(repaired_model_of(found)))
    clean = context_along(one.track, kept.calibration)
    mag, gyro = terms_contribution(clean, kept.terms)
    # as large as the rotation of the field in that time
    if name == "mag_low_pass":
        late = np.linalg.norm(clean.field_dot_b, axis=1) * float(value[0])
        assert np.median(np.linalg.norm(mag, axis=1)) == pytest.approx(np.median(late), rel=0.2)
    else:
        assert np.max(np.abs(gyro)) > 1e-3


@pytest.mark.slow
def test_current_logged_with_a_delay_is_found_and_shifted():
    """As logged it does not explain the field."""
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
def test_hand_motion_with_a_magnet_is_no_finding_besides_its_step():
    track = track_of(experiment("wam", seed=11, samples=4000))
    t = track.time_s - track.time_s[0]
    near = 0.3 * np.exp(
        -0.5 * ((t - 65.5) / 0.5) ** 2
    )  # the magnet passes the sensor and is then put on
    put = near[:, None] * [0.5, 0.8, -0.3] + (t > 66.5)[:, None] * [0.04, -0.03, 0.02]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + put))
    assert [one.effect for one in found.findings] == ["hard_iron_step"]
    (one,) = found.findings
    assert one.setting["onset_s"] == pytest.approx(track.time_s[0] + 66.0, abs=2.0)
    np.testing.assert_allclose([p.value for p in one.parameters], [0.04, -0.03, 0.02], atol=2e-3)
    assert not found.unexplained.detected


@pytest.mark.slow
@pytest.mark.parametrize("varies", [0.0, 1.5])
def test_effect_with_a_strongly_varying_coefficient_is_unknown(varies):
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
def test_line_of_wandering_frequency_is_unknown():
    track = track_of(experiment("wam", seed=9, samples=2000))
    since_s = track.time_s - track.time_s[0]
    turns = 8.0 * since_s + 1.5 * np.sin(2 * np.pi * since_s / 60.0)
    added = 4e-3 * np.cos(2 * np.pi * turns)[:, None] * [0.6, -0.7, 0.39]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "sensor"


@pytest.mark.slow
def test_anisotropic_eddy_currents_are_found_without_a_delay():
    # the vehicle yaws: the field along one axis hardly changes, so its factor is not determined
    one = made(Trial(seed=54, effects=(("eddy_current", 1.0),), samples=2000, rate_hz=25.0))
    found = diagnose(one.track)
    assert [finding.effect for finding in found.findings] == ["eddy_current"]
    assert not found.unexplained.detected
    _, truth, _ = one.truth[0]
    size = np.array([p.value for p in found.findings[0].parameters])
    np.testing.assert_allclose(size, truth, atol=3e-3)


@pytest.mark.slow
def test_delay_is_not_taken_for_eddy_currents():
    one = made(Trial(seed=44, effects=(("mag_time_lag", 3.0),), samples=3000, rate_hz=25.0))
    found = diagnose(one.track)
    assert [finding.effect for finding in found.findings] == ["mag_time_lag"]
    assert found.findings[0].parameters[0].value == pytest.approx(0.06, abs=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("zeroed_at_rest", [0.0, 1.0])
def test_flexible_mount_is_found_without_a_misalignment_when_aligned_under_load(zeroed_at_rest):
    run = simulate(ScenarioSettings("mam", "rov", 47, 6000, 25.0, 0.0, 0.0))
    track, rng = track_of(run), np.random.default_rng(47)
    rest_g = zeroed_at_rest * track.accel_b_m_s2.mean(axis=0) / 9.80665
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
def test_slow_scale_change_is_not_an_onboard_compensation():
    """An on-board compensation removes hard iron: a share below 0.01 is another source."""
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
def test_small_effect_of_one_sensor_is_not_reported_with_a_large_unknown_of_the_other():
    track = made(Trial(seed=71, effects=(("gyro_g_sensitivity", 1.0),), samples=3000)).track
    assert [one.effect for one in diagnose(track).findings] == ["gyro_g_sensitivity"]
    t = track.time_s - track.time_s[0]
    level = sum(np.sin(2 * np.pi * t / period + k) for k, period in enumerate((23.0, 41.0, 71.0)))
    added = 3e-3 * level[:, None] * [0.6, -0.7, 0.39]
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    assert found.unexplained.where.frame == "sensor"
