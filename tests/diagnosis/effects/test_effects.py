"""Every effect: its columns are the derivative of its simulation, and its description is
complete.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effect_motion import moving
from hypothesis import given, settings
from hypothesis import strategies as st

from ahrsd import so3
from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.repaired_model.forward import terms_contribution

CONTRACT = Path(__file__).parents[3] / ".." / "shared" / "reference" / "contract.md"
MEAN = [name for name, effect in EFFECTS.items() if effect.kind == "mean"]


def difference(effect, readings, direction, setting, step):
    """Central difference of simulate() at zero: magnetometer and gyro, (N, 3) each."""
    ahead = effect.simulate(readings, step * direction, setting)
    behind = effect.simulate(readings, -step * direction, setting)
    return (
        (ahead.mag_b_gauss - behind.mag_b_gauss) / (2 * step),
        (ahead.gyro_b_rad_s - behind.gyro_b_rad_s) / (2 * step),
    )


@pytest.mark.parametrize("name", MEAN)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), gap=st.one_of(st.none(), st.integers(2, 118)))
def test_columns_are_the_derivative_of_the_simulation(name, seed, gap):
    effect = EFFECTS[name]
    context, readings = moving(seed, rows=120, gap_at=gap)
    scale = np.array([parameter.scale for parameter in effect.parameters])
    direction = scale * np.random.default_rng(seed).uniform(-1, 1, len(scale))
    choices = effect.settings(context) or (effect.example(readings, 1.0)[1],)
    for setting in choices:
        columns = effect.columns(context, setting)
        found = difference(effect, readings, direction, setting, 1e-4)
        for given_columns, measured in zip((columns.mag, columns.gyro), found, strict=True):
            expected = 0 * measured if given_columns is None else given_columns @ direction
            assert expected.shape == measured.shape
            size = np.abs(expected).max() + 1e-12
            assert np.abs(measured - expected).max() <= 1e-6 * size + 1e-9 * np.linalg.norm(scale)


@pytest.mark.parametrize("name", MEAN)
def test_every_effect_can_be_computed_when_all_columns_are_logged(name):
    context, readings = moving(3)
    effect = EFFECTS[name]
    value, setting = effect.example(readings, 1.0)
    assert value == pytest.approx(np.array(effect.typical))
    added = terms_contribution(
        context, [Term(name, np.asarray(value), np.zeros(len(value)), setting)]
    )
    assert max(np.abs(part).max() for part in added) > 1e-6
    for columns in (effect.columns(context, setting),):
        for part in (columns.mag, columns.gyro):
            assert part is None or part.shape == (600, 3, len(effect.parameters))


@pytest.mark.parametrize("name", list(EFFECTS))
def test_effect_of_zero_size_changes_nothing(name):
    _, readings = moving(4)
    effect = EFFECTS[name]
    value, setting = effect.example(readings, 0.0)
    made = effect.simulate(readings, value, setting)
    assert made.mag_b_gauss == pytest.approx(readings.mag_b_gauss, abs=1e-15)
    assert made.gyro_b_rad_s == pytest.approx(readings.gyro_b_rad_s, abs=1e-15)


@pytest.mark.parametrize("name", list(EFFECTS))
def test_description_is_complete_and_its_references_exist(name):
    effect = EFFECTS[name]
    for text in ("code", "words", "equation", "signature", "manoeuvre", "size", "source"):
        assert getattr(effect, text).strip()
    assert len(effect.typical) == len(effect.parameters)
    assert len({parameter.name for parameter in effect.parameters}) == len(effect.parameters)
    for parameter, typical in zip(effect.parameters, effect.typical, strict=True):
        assert 0 < parameter.scale < parameter.bound
        assert abs(typical) < parameter.bound
    for other, separation in effect.confusers:
        assert other in EFFECTS and other != name and separation
    for need in effect.needs:
        for role in need.split("|"):
            assert role in roles.ROLES or role in roles.SENSORS


def test_library_has_exactly_the_expected_identifiers():
    expected = {
        "hard_iron_step", "hard_iron_drift", "soft_iron_step", "motor_current_field",
        "current_derivative_field", "speed_field", "ac_interference", "sync_pulses",
        "mag_bias_temperature", "mag_scale_temperature", "mag_cross_axis", "mag_nonlinearity",
        "mag_saturation", "mag_quantisation", "hysteresis", "eddy_current",
        "viscous_magnetisation", "mag_time_lag", "mag_low_pass", "mag_sample_hold",
        "flexible_mount", "moving_iron", "switched_device", "rotor_field", "field_gradient",
        "field_anomaly", "geomagnetic_drift", "altitude_field", "field_step", "gyro_scale",
        "gyro_nonorthogonality", "mag_gyro_misalignment", "gyro_g_sensitivity",
        "vibration_rectification", "gyro_bias_temperature", "gyro_bias_drift", "gyro_bias_step",
        "gyro_nonlinearity", "gyro_saturation", "earth_rotation", "gyro_integration",
        "gyro_startup", "gyro_time_lag", "clock_rate", "timestamp_jitter", "dropped_samples",
        "stuck_magnetometer", "noise_burst", "noise_level", "frame_error", "unit_error",
        "onboard_calibration_active",
    }  # fmt: skip
    assert set(EFFECTS) == expected
    assert all(effect.identifier == name for name, effect in EFFECTS.items())


@pytest.mark.skipif(not CONTRACT.exists(), reason="the contract is not beside the project")
def test_contract_document_lists_the_same_effects():
    text = CONTRACT.read_text().split("Effect identifiers")[1].split("\n## ")[0]
    assert set(re.findall(r"`([a-z_]+)`", text)) == set(EFFECTS)


#: effects whose form depends on the sensor's axes
AXES = {
    "ac_interference", "hysteresis", "mag_cross_axis", "mag_nonlinearity", "mag_scale_temperature",
    "gyro_nonlinearity", "gyro_scale", "gyro_nonorthogonality",
}  # fmt: skip


def turned(readings, R):
    """The same recording from a sensor whose axes are rotated by R."""
    return replace(
        readings,
        mag_b_gauss=readings.mag_b_gauss @ R.T,
        gyro_b_rad_s=readings.gyro_b_rad_s @ R.T,
        accel_b_m_s2=readings.accel_b_m_s2 @ R.T,
        rate_b_rad_s=readings.rate_b_rad_s @ R.T,
        field_b=readings.field_b @ R.T,
        R_nb=readings.R_nb @ R.T,
        soft_iron=R @ readings.soft_iron @ R.T,
    )


@pytest.mark.parametrize("name", [name for name in MEAN if name not in AXES])
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_space_of_an_effect_does_not_depend_on_the_sensor_axes(name, seed):
    """The columns of the rotated recording span the rotated columns."""
    _, readings = moving(seed, rows=120)
    effect = EFFECTS[name]
    R = so3.exp(np.random.default_rng(seed).uniform(-2, 2, 3))
    other = turned(readings, R)
    setting = effect.example(readings, 1.0)[1]
    step = 1e-4
    scale = np.array([parameter.scale for parameter in effect.parameters])
    for side in (0, 1):
        spans = [
            np.stack(
                [
                    difference(effect, at, scale * unit, setting, step)[side].ravel()
                    for unit in np.eye(len(scale))
                ],
                axis=1,
            )
            for at in (readings, other)
        ]
        wanted = (spans[0].reshape(120, 3, -1).transpose(0, 2, 1) @ R.T).transpose(0, 2, 1)
        wanted = wanted.reshape(360, -1)
        if not np.any(wanted):
            assert not np.any(spans[1])
            continue
        found, *_ = np.linalg.lstsq(spans[1], wanted, rcond=1e-9)
        assert np.abs(spans[1] @ found - wanted).max() < 1e-6 * np.abs(wanted).max()


def test_effect_does_not_carry_over_a_gap():
    """The effect after a gap does not depend on what was before it."""
    _, readings = moving(7, rows=200, gap_at=100)
    rows = np.arange(200) >= 100
    alone = time_series.select_rows(readings, rows)
    for name in ("eddy_current", "viscous_magnetisation", "mag_time_lag", "mag_low_pass",
                 "gyro_time_lag", "gyro_integration", "current_derivative_field",
                 "mag_sample_hold"):  # fmt: skip
        effect = EFFECTS[name]
        value, setting = effect.example(readings, 1.0)
        whole = effect.simulate(readings, value, setting)
        part = effect.simulate(alone, value, setting)
        assert whole.mag_b_gauss[rows] == pytest.approx(part.mag_b_gauss, abs=1e-12), name
        assert whole.gyro_b_rad_s[rows] == pytest.approx(part.gyro_b_rad_s, abs=1e-12), name
