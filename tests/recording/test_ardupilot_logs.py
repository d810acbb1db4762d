"""DataFlash logs of ArduPilot: the raw field is recovered from the autopilot's corrections."""

from __future__ import annotations

import gzip

import dataflash_files as df
import numpy as np
import pytest
from ros_files import sensor

from ahrsd.errors import RecordingError
from ahrsd.recording.foreign.ardupilot import read_log
from ahrsd.recording.foreign.sensors import Choice
from ahrsd.recording.opening import open_recording

OFFSETS = np.array([-120.0, 75.0, -40.0])
D = np.array([[1.1, 0.05, -0.02], [0.05, 0.95, 0.03], [-0.02, 0.03, 1.02]])
CALIBRATED = {
    "COMPASS_DIA_X": 1.1, "COMPASS_DIA_Y": 0.95, "COMPASS_DIA_Z": 1.02,
    "COMPASS_ODI_X": 0.05, "COMPASS_ODI_Y": -0.02, "COMPASS_ODI_Z": 0.03,
}  # fmt: skip
HALF_STEP_MG = 0.8  # of whole mG in the log, undone through D


def log(tmp_path, parameters=None, firmware="", offsets=OFFSETS, motor=0.0, order="after",
        scale=1.0, matrix=D, more=()):  # fmt: skip
    """A log in which 10 Hz of compass stand among 100 Hz of gyro."""
    fast = sensor(6000, 100.0)
    slow = {name: values[::10] for name, values in fast.items()}
    raw = 1e3 * slow["mag"]
    if order == "after":
        field = scale * (raw + offsets) @ matrix.T + motor
    else:
        field = scale * (raw + offsets + motor) @ matrix.T
    text = df.message("MSG", 1, firmware.encode()) if firmware else b""
    path = df.save(
        tmp_path / "00000001.BIN",
        text + df.parameters(CALIBRATED if parameters is None else parameters),
        df.mags(slow["time_s"], field, offsets, motor),
        df.imus(fast["time_s"], fast["gyro"], fast["accel"]),
        *more,
    )
    return path, slow, fast


def raw_mg(path):
    return 1e3 * open_recording(path).table.rows.raw_b_gauss


def test_offsets_and_matrix_are_undone(tmp_path):
    path, slow, _ = log(tmp_path)
    recording = open_recording(path)
    np.testing.assert_allclose(
        1e3 * recording.table.rows.raw_b_gauss, 1e3 * slow["mag"], atol=HALF_STEP_MG
    )
    assert recording.facts["undone"].startswith("offsets [-120, 75, -40] mG (median), D [[1.1, ")
    assert "x forward, y to the right, z down" in recording.facts["frame"]


def test_scale_is_undone(tmp_path):
    path, slow, _ = log(tmp_path, {**CALIBRATED, "COMPASS_SCALE": 1.2}, scale=1.2)
    np.testing.assert_allclose(raw_mg(path), 1e3 * slow["mag"], atol=HALF_STEP_MG)


@pytest.mark.parametrize(
    ("firmware", "parameters", "order"),
    [
        ("ArduCopter V4.0.3 (ffd08628)", {}, "after"),
        ("ArduCopter V3.6.0", {}, "after"),
        ("", {"COMPASS_PMOT_EN": 0.0}, "after"),
        ("ArduCopter V3.4.6 (e707341b)", {}, "before"),
        ("ArduPlane V3.8.5", {}, "before"),
        ("ArduPlane V3.9.0", {"COMPASS_PMOT_EN": 0.0}, "after"),
    ],
)
def test_motor_compensation_is_undone_in_the_order_of_the_version(
    tmp_path, firmware, parameters, order
):
    motor = np.outer(40.0 + 30.0 * np.sin(np.arange(600) / 9.0), [1.0, -2.0, 3.0])
    path, slow, _ = log(tmp_path, {**CALIBRATED, **parameters}, firmware, motor=motor, order=order)
    np.testing.assert_allclose(raw_mg(path), 1e3 * slow["mag"], atol=2 * HALF_STEP_MG)
    words = {"after": "before D, as", "before": "after D, as in V3."}[order]
    assert any(words in note for note in open_recording(path).notes)


def test_unknown_order_of_corrections_is_reported(tmp_path):
    path, _, _ = log(tmp_path, motor=np.full((600, 3), 40.0))
    assert any("the order is a guess" in note for note in open_recording(path).notes)


def test_offsets_that_were_learned_in_flight_are_undone_row_by_row(tmp_path):
    offsets = OFFSETS + np.outer(np.linspace(0.0, 50.0, 600), [1.0, 1.0, -1.0])
    path, slow, _ = log(tmp_path, offsets=np.round(offsets))
    np.testing.assert_allclose(raw_mg(path), 1e3 * slow["mag"], atol=HALF_STEP_MG)
    assert any("moved by 50 mG in flight" in note for note in open_recording(path).notes)


def test_the_gyro_is_its_mean_over_the_steps_of_the_compass(tmp_path):
    parameters = {"INS_GYROFFS_X": 0.01, "INS_GYROFFS_Y": -0.02, "INS_GYROFFS_Z": 0.03}
    path, _, fast = log(tmp_path, {**CALIBRATED, **parameters})
    gyro = open_recording(path).table.rows.gyro_b_rad_s
    middle = (fast["gyro"][1:] + fast["gyro"][:-1]) / 2
    wanted = middle[: 599 * 10].reshape(599, 10, 3).mean(axis=1)
    np.testing.assert_allclose(gyro[1:] - [0.01, -0.02, 0.03], wanted, atol=1e-6)


def test_covariates_come_along(tmp_path):
    times = np.arange(0.0, 60.0, 0.5)
    more = [
        [(t, df.message("BAT", df.us(t), 0, 12.5, 0.5 * t)) for t in times],
        [(t, df.message("GPS", df.us(t), 0, 3, 345_618_000 + round(1000 * t), 2403 * (t > 5.0),
                        600000000 + round(100 * t), 50000000, 1000, 2.5)) for t in times],
        [(t, df.message("ATT", df.us(t), 100, -200, round(100 * ((350 + t) % 360))))
         for t in times],
    ]  # fmt: skip
    path, slow, _ = log(tmp_path, more=more)
    rows = open_recording(path).table.rows
    inside = rows.time_s < 59.0
    at = slow["time_s"][: len(rows)]
    np.testing.assert_allclose(
        rows.covariates["motor_current_a"][inside], 0.5 * at[inside], atol=1e-4
    )
    np.testing.assert_allclose(rows.covariates["battery_v"], 12.5, atol=1e-5)
    np.testing.assert_allclose(rows.covariates["gps_speed_m_s"], 2.5, atol=1e-5)
    np.testing.assert_allclose(
        rows.covariates["position_north_m"][inside], 1.11195 * at[inside], atol=0.02
    )
    yaw = (350.0 + at + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(rows.covariates["vn_yaw_deg"][inside], yaw[inside], atol=0.02)
    np.testing.assert_allclose(rows.covariates["temperature_c"], 31.5, atol=1e-4)
    # 2,403 weeks and four days behind 1980-01-06, and the 18 leap seconds that UTC is behind
    assert open_recording(path).facts["recorded_utc"] == "2026-01-29T00:00:00.000+00:00"


def test_bytes_outside_messages_are_counted(tmp_path):
    path, _, _ = log(tmp_path)
    data = path.read_bytes()
    middle = data.index(b"\xa3\x95\x03", len(data) // 2)
    path.write_bytes(data[:middle] + b"\x00" * 77 + data[middle:])
    assert read_log(path, {"MAG"}).damaged_bytes == 77
    assert any("77 bytes of the log" in note for note in open_recording(path).notes)


# -- files that are wrong --------------------------------------------------------------------------


def parts():
    fast = sensor(6000, 100.0)
    slow = {name: values[::10] for name, values in fast.items()}
    return (
        df.mags(slow["time_s"], 1e3 * slow["mag"] + OFFSETS, OFFSETS, 0.0),
        df.imus(fast["time_s"], fast["gyro"], fast["accel"]),
        slow,
    )


def only_formats(path):
    path.write_bytes(df.formats())


def no_magnetometer(path):
    df.save(path, parts()[1])


def no_gyro(path):
    df.save(path, parts()[0])


def cut(path):
    mag, imu, _ = parts()
    df.save(path, mag, imu)
    path.write_bytes(path.read_bytes()[:2500])


def other_unit(path):
    slow = parts()[2]
    df.save(path, df.mags(slow["time_s"], 5e4 * slow["mag"], 0.0, 0.0), parts()[1])


def no_time(path):
    mag, imu, _ = parts()
    df.save(path, [(0.0, data[:3] + b"\0" * 8 + data[11:]) for _, data in mag], imu)


def unknown_type(path):
    df.save(path, [(t, df.message("MOD", df.us(t), 3)) for t in np.arange(0, 30, 0.1)])


def corrupt(path):
    mag, imu, _ = parts()
    df.save(path, mag, imu)
    data = bytearray(path.read_bytes())
    head = len(df.formats())
    data[89:head] = b"\xa5" * (head - 89)
    path.write_bytes(data)


def matrix(path):
    mag, imu, _ = parts()
    wrong = {f"COMPASS_DIA_{axis}": 1.0 for axis in "XYZ"}
    wrong |= {f"COMPASS_ODI_{axis}": 1.0 for axis in "XYZ"}
    df.save(path, df.parameters(wrong), mag, imu)


def packed(path):
    df.save(path, *parts()[:2])
    path.write_bytes(gzip.compress(path.read_bytes()))


WRONG = {
    only_formats: "without a measurement",
    no_magnetometer: "holds no magnetometer (MAG)",
    no_gyro: "holds no gyro (IMU)",
    cut: "readings, 20 are needed",
    other_unit: "the median field is",
    no_time: "has no time",
    unknown_type: "holds no magnetometer (MAG)",
    corrupt: "without a measurement",
    matrix: "are no calibration",
    packed: "packed with gzip",
}


@pytest.mark.parametrize("wrong", list(WRONG), ids=lambda one: one.__name__)
def test_bad_log_is_refused_in_one_line(tmp_path, wrong):
    path = tmp_path / "log.bin"
    wrong(path)
    with pytest.raises(RecordingError) as refused:
        open_recording(path)
    assert WRONG[wrong] in str(refused.value)
    assert "\n" not in str(refused.value)
    assert refused.value.exit_code == 2


def test_first_or_chosen_one_of_two_compasses_is_used(tmp_path):
    slow = parts()[2]
    second = df.mags(slow["time_s"] + 0.001, 500.0 * slow["mag"], 0.0, 0.0, number=1)
    path = df.save(tmp_path / "log.bin", *parts()[:2], second)
    recording = open_recording(path)
    np.testing.assert_allclose(
        1e3 * recording.table.rows.raw_b_gauss, 1e3 * slow["mag"], atol=HALF_STEP_MG
    )
    assert any("holds 2 compasses: number 0 is used" in note for note in recording.notes)
    rows = open_recording(path, choice=Choice(compass=1)).table.rows
    wanted = 500.0 * slow["mag"][: len(rows)]
    np.testing.assert_allclose(1e3 * rows.raw_b_gauss, wanted, atol=HALF_STEP_MG)
    with pytest.raises(RecordingError, match="holds no compass 7; it has --compass 0, 1"):
        open_recording(path, choice=Choice(compass=7))
    with pytest.raises(RecordingError, match="--topic is not for it"):
        open_recording(path, choice=Choice(topics=("/mag",)))


def two_imus(tmp_path, first, second, parameters=None):
    data = sensor(1200, 40.0)
    path = df.save(
        tmp_path / "a.bin",
        df.parameters(parameters or {}),
        df.mags(data["time_s"], 1e3 * data["mag"], (0, 0, 0), (0, 0, 0)),
        df.imus(data["time_s"], first * data["gyro"], data["accel"], 0),
        df.imus(data["time_s"], second * data["gyro"], data["accel"], 1),
    )
    return open_recording(path), data


def test_constant_one_of_two_gyros_is_not_used(tmp_path):
    offsets = {"INS_GYROFFS_X": 0.5, "INS_GYR2OFFS_X": 0.01}
    recording, data = two_imus(tmp_path, 1e-3, 1.0, offsets)
    undone = data["gyro"] + [0.01, 0.0, 0.0]
    np.testing.assert_allclose(recording.table.rows.gyro_b_rad_s, undone, atol=1e-6)
    assert recording.facts["gyro source"] == "IMU[1]"
    assert any("the gyro of IMU 0 hardly turns" in note for note in recording.notes)


def test_first_of_two_working_gyros_is_used(tmp_path):
    recording, data = two_imus(tmp_path, 1.0, 1.02)
    np.testing.assert_allclose(recording.table.rows.gyro_b_rad_s, data["gyro"], atol=1e-6)
    assert not any("hardly turns" in note for note in recording.notes)


def test_dead_compass_is_skipped_with_a_note(tmp_path):
    data = sensor(600, 20.0)
    field, none = 1e3 * data["mag"], np.zeros((600, 3))
    recording = open_recording(
        df.save(
            tmp_path / "a.bin",
            df.mags(data["time_s"], none, (0, 0, 0), (0, 0, 0), 0),
            df.mags(data["time_s"], field, (0, 0, 0), (0, 0, 0), 1),
            df.imus(data["time_s"], data["gyro"], data["accel"]),
        )
    )
    np.testing.assert_allclose(1e3 * recording.table.rows.raw_b_gauss, field, atol=HALF_STEP_MG)
    assert "dead, one reading throughout: compass 0" in recording.notes
