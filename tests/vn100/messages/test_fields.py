"""The columns: names that the pipeline looks up, with their frames and units."""

from __future__ import annotations

import math

import pytest

from drivers.vn100.messages import GROUPS, MESSAGES, Column, sentence_layout

ALL = {
    column.name: column
    for columns in [
        *(row.columns for group in GROUPS.values() for row in group.values()),
        *(row.columns for row in MESSAGES.values()),
    ]
    for column in columns
}


@pytest.mark.parametrize(
    ("name", "unit", "frame", "compensation"),
    [
        ("time_startup_s", "s", "", ""),
        ("time_sync_in_s", "s", "", ""),
        ("yaw_rad", "rad", "", ""),
        ("quat_w", "", "", ""),
        ("dcm_21", "", "", ""),
        ("mag_x_gauss", "gauss", "b", "compensated"),
        ("uncomp_mag_z_gauss", "gauss", "b", "uncompensated"),
        ("accel_y_m_s2", "m/s^2", "b", "compensated"),
        ("uncomp_accel_y_m_s2", "m/s^2", "b", "uncompensated"),
        ("gyro_x_rad_s", "rad/s", "b", "compensated"),
        ("uncomp_gyro_x_rad_s", "rad/s", "b", "uncompensated"),
        ("mag_n_e_gauss", "gauss", "n", "compensated"),
        ("accel_n_d_m_s2", "m/s^2", "n", "compensated"),
        ("linear_accel_b_x_m_s2", "m/s^2", "b", "compensated"),
        ("linear_accel_n_n_m_s2", "m/s^2", "n", "compensated"),
        ("delta_time_s", "s", "", ""),
        ("delta_theta_x_rad", "rad", "b", ""),
        ("delta_velocity_z_m_s", "m/s", "b", ""),
        ("temperature_c", "degC", "", ""),
        ("pressure_kpa", "kPa", "", ""),
        ("sens_sat", "", "", ""),
        ("vpe_status", "", "", ""),
        ("imu_status", "", "", ""),
        ("sync_in_count", "", "", ""),
        ("sync_out_count", "", "", ""),
    ],
)
def test_columns_have_names_units_and_frames(
    name: str, unit: str, frame: str, compensation: str
) -> None:
    column = ALL[name]
    assert (column.unit, column.frame, column.compensation) == (unit, frame, compensation)


def test_only_angles_and_times_are_scaled() -> None:
    scales = {name: column.per_si for name, column in ALL.items() if column.per_si != 1}
    angles = [name for name in scales if name.endswith("_rad")]
    assert {scales[name] for name in angles} == {180 / math.pi}
    assert sorted(set(scales) - set(angles)) == ["time_startup_s", "time_sync_in_s"]
    assert {scales[name] for name in scales if name.startswith("time")} == {1e9}
    assert sorted(name for name in ALL if name.endswith("_rad")) == sorted(angles)


def test_each_name_is_one_column() -> None:
    seen: dict[str, Column] = {}
    for group in GROUPS.values():
        for row in group.values():
            for column in row.columns:
                assert seen.setdefault(column.name, column) is column


def test_index_finds_columns_by_name() -> None:
    layout = sentence_layout("VNYMR")
    assert layout.index("mag_x_gauss") == 3
    assert layout.columns[layout.index("gyro_z_rad_s") or 0].name == "gyro_z_rad_s"
    assert layout.index("uncomp_mag_x_gauss") is None
