"""ROS 1 bags and ROS 2 recordings: the same samples as a table of them, or one line."""

from __future__ import annotations

import gzip
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import ros_files
from click.testing import CliRunner
from ros_files import BIAS, HARD, SUFFIXES, imu, magnetic, ns_of, sensor

from ahrsd.cli import LazyGroup
from ahrsd.config.config import Config
from ahrsd.errors import RecordingError
from ahrsd.offline.calibrate import calibrate
from ahrsd.recording.column_names import parse_columns
from ahrsd.recording.foreign import formats
from ahrsd.recording.foreign.ros import DEFINITIONS
from ahrsd.recording.foreign.sensors import Choice
from ahrsd.recording.opening import open_recording
from ahrsd.recording.table import read_table

pytest.importorskip("rosbags", reason="rosbags (the extra ros) is not installed")

PROJECT = Path(__file__).parents[2]
CASES = PROJECT.parent / "shared" / "field-cases"
VECTORNAV = {f"vectornav_msgs/msg/{name}": text for name, text in DEFINITIONS.items()}
STRING = {"std_msgs/msg/String": "string data\n"}


def ahrsd(*arguments: object):
    return CliRunner().invoke(LazyGroup("ahrsd"), [str(one) for one in arguments])


@pytest.fixture(params=list(SUFFIXES))
def container(request) -> str:
    return request.param


def test_imu_and_magnetic_field_are_one_table(tmp_path, container):
    data = sensor()
    path = ros_files.save(tmp_path, container, [*imu(data), *magnetic(data)])
    rows = open_recording(path).table.rows
    np.testing.assert_allclose(rows.time_s, data["time_s"], atol=2e-9)
    np.testing.assert_allclose(rows.raw_b_gauss, data["mag"], rtol=1e-12)
    np.testing.assert_allclose(rows.gyro_b_rad_s, data["gyro"], rtol=1e-12)
    np.testing.assert_allclose(rows.accel_b_m_s2, data["accel"], atol=1e-12)


def test_it_calibrates_to_the_truth(tmp_path):
    data = sensor(1200)
    path = ros_files.save(tmp_path, "mcap", [*imu(data), *magnetic(data)])
    estimate = calibrate(path, Config()).estimate
    np.testing.assert_allclose(estimate.hard_iron_gauss, HARD, atol=1e-3)
    np.testing.assert_allclose(estimate.gyro_bias_rad_s, BIAS, atol=3e-4)


def test_headers_of_a_clock_that_was_set_back_are_refused(tmp_path):
    data = sensor()
    messages = [
        (topic, kind, ns, fields | {"stamp_ns": ns - (10_007_000_000 if ns > ns_of(15.0) else 0)})
        for topic, kind, ns, fields in [*imu(data), *magnetic(data)]
    ]
    path = ros_files.save(tmp_path, "mcap", messages)
    with pytest.raises(RecordingError, match=r"time goes back by 9.957 s after 301 readings"):
        open_recording(path)


def test_format_is_recognised_by_content(tmp_path, container):
    data = sensor()
    path = ros_files.save(tmp_path, container, [*imu(data), *magnetic(data)])
    other = path.rename(tmp_path / "log.txt")
    assert len(open_recording(other).table.rows) == 600


def test_a_folder_of_ros_2_is_opened(tmp_path):
    data = sensor()
    path = ros_files.save(tmp_path, "mcap", [*imu(data), *magnetic(data)])
    assert len(open_recording(path.parent).table.rows) == 600


def test_a_faster_gyro_is_averaged_over_the_steps_of_the_magnetometer(tmp_path):
    fast = sensor(6000, 200.0)
    slow = {name: values[::20] for name, values in fast.items()}
    path = ros_files.save(tmp_path, "mcap", [*imu(fast), *magnetic(slow)])
    recording = open_recording(path)
    gyro = recording.table.rows.gyro_b_rad_s
    trapezoid = (fast["gyro"][1:] + fast["gyro"][:-1]) / 2
    wanted = trapezoid[: 299 * 20].reshape(299, 20, 3).mean(axis=1)
    np.testing.assert_allclose(gyro[1:], wanted, atol=1e-9)
    assert any("means over its steps" in note for note in recording.notes)


def test_uncompensated_values_of_vectornav_msgs_come_first(tmp_path, container):
    if container == "bag":
        pytest.skip("vectornav_msgs are of ROS 2")
    data = sensor()
    common = [
        ("/vectornav/raw/common", "vectornav_msgs/msg/CommonGroup", ns_of(t) + k % 3 * 4_000_000, {
            "group_fields": 1 | 1 << 9 | 1 << 10, "timestartup": int(t * 1e9) + 5 * 10**9,
            "imu_rate": g, "imu_accel": a, "magpres_mag": m, "magpres_temp": 21.5})
        for k, (t, g, a, m) in enumerate(zip(*data_of(data), strict=True))
    ]  # fmt: skip
    turned = {**data, "gyro": data["gyro"] + 1.0, "mag": data["mag"] * 2}
    path = ros_files.save(
        tmp_path, container, [*common, *imu(turned), *magnetic(turned)], definitions=VECTORNAV
    )
    rows = open_recording(path).table.rows
    np.testing.assert_allclose(rows.time_s, data["time_s"], atol=2e-9)  # of the device
    np.testing.assert_allclose(rows.raw_b_gauss, data["mag"], rtol=1e-12)
    np.testing.assert_allclose(rows.gyro_b_rad_s, data["gyro"], rtol=1e-12)
    np.testing.assert_allclose(rows.covariates["temperature_c"], 21.5)


def data_of(data):
    return data["time_s"], data["gyro"], data["accel"], data["mag"]


def test_covariates_have_their_documented_names(tmp_path):
    data = sensor()
    more = []
    for k, t in enumerate(np.arange(0.0, 30.0, 0.5)):
        more += [
            ("/battery", "sensor_msgs/msg/BatteryState", ns_of(t),
             {"current": -0.1 * k, "voltage": 12.0}),
            ("/fix", "sensor_msgs/msg/NavSatFix", ns_of(t),
             {"latitude": 60.0 + 1e-5 * k, "longitude": 5.0, "altitude": 10.0 + k}),
            ("/temp", "sensor_msgs/msg/Temperature", ns_of(t), {"temperature": 20.0 + k}),
        ]  # fmt: skip
    path = ros_files.save(tmp_path, "bag", [*imu(data), *magnetic(data), *more])
    columns = open_recording(path).table.rows.covariates
    at = np.minimum(data["time_s"] / 0.5, 59.0)
    np.testing.assert_allclose(columns["motor_current_a"], 0.1 * at, atol=1e-5)
    np.testing.assert_allclose(columns["temperature_c"], 20.0 + at, atol=1e-5)
    np.testing.assert_allclose(columns["position_north_m"], 1.11195 * at, atol=1e-2)
    np.testing.assert_allclose(columns["position_down_m"], -at, atol=1e-5)
    np.testing.assert_allclose(columns["position_east_m"], 0.0, atol=1e-6)


@pytest.mark.parametrize("unit", ["G", "mT", "uT", "mG"])
def test_field_not_in_tesla_is_reported_and_read_with_the_option(tmp_path, unit):
    data = sensor()
    factor = {"G": 1.0, "mT": 0.1, "uT": 100.0, "mG": 1000.0}[unit]
    path = ros_files.save(tmp_path, "mcap", [*imu(data), *magnetic(data, factor=factor)])
    with pytest.raises(RecordingError, match="it looks like") as refused:
        open_recording(path)
    option = str(refused.value).split("--columns ")[1]
    assert option.endswith(f":{'gauss' if unit == 'G' else unit}")
    rows = open_recording(path, columns=parse_columns([option])).table.rows
    np.testing.assert_allclose(rows.raw_b_gauss, data["mag"], rtol=1e-9)


def test_an_axis_is_turned_by_the_option(tmp_path):
    data = sensor()
    path = ros_files.save(tmp_path, "mcap", [*imu(data), *magnetic(data)])
    given = parse_columns(["mag_x=mag_y:T,mag_y=-mag_x:T"])
    rows = open_recording(path, columns=given).table.rows
    wanted = np.column_stack([data["mag"][:, 1], -data["mag"][:, 0], data["mag"][:, 2]])
    np.testing.assert_allclose(rows.raw_b_gauss, wanted, rtol=1e-12)


@pytest.mark.parametrize(
    ("container", "kind"),
    [
        ("bag", "text"),
        ("mcap", "bytes"),
        pytest.param("db3", "text", marks=pytest.mark.slow),
        pytest.param("bag", "bytes", marks=pytest.mark.slow),
        pytest.param("db3", "bytes", marks=pytest.mark.slow),
        pytest.param("mcap", "text", marks=pytest.mark.slow),
    ],
)
def test_recorded_device_bytes_calibrate_as_their_byte_stream(tmp_path, container, kind):
    stream = stream_of(kind)
    own = tmp_path / ("own.vnraw" if kind == "text" else "own.vnbin")
    own.write_bytes(b"".join(stream))
    if kind == "text":
        name, fields = "std_msgs/msg/String", [{"data": one.decode()} for one in stream]
    else:
        name = "std_msgs/msg/UInt8MultiArray"
        fields = [{"data": np.frombuffer(one, np.uint8)} for one in stream]
    messages = [("/raw", name, ns_of(k / 40.0), value) for k, value in enumerate(fields)]
    path = ros_files.save(tmp_path, container, messages)
    wanted = calibrate(own, Config(), rate_hz=40.0).estimate
    result = calibrate(path, Config())
    np.testing.assert_allclose(
        result.estimate.hard_iron_gauss, wanted.hard_iron_gauss, atol=1e-6, rtol=0
    )
    assert any("what the device sent" in text for text in result.all_warnings())


@pytest.mark.slow  # simulated ones: the test above
def test_a_real_stream_in_a_bag_calibrates_as_the_stream(recordings, tmp_path):
    packed = recordings / "vn100" / "punch_2024_satish.vnraw.gz"
    lines = gzip.decompress(packed.read_bytes()).splitlines(keepends=True)
    messages = [
        ("/raw", "std_msgs/msg/String", ns_of(k / 40.0), {"data": line.decode("latin-1")})
        for k, line in enumerate(lines)
    ]
    path = ros_files.save(tmp_path, "bag", messages)
    wanted = calibrate(packed, Config(), rate_hz=40.0).estimate.hard_iron_gauss
    found = calibrate(path, Config()).estimate.hard_iron_gauss
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)


def stream_of(kind: str) -> list[bytes]:
    """Bytes of a VN-100, message by message or in pieces."""
    name = {"text": "clean_tumble_vnymr.vnraw.gz", "bytes": "clean_tumble_binary.vnraw.gz"}[kind]
    data = gzip.decompress((PROJECT / "fixtures" / "replays" / name).read_bytes())
    if kind == "text":
        return data.splitlines(keepends=True)
    return [data[at : at + 100] for at in range(0, len(data), 100)]


# -- files that are wrong --------------------------------------------------------------------------


def good(tmp_path: Path, container: str, *more) -> Path:
    data = sensor()
    return ros_files.save(tmp_path, container, [*imu(data), *magnetic(data), *more])


def cut(tmp_path, container):
    path = good(tmp_path, container)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def empty(tmp_path, container):
    return ros_files.save(tmp_path, container, [])


def no_magnetometer(tmp_path, container):
    return ros_files.save(tmp_path, container, imu(sensor()))


def no_gyro(tmp_path, container):
    return ros_files.save(tmp_path, container, magnetic(sensor()))


def other_unit(tmp_path, container):
    data = sensor()
    return ros_files.save(tmp_path, container, [*imu(data), *magnetic(data, factor=1.0)])


def degrees(tmp_path, container):
    data = sensor()
    data["gyro"] = np.degrees(data["gyro"])
    return ros_files.save(tmp_path, container, [*imu(data), *magnetic(data)])


def two_sensors(tmp_path, container):
    return good(tmp_path, container, *magnetic(sensor(seed=2), "/other/mag"))


def no_time(tmp_path, container):
    data = sensor()
    messages = [(t, k, 0, {**f, "stamp_ns": 0}) for t, k, _, f in [*imu(data), *magnetic(data)]]
    return ros_files.save(tmp_path, container, messages)


def other_clocks(tmp_path, container):
    data = sensor()
    late = [(t, k, ns + 10**15, f) for t, k, ns, f in magnetic(data)]
    return ros_files.save(tmp_path, container, [*imu(data), *late])


def unknown_type(tmp_path, container):
    text = "std_msgs/Header header\nfloat64 reading\n"
    kind = "driver_msgs/msg/Reading"
    messages = [("/reading", kind, ns_of(t), {"reading": 1.0}) for t in np.arange(0, 30, 0.05)]
    return ros_files.save(tmp_path, container, messages, definitions={kind: text})


def corrupt(tmp_path, container):
    path = good(tmp_path, container)
    data = bytearray(path.read_bytes())
    if container == "db3":
        data[4096:] = b"\xa5" * (len(data) - 4096)
    else:
        data[-400:-40] = b"\xa5" * 360
    path.write_bytes(data)
    return path


def packed(tmp_path, container):
    path = good(tmp_path, container)
    out = tmp_path / f"{path.name}.gz"
    out.write_bytes(gzip.compress(path.read_bytes()))
    return out


def too_short(tmp_path, container):
    data = sensor(12)
    return ros_files.save(tmp_path, container, [*imu(data), *magnetic(data)])


WRONG = {
    cut: "is damaged, cut off or was never closed",
    empty: "holds no magnetometer and no gyro",
    no_magnetometer: "holds no magnetometer, it has the topics /imu/data",
    no_gyro: "holds no gyro, it has the topics /imu/mag",
    other_unit: "it looks like gauss",
    degrees: "it looks like deg/s",
    two_sensors: "holds 2 magnetometers: /imu/mag, /other/mag; choose one: ahrsd convert",
    no_time: "has no time",
    other_clocks: "hardly overlap; their clocks differ",
    unknown_type: "holds no magnetometer and no gyro, it has the topics /reading",
    corrupt: "is damaged, cut off or was never closed",
    packed: "packed with gzip",
    too_short: "has 12 readings, 20 are needed",
}


@pytest.mark.parametrize("wrong", list(WRONG), ids=lambda one: one.__name__)
def test_bad_recording_is_refused_in_one_line(tmp_path, container, wrong):
    path = wrong(tmp_path, container)
    words = WRONG[wrong]
    with pytest.raises(RecordingError) as refused:
        open_recording(path)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
    assert refused.value.exit_code == 2


LAB = {
    "lab/msg/Place": "string room\nfloat64[2] shelf\n",
    "lab/msg/Reading": (
        "std_msgs/Header header\nlab/Place place\nlab/Place[] seen\nsensor_msgs/Imu imu\n"
        "sensor_msgs/MagneticField mag_field\nstring raw\n"
    ),
}


def reading_without_definitions(folder: Path, raw: list[str]) -> Path:
    """A recording in SQLite as ROS 2 before Iron makes it, of messages of a lab's own."""
    data = sensor(len(raw))
    messages = [
        ("/lab", "lab/msg/Reading", ns_of(t), {
            "imu": {"angular_velocity": w, "linear_acceleration": a},
            "mag_field": {"magnetic_field": 1e-4 * m}, "raw": text})
        for t, w, a, m, text in zip(*data_of(data), raw, strict=True)
    ]  # fmt: skip
    path = ros_files.save(folder, "db3", messages, definitions=LAB)
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    return path


@pytest.mark.parametrize("end", ["", "\n", "\r\n"])
def test_device_lines_are_found_in_messages_without_a_definition(tmp_path, end):
    sent = [one.decode().rstrip() for one in stream_of("text")]
    path = reading_without_definitions(tmp_path, [line + end for line in sent])
    recording = open_recording(path)
    assert [one.data.decode().rstrip() for one in recording.sent] == sent
    assert [one.host_ns for one in recording.sent][:2] == [ns_of(0.0), ns_of(0.05)]


def test_missing_definition_is_reported_and_read_from_the_folder_of_the_recording(tmp_path):
    data = sensor(300)
    path = reading_without_definitions(tmp_path, [""] * 300)
    with pytest.raises(RecordingError, match=r"put Reading\.msg beside it"):
        open_recording(path)
    (path.parent / "Reading.msg").write_text(LAB["lab/msg/Reading"])
    with pytest.raises(RecordingError, match=r"a part lab/msg/Place.* put Place\.msg beside it"):
        open_recording(path)
    (path.parent / "msg").mkdir()
    (path.parent / "msg" / "Place.msg").write_text(LAB["lab/msg/Place"])
    for one in (path, path.parent):
        rows = open_recording(one).table.rows
        np.testing.assert_allclose(rows.raw_b_gauss, data["mag"], rtol=1e-12)
        np.testing.assert_allclose(rows.gyro_b_rad_s, data["gyro"], rtol=1e-12)


def test_invalid_definition_is_reported(tmp_path):
    path = reading_without_definitions(tmp_path, [""] * 30)
    (path.parent / "Reading.msg").write_text("float64[ x\n")
    with pytest.raises(RecordingError) as refused:
        open_recording(path)
    assert "Reading.msg" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_huge_gap_is_a_gap(tmp_path, container):
    data = sensor()
    data["time_s"][300:] += 40 * 86400.0
    path = ros_files.save(tmp_path, container, [*imu(data), *magnetic(data)])
    table = open_recording(path).table
    assert len(table.rows) == 600
    assert table.starts == (0, 300)
    assert any("the clock was set" in note for note in table.notes)


def test_database_of_another_program_is_refused(tmp_path):
    path = tmp_path / "notes.db3"
    database = sqlite3.connect(path)
    database.execute("create table notes(text)")
    database.commit()
    database.close()
    with pytest.raises(RecordingError, match="is a database of another program"):
        open_recording(path)


def test_missing_topic_is_reported(tmp_path):
    path = good(tmp_path, "mcap")
    with pytest.raises(RecordingError, match=r"has no topic /mag; it has /imu/data, /imu/mag"):
        open_recording(path, choice=Choice(topics=("/mag",)))


def test_the_topic_is_chosen(tmp_path):
    other = sensor(seed=2)
    path = good(tmp_path, "mcap", *magnetic(other, "/other/mag"))
    out = tmp_path / "out.parquet"
    result = ahrsd("convert", path, "-o", out, "--topic", "/other/mag")
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(read_table(out).rows.raw_b_gauss, other["mag"], rtol=1e-12)


def test_missing_library_is_named_in_one_line(tmp_path, monkeypatch):
    path = good(tmp_path, "mcap")
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(RecordingError, match=r"pip install 'ahrsd\[ros\]'"):
        open_recording(path)


# -- convert ---------------------------------------------------------------------------------------


def test_convert_keeps_the_samples_and_reports_their_source(tmp_path):
    path, out = good(tmp_path, "bag"), tmp_path / "out.parquet"
    result = ahrsd("convert", path, "-o", out)
    assert result.exit_code == 0, result.output
    facts = {k.decode(): v.decode() for k, v in pyarrow.parquet.read_schema(out).metadata.items()}
    assert facts["ahrsd.format"] == "a ROS 1 bag"
    assert facts["ahrsd.mag source"] == "/imu/mag"
    assert facts["ahrsd.mag unit"] == "T in the file"
    assert facts["ahrsd.clock"].startswith("the headers' stamps, s since 2025-05-13T")
    assert "by gravity" in facts["ahrsd.frame"] or "as the driver" in facts["ahrsd.frame"]
    assert facts["ahrsd.undone"].startswith("nothing")
    assert facts["ahrsd.axes"] == "field and gyro agree"
    wanted, found = open_recording(path).table.rows, read_table(out).rows
    assert any(n.startswith("converted: a ROS 1 bag: field of") for n in read_table(out).notes)
    for name in ("time_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_convert_reports_different_axes(tmp_path):
    data = sensor(1200)
    turned = {**data, "mag": data["mag"] * [1.0, -1.0, -1.0]}
    path = ros_files.save(tmp_path, "mcap", [*imu(data), *magnetic(turned)])
    result = ahrsd("convert", path, "-o", tmp_path / "out.parquet")
    assert "the gyro: negate its y and z" in result.output


def test_slow_rates_in_degrees_are_recognised_by_the_field(tmp_path):
    data = sensor(2400, 20.0, turn=0.2)
    data["gyro"] = np.degrees(data["gyro"])
    path = ros_files.save(tmp_path, "mcap", [*imu(data), *magnetic(data)])
    result = ahrsd("convert", path, "-o", tmp_path / "out.parquet")
    assert result.exit_code == 0, result.output
    assert "deg/s" in result.output


def test_list_shows_the_contents(tmp_path, container):
    result = ahrsd("convert", good(tmp_path, container), "--list")
    assert result.exit_code == 0
    assert "/imu/mag  sensor_msgs/msg/MagneticField  600 messages, 20 Hz" in result.output


@pytest.mark.field_cases
@pytest.mark.parametrize("name", ["f14_imu_mag.bag", "f15_ros2_imu_mag.mcap"])
def test_recordings_from_the_field_are_read(name, tmp_path):
    path = shutil.copy(CASES / name, tmp_path / name)
    assert len(open_recording(Path(path)).table.rows) == 80


@pytest.mark.parametrize("stamp_ns", [0, None])
def test_recorder_times_are_used_without_consistent_header_times(tmp_path, container, stamp_ns):
    """A driver without time stamps, and one that stamps its Imu with the time since its start."""
    data = sensor()
    since = 5 * 10**9 - ros_files.BEGAN_NS
    turned = [(t, k, ns, {**f, "stamp_ns": ns + since if stamp_ns is None else 0})
              for t, k, ns, f in imu(data)]  # fmt: skip
    other = magnetic(data)
    if stamp_ns == 0:
        other = [(t, k, ns, {**f, "stamp_ns": 0}) for t, k, ns, f in other]
    recording = open_recording(ros_files.save(tmp_path, container, [*turned, *other]))
    np.testing.assert_allclose(recording.table.rows.raw_b_gauss, data["mag"], atol=1e-6)
    np.testing.assert_allclose(recording.table.rows.gyro_b_rad_s, data["gyro"], atol=1e-6)
    assert recording.facts["clock"].startswith("the recorder's, s since")
    words = "have no times" if stamp_ns == 0 else "are of different clocks"
    assert any(words in note for note in recording.notes)


def test_constant_one_of_two_gyros_is_reported(tmp_path, container):
    data = sensor()
    still = {**data, "gyro": 7e-4 * np.random.default_rng(0).normal(size=data["gyro"].shape)}
    messages = [*imu(data, "/b/data"), *imu(still, "/a/data"), *magnetic(data, "/mag")]
    with pytest.raises(RecordingError) as refused:
        open_recording(ros_files.save(tmp_path, container, messages))
    assert "holds 2 gyros: /a/data, /b/data; /a/data hardly turns" in str(refused.value)
    assert str(refused.value).endswith("--topic /b/data")
