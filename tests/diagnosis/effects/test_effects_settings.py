"""Operators of the effects, and the settings that effects find in a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_motion import FIELD_N, SOFT_IRON, moving

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.effects.sensor_element import alias_frequency, spectral_lines


def seen(context, mag):
    """The context with other magnetometer readings."""
    return replace(context, track=replace(context.track, mag_b_gauss=mag))


def test_spectral_line_is_found_at_its_frequency():
    context, readings = moving(2, rows=2000)
    rng = np.random.default_rng(0)
    course = 1e-3 * np.sin(2 * np.pi * 3.217 * readings.time_s)[:, None] * [0.5, 0.3, -0.7]
    mag = readings.mag_b_gauss + course + 1e-3 * rng.standard_normal((2000, 3))
    first, second = EFFECTS["ac_interference"].settings(seen(context, mag))
    assert first["frequency_hz"] == pytest.approx(3.217, abs=0.004)
    assert first["searched"] == 1000
    assert abs(second["frequency_hz"] - 3.217) > 0.01


def test_mains_frequency_is_recognised_by_its_alias():
    assert alias_frequency(60.0, 25.0) == pytest.approx(10.0)
    assert alias_frequency(50.0, 25.0) == 0.0
    assert alias_frequency(50.0, 40.0) == pytest.approx(10.0)
    context, readings = moving(2, rows=2000, rate_hz=40.0)
    mag = readings.mag_b_gauss + 1e-3 * np.sin(2 * np.pi * 50.0 * readings.time_s)[:, None]
    noisy = mag + 1e-4 * np.random.default_rng(1).standard_normal((2000, 3))
    first, _ = EFFECTS["ac_interference"].settings(seen(context, noisy))
    assert first["mains_hz"] == [50.0]


@pytest.mark.parametrize(("hold", "phase"), [(2, 0), (4, 3), (5, 1)])
def test_hold_length_and_phase_of_repeated_readings_are_found(hold, phase):
    context, readings = moving(3)
    effect = EFFECTS["mag_sample_hold"]
    setting = {"hold_samples": hold, "phase": phase}
    rng = np.random.default_rng(0)
    noisy = replace(
        readings, mag_b_gauss=readings.mag_b_gauss + 1e-3 * rng.standard_normal((600, 3))
    )
    assert effect.settings(seen(context, noisy.mag_b_gauss)) == ()
    held = effect.simulate(noisy, np.ones(1), setting)
    assert effect.settings(seen(context, held.mag_b_gauss)) == (setting,)


def test_settings_of_a_passed_object_are_near_the_departure_of_the_field_size():
    context, readings = moving(4, rows=1200)
    effect = EFFECTS["field_anomaly"]
    value = 0.03 * FIELD_N / np.linalg.norm(FIELD_N)
    bump = {"onset_s": 30.0, "length_s": 12.0}
    made = effect.simulate(readings, value, bump)
    assert np.flatnonzero(np.abs(made.mag_b_gauss - readings.mag_b_gauss).max(axis=1) > 1e-9)[
        [0, -1]
    ] == pytest.approx(np.searchsorted(readings.time_s, [30.05, 41.95]), abs=1)
    found = effect.settings(seen(context, made.mag_b_gauss))
    bumps = [s for s in found if "onset_s" in s]
    nearest = min(abs(s["onset_s"] - 30) + abs(s["length_s"] - 12) for s in bumps)
    assert nearest < 1.5
    assert len([s for s in found if "place_m" in s]) >= 2
    assert {s["searched"] for s in found} == {30}


def test_effects_by_position_need_a_levelled_world_frame():
    context, _ = moving(5)
    adrift = replace(context, world_levelled=False)
    assert len(EFFECTS["field_gradient"].settings(context)) == 8
    assert EFFECTS["field_gradient"].settings(adrift) == ()
    assert all("onset_s" in s for s in EFFECTS["field_anomaly"].settings(adrift))


def test_effect_without_its_columns_has_no_settings_and_names_what_it_needs():
    context, readings = moving(6)
    bare = replace(context, track=replace(context.track, covariates={}, accel_b_m_s2=None))
    empty = replace(readings, covariates={}, accel_b_m_s2=np.full((600, 3), np.nan))
    for name, effect in EFFECTS.items():
        if effect.needs:
            assert effect.settings(bare) == (), name
            with pytest.raises(ValueError, match=f"^{name} needs "):
                effect.example(empty, 1.0)
        else:
            assert effect.example(empty, 1.0)[0].shape == (len(effect.parameters),)


def test_earth_rotation_is_fifteen_degrees_per_hour():
    _, readings = moving(8)
    effect = EFFECTS["earth_rotation"]
    value, setting = effect.example(readings, 1.0)
    added = effect.simulate(readings, value, setting).gyro_b_rad_s - readings.gyro_b_rad_s
    assert np.linalg.norm(added, axis=1) == pytest.approx(np.full(600, 7.292e-5), rel=5e-3)


def test_field_gradient_is_symmetric_and_traceless():
    """As of a field without sources: the matrix is read off three positions."""
    _, readings = moving(9, rows=3)
    places = {
        f"position_{name}_m": np.eye(3)[:, i] for i, name in enumerate(("north", "east", "down"))
    }
    at = replace(readings, covariates=places, R_nb=np.tile(np.eye(3), (3, 1, 1)))
    setting = {"reference_m": [0.0, 0.0, 0.0], "turn_deg": 0.0}
    value = np.array([1.0, -0.3, 0.2, 0.5, -0.7])
    made = EFFECTS["field_gradient"].simulate(at, value, setting)
    gradient = np.linalg.solve(SOFT_IRON, (made.mag_b_gauss - at.mag_b_gauss).T)
    assert gradient == pytest.approx(gradient.T)
    assert np.trace(gradient) == pytest.approx(0.0, abs=1e-12)
    assert np.diag(gradient)[:2] == pytest.approx(value[:2])


def test_object_next_to_the_path_is_located_within_15_cm():
    context, readings = moving(10, rows=1500)
    effect = EFFECTS["field_anomaly"]
    way = np.column_stack(
        [readings.covariates[f"position_{n}_m"] for n in ("north", "east", "down")]
    )
    truth = {"place_m": (way[700] + [0.4, 1.2, 1.5]).tolist(), "distance_m": 2.0}
    made = effect.simulate(readings, np.array([0.01, -0.012, 0.02]), truth)
    rng = np.random.default_rng(0)
    noisy = made.mag_b_gauss + 5e-4 * rng.standard_normal((1500, 3))
    places = [s["place_m"] for s in effect.settings(seen(context, noisy)) if "place_m" in s]
    away = np.linalg.norm(np.array(places) - truth["place_m"], axis=1)
    assert away.min() < 0.15


@pytest.mark.parametrize(
    ("frequency_hz", "found"),
    [(40 / 3, False), (40 / 6, False), (10.0, True), (7.3, True), (19.8, True), (20.0, False)],
)
def test_line_synchronous_with_the_samples_is_no_external_field(frequency_hz, found):
    """10 Hz is the alias of 50 Hz at a rate of 40 Hz."""
    time_s = np.arange(4000) / 40.0
    residual = np.random.default_rng(2).normal(size=(4000, 3))
    residual[:, 1] += 0.5 * np.cos(2 * np.pi * frequency_hz * time_s)
    dt_s = np.r_[np.nan, np.diff(time_s)]
    at = [line["frequency_hz"] for line in spectral_lines(residual, np.zeros((4000, 3)), dt_s)]
    assert len(at) == 2
    assert any(abs(one - frequency_hz) < 2e-3 for one in at) == found


@pytest.mark.parametrize(
    ("turns_hz", "line_hz", "found"),
    [(0.5, 0.5, False), (0.5, 0.53, False), (0.5, 1.3, True), (0.02, 0.5, True), (7.3, 7.3, True)],
)
def test_line_at_the_oscillation_rate_of_the_vehicle_is_no_external_field(turns_hz, line_hz, found):
    rng = np.random.default_rng(3)
    time_s = np.arange(4000) / 40.0
    gyro = 0.01 * rng.normal(size=(4000, 3))
    gyro[:, 0] += np.sin(2 * np.pi * turns_hz * time_s)
    gyro[:, 2] += np.cos(2 * np.pi * turns_hz * time_s)
    residual = rng.normal(size=(4000, 3))
    residual[:, 1] += 0.5 * np.cos(2 * np.pi * line_hz * time_s)
    dt_s = np.r_[np.nan, np.diff(time_s)]
    at = [line["frequency_hz"] for line in spectral_lines(residual, gyro, dt_s)]
    assert any(abs(one - line_hz) < 5e-3 for one in at) == found


def test_temperature_gain_applies_to_the_field_in_the_iron_the_reading_or_the_outside_field():
    context, readings = moving(3, rows=120)
    effect = EFFECTS["mag_scale_temperature"]
    forms = {setting["of"]: setting for setting in effect.settings(context)}
    seen = {
        "field": readings.field_b @ readings.soft_iron.T,
        "reading": readings.mag_b_gauss,
        "outside": readings.field_b,
    }
    assert set(forms) == set(seen)
    gain = np.array([1e-3, -2e-3, 5e-4])
    for of, setting in forms.items():
        warmer = readings.covariates[setting["covariate"]] - setting["reference"]
        made = effect.simulate(readings, gain, setting).mag_b_gauss - readings.mag_b_gauss
        assert made == pytest.approx(gain * warmer[:, None] * seen[of], abs=1e-12)
