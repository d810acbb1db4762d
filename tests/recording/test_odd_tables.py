"""Tables with clocks, numbers, names and rows as written by loggers and spreadsheets.

Each has a correct result: the readings and times of its sensor, or the one line that says what the
file is.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.feather
import pyarrow.parquet
import pytest
from ros_files import BIAS, HARD, sensor

from ahrsd.config.config import Config
from ahrsd.errors import RecordingError
from ahrsd.offline.calibrate import calibrate
from ahrsd.recording.column_names import ACCEL, GYRO, MAG, TIME, parse_columns
from ahrsd.recording.opening import open_recording
from ahrsd.recording.table import Table, read_table

COUNT, RATE_HZ = 800, 20.0
DATA = sensor(COUNT, RATE_HZ)
NAMES = (TIME, *MAG, *GYRO, *ACCEL)
Cells = dict[str, list[str]]


def cells(data: dict[str, np.ndarray] = DATA) -> Cells:
    """Each column as the texts of its numbers."""
    columns = {TIME: data["time_s"]}
    for names, key in ((MAG, "mag"), (GYRO, "gyro"), (ACCEL, "accel")):
        columns |= dict(zip(names, data[key].T, strict=True))
    return {name: [f"{value:.9g}" for value in values] for name, values in columns.items()}


def text(columns: Cells, mark: str = ",") -> str:
    rows = zip(*columns.values(), strict=True)
    return "\n".join([mark.join(columns), *(mark.join(row) for row in rows)]) + "\n"


def read(folder: Path, content: str | bytes, *columns: str) -> Table:
    path = folder / "t.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_table(path, columns=parse_columns(columns))


def are_the_readings(table: Table, data: dict[str, np.ndarray] = DATA) -> None:
    np.testing.assert_allclose(table.rows.raw_b_gauss, data["mag"], atol=1e-6)
    np.testing.assert_allclose(table.rows.gyro_b_rad_s, data["gyro"], atol=1e-6)


# -- clocks ----------------------------------------------------------------------------------------


def bunches(count: int, rate_hz: float, apart_s: float) -> np.ndarray:
    """Stamps of a host that gets `count` samples at once, and stamps them as it unpacks them."""
    draw = np.random.default_rng(4)
    place = np.arange(3200)
    late = draw.uniform(0.0, 2e-3, 3200 // count + 1)
    return 1e9 + (place // count + 1) * count / rate_hz + late[place // count] + apart_s * (
        place % count
    )  # fmt: skip


@pytest.mark.parametrize(
    ("stamps", "rate_hz"),
    [
        (bunches(8, 100.0, 0.0), 100.0),
        (bunches(16, 200.0, 1e-4), 200.0),
        (bunches(64, 400.0, 2e-5), 400.0),
        (np.trunc(np.arange(3200) / 200.0 * 100.0) / 100.0, 200.0),  # 0.29 * 100 is 28.99
    ],
)
def test_bunches_of_any_size_and_rounded_stamps_have_a_regular_clock(tmp_path, stamps, rate_hz):
    data = sensor(len(stamps), rate_hz)
    columns = cells(data) | {TIME: [f"{stamp:.6f}" for stamp in stamps]}
    table = read(tmp_path, text(columns))
    assert table.starts == (0,)
    np.testing.assert_allclose(np.diff(table.rows.time_s), 1.0 / rate_hz, rtol=2e-3)
    assert any(f"a regular clock of {rate_hz:g} Hz" in note for note in table.notes)


def of_day(seconds: float) -> str:
    return f"{seconds % 86400 // 3600:02.0f}:{seconds % 3600 // 60:02.0f}:{seconds % 60:06.3f}"


@pytest.mark.parametrize(
    ("stamp", "unit", "words"),
    [
        (lambda t: of_day(86390.0 + t), "", "after a day at row 202"),
        (lambda t: f"{(604790.0 + t) % 604800:.3f}", "", "after a week (GPS time) at row 202"),
        (lambda t: str((2**32 - 10_000_000 + round(t * 1e6)) % 2**32), ":us", "32 bits of us"),
        (lambda t: str((2**16 - 10_000 + round(t * 1e3)) % 2**16), ":ms", "16 bits of ms"),
        (lambda t: f"{(43190.0 + t) % 43200:.3f}", "", "after half a day"),
    ],
)
def test_wrapping_clock_is_unwrapped(tmp_path, stamp, unit, words):
    columns = cells() | {TIME: [stamp(t) for t in DATA["time_s"]]}
    table = read(tmp_path, text(columns), *([f"time=time_s{unit}"] if unit else []))
    assert table.starts == (0,)
    np.testing.assert_allclose(np.diff(table.rows.time_s), 0.05, atol=1e-5)
    assert any(words in note for note in table.notes)


@pytest.mark.parametrize(
    "form",
    [
        "%m/%d/%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%Y/%m/%d %H:%M:%S.%f",
        "%Y-%m-%d %I:%M:%S.%f %p", "%Y%m%dT%H%M%S.%f", "%Y-%m-%dT%H:%M:%S.%f+0200",
        "%d/%m/%Y %H:%M:%S:%f",
    ],
)  # fmt: skip
def test_dates_in_any_order(tmp_path, form):
    """Over midnight and noon, of a day that is no month."""
    for start in (datetime(2024, 10, 27, 23, 59, 50), datetime(2024, 10, 27, 11, 59, 50)):
        stamps = [(start + timedelta(seconds=float(t))).strftime(form) for t in DATA["time_s"]]
        table = read(tmp_path, text(cells() | {TIME: stamps}))
        np.testing.assert_allclose(np.diff(table.rows.time_s), 0.05, atol=1e-6)
        are_the_readings(table)


def test_ambiguous_date_is_reported(tmp_path):
    start = datetime(2024, 3, 4, 23, 59, 50)
    form = "%d/%m/%Y %H:%M:%S.%f"
    stamps = [(start + timedelta(seconds=float(t))).strftime(form) for t in DATA["time_s"]]
    with pytest.raises(RecordingError, match="row 2, column time_s: '04/03/2024 23:59:50"):
        read(tmp_path, text(cells() | {TIME: stamps}))


def test_change_of_the_time_zone_is_not_an_hour(tmp_path):
    start = datetime(2024, 10, 27, 2, 59, 40)
    stamps = [
        (start + timedelta(seconds=t - (0 if k < 400 else 3600))).isoformat(timespec="milliseconds")
        + ("+02:00" if k < 400 else "+01:00")
        for k, t in enumerate(DATA["time_s"].tolist())
    ]
    for written in (stamps, [stamp.replace(".", ",") for stamp in stamps]):
        table = read(tmp_path, text(cells() | {TIME: [f'"{stamp}"' for stamp in written]}))
        np.testing.assert_allclose(np.diff(table.rows.time_s), 0.05, atol=1e-6)
        assert table.starts == (0,)


def test_times_with_lost_digits_are_reported(tmp_path):
    for stamps in (
        [f"{1.7e9 + t:g}" for t in DATA["time_s"]],
        [f"{float(np.float32(1.7e9 + t)):.1f}" for t in DATA["time_s"]],
    ):
        with pytest.raises(RecordingError, match=r"in 800 rows .* the digits .* were lost"):
            read(tmp_path, text(cells() | {TIME: stamps}))


@pytest.mark.parametrize(("unit", "second"), [("min", 1 / 60), ("h", 1 / 3600), ("d", 1 / 86400)])
def test_times_in_longer_units(tmp_path, unit, second):
    columns = cells() | {TIME: [f"{500.0 + t * second:.12g}" for t in DATA["time_s"]]}
    if unit == "d":
        with pytest.raises(RecordingError, match="if it is in d: --columns time=NAME:d"):
            read(tmp_path, text(columns))
    table = read(tmp_path, text(columns), f"time=time_s:{unit}")
    np.testing.assert_allclose(np.diff(table.rows.time_s), 0.05, atol=1e-4)


# -- texts, numbers and names ----------------------------------------------------------------------


def grouped(mark: str, point: str) -> Callable[[str], str]:
    """A number in nT with marks between its thousands."""
    return lambda cell: (
        f"{float(cell) * 1e5:,.2f}".replace(",", "!").replace(".", point).replace("!", mark)
    )


def in_nanotesla(write: Callable[[str], str], point: str = ".") -> Cells:
    out = {}
    for name, values in cells().items():
        if name in MAG:
            out[name.replace("_gauss", " (nT)")] = [write(value) for value in values]
        else:
            out[name] = [value.replace(".", point) for value in values]
    return out


UNITS = "s,G,G,G,rad/s,rad/s,rad/s,m/s^2,m/s^2,m/s^2"
PLAIN = text(cells())
QUOTED = text({name: [f'"{v}"' for v in values] for name, values in cells().items()})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (PLAIN.encode("utf-32"), "the text is UTF-32"),
        (PLAIN.replace("\n", "\n" + UNITS + "\n", 1).encode(), "below the names has their units"),
        (b"Logger 3.1\nDate: 2024-05-05, by X\n\n" + PLAIN.encode(), "in front of the names: 3"),
        (text(cells(), "|").encode(), "separated by bars"),
        (text(cells(), " | ").replace("\n", "\n" + "-" * 9 + "+" + "-" * 9 + "\n", 1).encode()
         + b"(800 rows)\n", "separated by bars"),
        (PLAIN.encode() + b"\xff" * 4096, "4096 bytes of erased memory"),
        (PLAIN.encode() + 30 * b",,,,,,,,,\n", "without a cell: 30 rows"),
        (text(in_nanotesla(lambda v: f'"{grouped(",", ".")(v)}"')).encode(), "',' between"),
        (text(in_nanotesla(grouped(".", ","), ","), ";").encode(), "'.' between"),
        (text(in_nanotesla(grouped("'", ".")), ";").encode(), "between their thousands"),
        (QUOTED.replace(".", ",").encode(), "decimal commas"),
        (PLAIN.replace("-", "\u2212").encode(), "minus signs of typesetting"),
        (PLAIN.replace(",", ";").replace(".", ",").replace("-", "\u2013").encode(),
         "minus signs of typesetting"),
        (PLAIN.replace(NAMES[7], "temp").replace(NAMES[8], "temp").encode(),
         "of columns with the same name the first counts: temp"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("zipped", [False, True])
def test_texts_of_spreadsheets_and_loggers(tmp_path, content, words, zipped):
    table = read(tmp_path, gzip.compress(content) if zipped else content)
    are_the_readings(table)
    assert any(words in note for note in table.notes), table.notes


def test_a_mark_of_utf_8_amid_the_rows_is_that_of_another_file(tmp_path):
    again = cells() | {TIME: [f"{300.0 + t:.3f}" for t in DATA["time_s"]]}
    content = b"\xef\xbb\xbf" + PLAIN.encode() + b"\xef\xbb\xbf" + text(again).encode()
    table = read(tmp_path, content)
    assert len(table.rows) == 2 * COUNT
    assert table.starts == (0, COUNT)


@pytest.mark.parametrize(
    ("mag", "gyro", "factor", "rate"),
    [
        ("gamma", "rpm", 1e5, 30.0 / np.pi), ("microtesla", "deg/h", 100.0, np.degrees(3600.0)),
        ("A/m", "deg/sec", 1e3 / (4 * np.pi), np.degrees(1.0)), ("Gs", "rad/sec", 1.0, 1.0),
    ],
)  # fmt: skip
def test_units_in_words(tmp_path, mag, gyro, factor, rate):
    columns = {}
    for name, values in cells(
        {**DATA, "mag": DATA["mag"] * factor, "gyro": DATA["gyro"] * rate}
    ).items():
        unit = {"mag": mag, "gyr": gyro}.get(name[:3])
        columns[name if unit is None else f"{name.split('_')[0]}_{name.split('_')[1]} ({unit})"] = (
            values
        )
    table = read(tmp_path, text(columns))
    np.testing.assert_allclose(table.rows.raw_b_gauss, DATA["mag"], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(table.rows.gyro_b_rad_s, DATA["gyro"], rtol=1e-5, atol=1e-6)


def test_counts_of_a_converter_have_a_number_for_a_unit(tmp_path):
    names = {MAG[k]: f"mag_{axis} (counts)" for k, axis in enumerate("xyz")}
    data = {**DATA, "mag": DATA["mag"] * 1090.0}
    columns = {names.get(name, name): values for name, values in cells(data).items()}
    with pytest.raises(
        RecordingError, match=r"mag_x=mag_x \(counts\):NUMBER.*one unit of the file, in gauss"
    ):
        read(tmp_path, text(columns))
    said = ",".join(f"mag_{axis}=mag_{axis} (counts):{1 / 1090:.9g}" for axis in "xyz")
    table = read(tmp_path, text(columns), said)
    np.testing.assert_allclose(table.rows.raw_b_gauss, DATA["mag"], rtol=1e-6)


def test_nan_as_other_languages_print_it_is_a_hole(tmp_path):
    columns = cells()
    for name, word in zip(ACCEL, ("-1.#IND", "1.#QNAN", "-nan(ind)"), strict=True):
        columns[name][50] = word
    table = read(tmp_path, text(columns))
    assert "no acceleration in 1 row" in table.notes[0]
    np.testing.assert_allclose(table.rows.accel_b_m_s2, DATA["accel"], atol=0.02)


# -- rows ------------------------------------------------------------------------------------------


def held(values: np.ndarray, rows: int) -> np.ndarray:
    return values[np.arange(len(values)) // rows * rows]


def test_held_gyro_is_interpolated_between_its_readings(tmp_path):
    data = sensor(2400, 40.0)
    table = read(tmp_path, text(cells({**data, "gyro": held(data["gyro"], 4)})))
    assert "the gyro has a new reading only every 4 rows: between" in table.notes[0]
    assert len(table.rows) == 2397
    fresh = table.rows.gyro_b_rad_s[::4]
    np.testing.assert_allclose(fresh, data["gyro"][:2397:4], atol=1e-6)
    middle = (fresh[:-1] + fresh[1:]) / 2
    np.testing.assert_allclose(table.rows.gyro_b_rad_s[2::4], middle, atol=1e-6)
    result = calibrate(tmp_path / "t.csv", Config())
    assert result.converged
    np.testing.assert_allclose(result.estimate.hard_iron_gauss, HARD, atol=1e-3)
    np.testing.assert_allclose(result.estimate.gyro_bias_rad_s, BIAS, atol=6e-4)
    assert not [text for text in result.all_warnings() if "iron changed" in text]


def test_empty_cells_of_a_slower_gyro_are_interpolated(tmp_path):
    columns = cells()
    for name in GYRO:
        columns[name] = [v if k % 4 == 0 else "" for k, v in enumerate(columns[name])]
    table = read(tmp_path, text(columns))
    assert "the gyro has a reading in 200 of 800 rows" in table.notes[0]
    np.testing.assert_allclose(table.rows.gyro_b_rad_s[::4], DATA["gyro"][:797:4], atol=1e-6)


def test_rows_that_repeat_all_readings_count_once(tmp_path):
    data = {key: values if key == "time_s" else held(values, 3) for key, values in DATA.items()}
    table = read(tmp_path, text(cells(data)))
    assert len(table.rows) == 267
    assert "every reading is repeated in 3 rows" in table.notes[0]
    np.testing.assert_allclose(table.rows.raw_b_gauss, DATA["mag"][::3], atol=1e-6)
    np.testing.assert_allclose(np.diff(table.rows.time_s), 0.15, atol=1e-6)


def test_held_magnetometer_is_unchanged(tmp_path):
    table = read(tmp_path, text(cells({**DATA, "mag": held(DATA["mag"], 5)})))
    assert len(table.rows) == COUNT
    assert table.notes == ()


def test_coarse_readings_at_rest_are_no_hold(tmp_path):
    draw = np.random.default_rng(3)
    still = np.round(1e-3 * draw.normal(size=(COUNT, 3)) / 4e-3) * 4e-3
    table = read(tmp_path, text(cells({**DATA, "gyro": still})))
    assert len(table.rows) == COUNT
    assert not any("new reading" in note or "each is used once" in note for note in table.notes)


def two_in_turn() -> Cells:
    """Rows of two sensors with another hard iron, in turn."""
    other = {**sensor(COUNT, RATE_HZ, seed=5)}
    other["mag"] = other["mag"] + 0.1
    first, second = cells(), cells(other)
    return {
        name: [v for pair in zip(first[name], second[name], strict=True) for v in pair]
        for name in NAMES
    }


@pytest.mark.parametrize("kinds", [["1", "2"], ["imu_left", "imu_right"]])
def test_alternating_sensors_are_separated_by_their_column(tmp_path, kinds):
    shown = ", ".join(kinds)
    refused = rf"rows of 2 sensors in turn, by its column id \({shown}\)"
    with pytest.raises(RecordingError, match=refused):
        read(tmp_path, text({**two_in_turn(), "id": kinds * COUNT}))


def test_alternating_sensors_are_separated_by_words_of_a_parquet_table(tmp_path):
    columns = {name: [float(cell) for cell in column] for name, column in two_in_turn().items()}
    table = pyarrow.table({**columns, "frame_id": ["port", "starboard"] * COUNT})
    pyarrow.parquet.write_table(table, tmp_path / "t.parquet")
    with pytest.raises(RecordingError, match=r"column frame_id \(port, starboard\)"):
        read_table(tmp_path / "t.parquet")


def test_alternating_sensors_without_a_column_for_them_are_noted(tmp_path):
    both = two_in_turn()
    both["time_s"] = [f"{0.5 * k / RATE_HZ:.6f}" for k in range(2 * COUNT)]
    (note,) = [one for one in read(tmp_path, text(both)).notes if "in turn" in one]
    assert "is the same again after 2 rows: these are the rows of 2 sensors in turn" in note
    assert not any("in turn" in one for one in read(tmp_path, text(cells())).notes)


def one_sensor_each(fast: dict[str, np.ndarray], slow: dict[str, np.ndarray]) -> Cells:
    """Rows of a gyro with its accelerometer, and of a magnetometer, as tables joined by time."""
    rows = [
        (t, ["", "", "", *(f"{v:.9g}" for v in (*g, *a))])
        for t, g, a in zip(fast["time_s"], fast["gyro"], fast["accel"], strict=True)
    ]
    rows += [
        (t, [*(f"{v:.9g}" for v in m), *[""] * 6])
        for t, m in zip(slow["time_s"], slow["mag"], strict=True)
    ]
    rows.sort(key=lambda row: row[0])
    columns = zip(*(cells for _, cells in rows), strict=True)
    named = dict(zip((*MAG, *GYRO, *ACCEL), map(list, columns), strict=True))
    return {TIME: [f"{t:.9g}" for t, _ in rows], **named}


def test_rows_of_one_sensor_each_are_one_row_per_reading_of_the_magnetometer(tmp_path):
    fast = sensor(4000, 100.0)
    slow = {name: values[::5] for name, values in fast.items()}
    table = read(tmp_path, text(one_sensor_each(fast, slow)))
    np.testing.assert_allclose(table.rows.time_s, slow["time_s"], atol=1e-6)
    np.testing.assert_allclose(table.rows.raw_b_gauss, slow["mag"], atol=1e-6)
    inner = fast["gyro"][1:].reshape(-1)[: 3 * 3995].reshape(799, 5, 3)  # of (t[k-1], t[k]]
    ends = 0.5 * (fast["gyro"][:-5:5] - fast["gyro"][5::5])
    np.testing.assert_allclose(
        table.rows.gyro_b_rad_s[1:], inner.mean(axis=1) + 0.2 * ends, atol=1e-6
    )
    assert table.starts == (0,)
    assert table.notes[0].startswith("each row holds one sensor: 800 of 4800 the magnetometer")


def test_times_of_rows_of_one_sensor_each_stay(tmp_path):
    """A reading that follows another sensor's at once was not stamped by a host in a bunch."""
    slow = {**DATA, "time_s": DATA["time_s"] + 0.001}
    table = read(tmp_path, text(one_sensor_each(DATA, slow)))
    np.testing.assert_allclose(table.rows.time_s, slow["time_s"], atol=1e-6)
    assert not any("host" in note for note in table.notes)


def test_rows_of_one_sensor_each_need_their_time(tmp_path):
    columns = one_sensor_each(DATA, DATA)
    columns[TIME][7] = ""
    with pytest.raises(RecordingError, match="row 9, column time_s: empty"):
        read(tmp_path, text(columns))


def test_a_clock_set_back_amid_rows_of_one_sensor_each_is_refused(tmp_path):
    columns = one_sensor_each(DATA, DATA)
    times = [float(cell) for cell in columns[TIME]]
    columns[TIME] = [f"{t - 5.0 * (k >= 800):.9g}" for k, t in enumerate(times)]
    with pytest.raises(RecordingError, match=r"the magnetometer: its time goes back by 4.95 s"):
        read(tmp_path, text(columns))


def test_words_in_turn_beside_one_sensor_are_left_out(tmp_path):
    table = read(tmp_path, text(cells() | {"lamp": ["on", "off"] * 400}))
    are_the_readings(table)
    assert table.notes == ("column lamp is text and was left out",)


@pytest.mark.parametrize("levels", [["0"] * 400 + ["1"] * 400, ["0", "1"] * 400])
def test_switch_column_is_not_another_sensor(tmp_path, levels):
    table = read(tmp_path, text(cells() | {"switch": levels}))
    are_the_readings(table)


@pytest.mark.parametrize("mark", ["-9999", "1e38", "65535"])
def test_impossible_readings_are_left_out(tmp_path, mark):
    columns = cells()
    for name in MAG:
        columns[name][100:103] = [mark] * 3
    table = read(tmp_path, text(columns))
    assert len(table.rows) == COUNT - 3
    assert table.starts == (0, 100)
    assert "because of an impossible reading: 3 rows, first row 102" in table.notes[0]


def test_a_field_of_zeros_is_left_out(tmp_path):
    """What a driver writes where a reading failed."""
    columns = cells()
    for name in MAG:
        columns[name][100:140] = ["0"] * 40
    table = read(tmp_path, text(columns))
    assert len(table.rows) == COUNT - 40
    assert table.starts == (0, 100)
    assert table.notes == (
        "left out because the magnetometer reads 0 0 0, which is no field: 40 rows, first row 102",
    )


@pytest.mark.parametrize("every", [4, 10])
def test_zeros_between_the_readings_of_a_slower_magnetometer_are_none(tmp_path, every):
    columns = cells()
    for name in MAG:
        columns[name] = [cell if k % every == 0 else "0.0" for k, cell in enumerate(columns[name])]
    table = read(tmp_path, text(columns))
    assert len(table.rows) == COUNT
    assert f"a reading in {COUNT // every} of {COUNT} rows" in table.notes[0]
    np.testing.assert_allclose(table.rows.raw_b_gauss, held(DATA["mag"], every), atol=1e-6)


@pytest.mark.parametrize(("sign", "told"), [(1.0, True), (-1.0, False)])
def test_axes_whose_z_points_up_are_told(tmp_path, sign, told):
    """A calibration of such a table is not one in the axes of a VN-100."""
    level = np.tile([0.1, -0.2, sign * 9.8], (COUNT, 1))
    table = read(tmp_path, text(cells({**DATA, "accel": level})))
    assert [note[:27] for note in table.notes] == ["by gravity its z points up:"] * told


# -- other files -----------------------------------------------------------------------------------


def feather(path: Path) -> None:
    pyarrow.feather.write_feather(pyarrow.table({"a": list(range(100))}), str(path))


def lz4(path: Path) -> None:
    with pyarrow.output_stream(str(path), compression="lz4") as file:
        file.write(PLAIN.encode())


BYTES = b"\xfa\x05\x01\x00\x0e\x00" + bytes(range(46))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (gzip.compress(gzip.compress(PLAIN.encode())), "is packed with gzip twice"),
        (lz4, "is packed with lz4"),
        (feather, "is an Arrow or Feather file; write it as Parquet"),
        (b'{"time_s": 0.0, "mag_x": 0.3}\n' * 50, "is JSON, not a table"),
        (b'[{"time_s": 0.0}]', "is JSON, not a table"),
        (b"header:\n  stamp:\n    sec: 3\nmagnetic_field:\n  x: 1e-5\n---\n" * 30,
         "is what `rostopic echo` prints"),
        ((BYTES * 40).hex(" ").encode(), "is a hex dump"),
        (b"\n".join(b"%08x: %s" % (k, BYTES[k:k + 16].hex(" ", 2).encode())
                    for k in range(0, 48, 16)), "is a hex dump"),
        (b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n" * 3,
         "is an ArduPilot log as text"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.gz"])
def test_other_files_are_recognised_by_their_content(tmp_path, content, words, name):
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content)
    with pytest.raises(RecordingError) as refused:
        open_recording(path)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
