"""Roles of columns by name and unit. A column that cannot be used is refused with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.track import Track

RAMP = np.linspace(1.0, 5.0, 200)
BITS = (np.arange(200) % 40 < 20).astype(float)
PULSES = (np.arange(200) % 40 < 1).astype(float)


def track(rows=200, **columns):
    time_s = np.arange(rows) / 10.0
    dt_s = np.concatenate([[np.nan], np.diff(time_s)])
    zero = np.zeros((rows, 3))
    return Track(time_s, dt_s, zero, zero, None, columns, (slice(0, rows),))


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("motor_current_a", "current"),
        ("thruster_2_a", "current"),
        ("temperature_c", "temperature"),
        ("imu_temp_c", "temperature"),
        ("rudder_angle_rad", "angle"),
        ("joint_3_rad", "angle"),
        ("pan_deg", "angle"),
        ("position_down_m", "position"),
        ("speed_m_s", "speed"),
        ("motor_1_rpm", "rpm"),
        ("altitude_m", "altitude"),
        ("depth_m", "altitude"),
        ("pressure_kpa", "pressure"),
        ("throttle", "throttle"),
        ("battery_v", "voltage"),
        ("latitude_deg", "latitude"),
        ("vn_yaw_deg", None),
        ("ref_qw", None),
        ("movement", None),
        ("hdop", None),
    ],
)
def test_role_follows_from_the_name(name, role):
    assert roles.role_of(name, RAMP) == role


def test_columns_of_two_values_are_switches_or_pings():
    assert roles.role_of("x1", BITS) == "switch"
    assert roles.role_of("x1", PULSES) == "ping"
    assert roles.role_of("x1", 0 * BITS) is None
    other = BITS.copy()
    other[len(other) // 8 + 1] = 2.0  # one value among the many of a switch
    assert roles.role_of("x1", other) is None
    assert roles.role_of("sonar_ping", BITS) == "ping"
    assert roles.role_of("lamp", BITS) == "switch"


def test_reference_is_zero_or_the_mean():
    assert roles.zero_reference("current", RAMP) == 0.0
    assert roles.zero_reference("temperature", RAMP) == pytest.approx(3.0)


def test_usable_columns_are_listed_in_order():
    columns = {"b_a": RAMP, "a_a": RAMP, "temperature_c": 0 * RAMP, "x_a": RAMP * np.nan}
    assert roles.usable_columns(columns, "current") == ("b_a", "a_a")
    assert roles.usable_columns(columns, "temperature") == ()


def test_short_gaps_are_filled():
    holed = RAMP.copy()
    holed[50:65] = np.nan
    found, notes = roles.prepare_columns(track(motor_current_a=holed))
    assert notes == ()
    assert found.covariates["motor_current_a"] == pytest.approx(RAMP)


def test_sparse_column_is_interpolated_and_sparse_switch_holds_its_value():
    slow, bits = np.full(200, np.nan), np.full(200, np.nan)
    slow[::10], bits[::10] = RAMP[::10], BITS[::10]
    found, notes = roles.prepare_columns(track(temperature_c=slow, lamp_on=bits))
    assert notes == ()
    assert found.covariates["temperature_c"][:191] == pytest.approx(RAMP[:191])
    assert set(np.unique(found.covariates["lamp_on"])) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("motor_current_a", np.where(np.arange(200) < 80, RAMP, np.nan), "no values from 7.9 to"),
        ("motor_current_a", np.full(200, np.nan), "it has 0 values in 200 rows"),
        ("motor_current_a", np.where(np.arange(200) < 3, RAMP, np.nan), "it has 3 values in 200"),
        ("motor_current_a", RAMP * 0 + 3, "it is 3 throughout, so it can explain nothing"),
        ("motor_current_a", RAMP * 1000, "it looks like milliampere"),
        ("temperature_c", RAMP + 295, "it looks like kelvin"),
        ("rudder_angle_rad", RAMP * 40, "looks like degrees"),
        ("lamp_on", RAMP, "it looks like values other than 0 and 1"),
    ],
)
def test_unusable_column_is_left_out_with_a_reason(name, values, message):
    found, (note,) = roles.prepare_columns(track(**{name: values, "depth_m": RAMP}))
    assert message in note
    assert note.startswith(f"column {name} was left out: ")
    assert list(found.covariates) == ["depth_m"]


def test_gap_of_the_samples_is_not_counted_as_a_gap_of_the_column():
    base = track(motor_current_a=RAMP)
    time_s = base.time_s + np.where(np.arange(200) >= 100, 30.0, 0.0)
    values = RAMP.copy()
    values[20] = np.nan
    moved = Track(time_s, base.dt_s, base.mag_b_gauss, base.gyro_b_rad_s, None, {"x_a": values})
    found, notes = roles.prepare_columns(moved)
    assert notes == ()
    assert found.covariates["x_a"] == pytest.approx(RAMP)


def test_gap_of_a_column_counts_despite_a_longer_pause_of_the_samples():
    base = track(motor_current_a=RAMP)
    time_s = base.time_s + np.where(np.arange(200) >= 100, 30.0, 0.0)
    values = RAMP.copy()
    values[20:75] = np.nan
    moved = Track(time_s, base.dt_s, base.mag_b_gauss, base.gyro_b_rad_s, None, {"x_a": values})
    found, (note,) = roles.prepare_columns(moved)
    assert "no values from 1.9 to 7.5 s" in note
    assert found.covariates == {}


def test_columns_without_a_role_are_kept():
    found, notes = roles.prepare_columns(track(hdop=RAMP))
    assert list(found.covariates) == ["hdop"]
    assert notes == ()


def test_reference_attitude_is_not_used_as_a_cause() -> None:
    """A reference attitude must not change the diagnosis of the sensor."""
    found, notes = roles.prepare_columns(track(ref_qw=RAMP, ref_qz=RAMP, hdop=RAMP))
    assert list(found.covariates) == ["hdop"]
    assert notes == ()


def test_quantities_computed_by_the_sensor_are_not_used_as_causes():
    own = {"vn_yaw_deg": RAMP, "dcm_01": RAMP, "mag_n_d_gauss": RAMP, "pitch_rad": RAMP}
    own |= {"yaw": RAMP, "roll_rate_rad_s": RAMP, "yaw_angle_deg": RAMP}
    found, notes = roles.prepare_columns(track(**own, linkage_m=RAMP))
    assert list(found.covariates) == ["linkage_m"]
    assert notes == ()


@pytest.mark.parametrize("name", ["yaw_motor_current_a", "pitch_servo_a", "gyro_temperature_c"])
def test_columns_named_after_an_axis_or_a_sensor_are_kept(name):
    found, notes = roles.prepare_columns(track(**{name: RAMP}))
    assert list(found.covariates) == [name]
    assert notes == ()


@pytest.mark.slow
@given(
    st.text(max_size=12),
    st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=5, max_size=5),
)
def test_all_kept_columns_are_finite(name, values):
    found, notes = roles.prepare_columns(track(5, **{f"x{name}": np.array(values)}))
    assert all(np.isfinite(column).all() for column in found.covariates.values())
    if not np.isfinite(values).all() and np.isfinite(values).any():
        assert len(found.covariates) + len(notes) == 1
