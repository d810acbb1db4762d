"""PX4 logs: the raw field is recovered, and missing topics are reported in one line."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
import ulog_files as ul
from ros_files import sensor

from ahrsd.config.config import Config
from ahrsd.errors import RecordingError
from ahrsd.offline.calibrate import calibrate
from ahrsd.recording.foreign import formats
from ahrsd.recording.foreign.sensors import Choice
from ahrsd.recording.opening import open_recording

pyulog = pytest.importorskip("pyulog", reason="pyulog (the extra px4) is not installed")

OFFSET = np.array([0.05, -0.03, 0.02])
S = np.array([[1.1, 0.05, -0.02], [0.05, 0.95, 0.03], [-0.02, 0.03, 1.02]])
GYRO = np.array([0.01, -0.02, 0.03])
CALIBRATED = {
    "CAL_MAG0_ID": 7, "CAL_MAG0_ROT": -1, "SENS_BOARD_ROT": 0,
    **{f"CAL_MAG0_{axis}OFF": float(v) for axis, v in zip("XYZ", OFFSET, strict=True)},
    "CAL_MAG0_XSCALE": 1.1, "CAL_MAG0_YSCALE": 0.95, "CAL_MAG0_ZSCALE": 1.02,
    "CAL_MAG0_XODIAG": 0.05, "CAL_MAG0_YODIAG": -0.02, "CAL_MAG0_ZODIAG": 0.03,
    "CAL_GYRO0_ID": 9, "CAL_GYRO0_ROT": -1,
    **{f"CAL_GYRO0_{axis}OFF": float(v) for axis, v in zip("XYZ", GYRO, strict=True)},
}  # fmt: skip


def data():
    fast = sensor(3000, 100.0)
    return fast, {name: values[::5] for name, values in fast.items()}


def corrected(raw):
    return (raw - OFFSET) @ S.T


def good(path, *more, parameters=CALIBRATED):
    fast, slow = data()
    return ul.save(
        path,
        [
            *ul.mags(slow["time_s"], corrected(slow["mag"])),
            *ul.combined(fast["time_s"], fast["gyro"] - GYRO, fast["accel"]),
            ("sensor_selection", 0, 0.0, (8, 9)),
            *more,
        ],
        parameters,
    )


def test_offset_and_scale_are_undone_and_the_gyro_is_averaged(tmp_path):
    fast, slow = data()
    recording = open_recording(good(tmp_path / "log.ulg"))
    rows = recording.table.rows
    np.testing.assert_allclose(rows.raw_b_gauss, slow["mag"][: len(rows)], atol=1e-6)
    middle = (fast["gyro"][1:] + fast["gyro"][:-1]) / 2
    wanted = middle[: 5 * (len(rows) - 1)].reshape(len(rows) - 1, 5, 3).mean(axis=1)
    np.testing.assert_allclose(rows.gyro_b_rad_s[1:], wanted, atol=1e-6)
    assert recording.facts["undone"].startswith("offset [0.05, -0.03, 0.02] gauss, S [[1.1, ")
    assert "gyro offset [10.0, -20.0, 30.0] mrad/s" in recording.facts["undone"]


def test_log_calibrates_as_a_table_of_the_same_values(tmp_path):
    import pyarrow
    import pyarrow.parquet

    path = good(tmp_path / "log.ulg")
    rows = open_recording(path).table.rows
    columns = {"time_s": rows.time_s}
    columns |= {f"mag_{a}_gauss": v for a, v in zip("xyz", rows.raw_b_gauss.T, strict=True)}
    columns |= {f"gyro_{a}_rad_s": v for a, v in zip("xyz", rows.gyro_b_rad_s.T, strict=True)}
    table = tmp_path / "own.parquet"
    pyarrow.parquet.write_table(pyarrow.table(columns), table)
    found, wanted = calibrate(path, Config()).estimate, calibrate(table, Config()).estimate
    np.testing.assert_allclose(found.hard_iron_gauss, wanted.hard_iron_gauss, rtol=0, atol=1e-6)


def test_log_written_by_the_library_is_read(tmp_path):
    path = good(tmp_path / "log.ulg")
    again = tmp_path / "again.ulg"
    pyulog.ULog(str(path)).write_ulog(str(again))
    np.testing.assert_array_equal(
        open_recording(again).table.rows.raw_b_gauss, open_recording(path).table.rows.raw_b_gauss
    )


def test_rotated_compass_keeps_its_calibration_with_a_note(tmp_path):
    _, slow = data()
    path = good(tmp_path / "log.ulg", parameters={**CALIBRATED, "CAL_MAG0_ROT": 6})
    recording = open_recording(path)
    rows = recording.table.rows
    np.testing.assert_allclose(rows.raw_b_gauss, corrected(slow["mag"])[: len(rows)], atol=1e-6)
    assert any("the compass is turned" in note for note in recording.notes)


def test_field_is_in_sensor_combined_before_version_1_9(tmp_path):
    fast, _ = data()
    rows = zip(fast["time_s"], fast["gyro"], fast["accel"], fast["mag"], strict=True)
    path = ul.save(
        tmp_path / "log.ulg",
        [
            ("sensor_combined", 0, t, (*g, 0, *a, 0 if k % 5 == 0 else 0x7FFFFFFF, *m))
            for k, (t, g, a, m) in enumerate(rows)
        ],
        formats=ul.OLD,
    )
    found = open_recording(path).table.rows.raw_b_gauss
    np.testing.assert_allclose(found, fast["mag"][::5][: len(found)], atol=1e-6)


def test_repeated_readings_are_left_out(tmp_path):
    fast, slow = data()
    held = np.repeat(slow["mag"], 5, axis=0)
    path = ul.save(
        tmp_path / "log.ulg",
        [*ul.mags(fast["time_s"], held), *ul.combined(fast["time_s"], fast["gyro"], fast["accel"])],
    )
    recording = open_recording(path)
    assert len(recording.table.rows) == 600
    assert any("2400 of 3000 magnetometer readings repeat" in note for note in recording.notes)


def utc_us(time_s):
    """Of the receiver, which does not know it yet in the first seconds."""
    return 1_769_644_800_000_000 + round(1e6 * time_s) if time_s > 3.0 else 0


def test_covariates_come_along(tmp_path):
    times = np.arange(0.0, 30.0, 0.5)
    more = [("battery_status", 0, t, (12.5, 2.0 * t)) for t in times]
    more += [("sensor_gps", 0, t, (60.0 + 1e-5 * t, 5.0, 10.0, 2.5, 3, utc_us(t))) for t in times]
    half = np.radians(20.0) / 2
    more += [("vehicle_attitude", 0, t, (np.cos(half), 0.0, 0.0, np.sin(half))) for t in times]
    recording = open_recording(good(tmp_path / "log.ulg", *more))
    assert recording.facts["recorded_utc"] == "2026-01-29T00:00:00.000+00:00"
    rows = recording.table.rows
    inside = rows.time_s < 29.0
    at = rows.time_s[inside]
    columns = {name: values[inside] for name, values in rows.covariates.items()}
    np.testing.assert_allclose(columns["motor_current_a"], 2.0 * at, atol=1e-4)
    np.testing.assert_allclose(columns["battery_v"], 12.5)
    np.testing.assert_allclose(columns["position_north_m"], 1.11195 * at, atol=1e-3)
    np.testing.assert_allclose(columns["gps_speed_m_s"], 2.5)
    np.testing.assert_allclose(columns["vn_yaw_deg"], 20.0, atol=1e-4)


# -- files that are wrong --------------------------------------------------------------------------


def cut(path):
    good(path)
    path.write_bytes(path.read_bytes()[:1200])


def only_magic(path):
    path.write_bytes(b"ULog\x01\x12\x35\x01")


def no_data(path):
    ul.save(path, [])


def no_magnetometer(path):
    fast, _ = data()
    ul.save(path, ul.combined(fast["time_s"], fast["gyro"], fast["accel"]))


def no_gyro(path):
    _, slow = data()
    ul.save(path, ul.mags(slow["time_s"], slow["mag"]))


def other_unit(path):
    fast, slow = data()
    field = ul.mags(slow["time_s"], 100.0 * slow["mag"])
    ul.save(path, [*field, *ul.combined(fast["time_s"], fast["gyro"], fast["accel"])])


def no_time(path):
    fast, slow = data()
    still = np.zeros(len(slow["time_s"]))
    ul.save(
        path,
        [*ul.mags(still, slow["mag"]), *ul.combined(fast["time_s"], fast["gyro"], fast["accel"])],
    )


def other_clock(path):
    fast, slow = data()
    late = ul.mags(slow["time_s"] + 1e4, slow["mag"])
    ul.save(path, [*late, *ul.combined(fast["time_s"], fast["gyro"], fast["accel"])])


def unknown_type(path):
    text = {"own_topic": "uint64_t timestamp;float value"}
    ul.save(path, [("own_topic", 0, t, (1.0,)) for t in np.arange(0, 30, 0.1)], formats=text)


def corrupt(path):
    good(path)
    content = bytearray(path.read_bytes())
    content[60:700] = b"\xa5" * 640
    path.write_bytes(content)


def packed(path):
    good(path)
    path.write_bytes(gzip.compress(path.read_bytes()))


WRONG = {
    cut: "holds no gyro (sensor_combined)",
    only_magic: "is a damaged PX4 log",
    no_data: "holds no gyro (sensor_combined), but no sensor at all",
    no_magnetometer: "holds no magnetometer",
    no_gyro: "holds no gyro (sensor_combined), but vehicle_magnetometer",
    other_unit: "it looks like uT",
    no_time: "has no time",
    other_clock: "hardly overlap",
    unknown_type: "holds no gyro (sensor_combined)",
    corrupt: "",
    packed: "packed with gzip",
}


@pytest.mark.parametrize("wrong", list(WRONG), ids=lambda one: one.__name__)
def test_bad_log_is_refused_in_one_line(tmp_path, capsys, wrong):
    path = tmp_path / "log.ulg"
    wrong(path)
    with pytest.raises(RecordingError) as refused:
        open_recording(path)
    assert WRONG[wrong] in str(refused.value)
    assert "\n" not in str(refused.value)
    assert refused.value.exit_code == 2
    assert capsys.readouterr() == ("", "")


def test_first_or_chosen_one_of_two_compasses_is_used(tmp_path):
    _, slow = data()
    path = good(tmp_path / "log.ulg", *ul.mags(slow["time_s"], 0.5 * slow["mag"], 77, number=1))
    assert any("holds 2 compasses: number 0" in note for note in open_recording(path).notes)
    rows = open_recording(path, choice=Choice(compass=1)).table.rows
    np.testing.assert_allclose(rows.raw_b_gauss, 0.5 * slow["mag"][: len(rows)], atol=1e-6)


def test_missing_library_is_named_in_one_line(tmp_path, monkeypatch):
    path = good(tmp_path / "log.ulg")
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(RecordingError, match=r"pip install 'ahrsd\[px4\]'"):
        open_recording(path)
