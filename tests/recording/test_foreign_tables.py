"""Tables written by other programs and people: read with a note, or refused in one line."""

from __future__ import annotations

import gzip
import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import ros_files

from ahrsd import so3
from ahrsd.__main__ import main
from ahrsd.cli import module_of
from ahrsd.config.config import Config
from ahrsd.errors import AhrsdError, RecordingError
from ahrsd.inputs import Received
from ahrsd.offline.calibrate import calibrate
from ahrsd.recording.column_names import (
    ACCEL,
    GYRO,
    MAG,
    REQUIRED,
    TIME,
    ColumnError,
    parse_columns,
    resolve,
)
from ahrsd.recording.opening import open_recording
from ahrsd.recording.table import read_table
from ahrsd.recording.text_table import is_table_text
from drivers.vn100.messages import encode_sentence

NAMES = (*REQUIRED, *ACCEL)
COUNT, RATE_HZ = 400, 20.0
HARD = np.array([0.12, -0.08, 0.06])
BIAS = np.array([3.5e-3, -4.2e-3, 2.1e-3])


def sensor(count: int = COUNT, rate_hz: float = RATE_HZ, seed: int = 1) -> dict[str, np.ndarray]:
    """Columns of a tumbling sensor of known truth, by canonical name."""
    draw = np.random.default_rng(seed)
    time_s = np.arange(count) / rate_hz
    rate = np.column_stack(
        [0.5 * np.sin(0.9 * time_s), 0.4 * np.sin(0.61 * time_s + 1), 0.4 + 0.2 * np.sin(time_s)]
    )
    R = so3.products(so3.exp(rate / rate_hz))
    mag = np.einsum("nji,j->ni", R, [0.25, 0.0, 0.43]) + HARD + 1e-3 * draw.normal(size=(count, 3))
    gyro = rate + BIAS + 7e-4 * draw.normal(size=(count, 3))
    force = np.einsum("nji,j->ni", R, [0.0, 0.0, -9.80665])
    return {
        TIME: time_s,
        **dict(zip(MAG, mag.T, strict=True)),
        **dict(zip(GYRO, gyro.T, strict=True)),
        **dict(zip(ACCEL, force.T, strict=True)),
    }


@pytest.mark.parametrize(
    ("angle", "rate", "option"),
    [
        ("Angle {} (deg)", "AngularRate_{}", "gyro_x=AngularRate_X,gyro_y=AngularRate_Y"),
        ("Euler angle {}", "Angle rate {} (raw)", "gyro_x=Angle rate X (raw):NUMBER,gyro_y="),
    ],
)
def test_an_angle_is_not_offered_as_a_rate(angle, rate, option):
    names = [TIME, *MAG, *(angle.format(a) for a in "XYZ"), *(rate.format(a) for a in "XYZ")]
    with pytest.raises(ColumnError) as caught:
        resolve(names)
    assert f"--columns {option}" in caught.value.remedy


@pytest.mark.parametrize(
    ("axes", "signs", "words"),
    [
        ((0, 1, 2), (1, -1, 1), "the magnetometer is left-handed: negate its y"),
        pytest.param(
            (1, 0, 2),
            (1, 1, 1),
            "the magnetometer is left-handed: its correct x y z are its y x z",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (0, 1, 2),
            (1, -1, -1),
            "the magnetometer is turned against the gyro: negate its y and z",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_wrong_axes_are_reported_as_the_reason_for_no_convergence(tmp_path, axes, signs, words):
    """Not their consequences: a rate or a unit that looks wrong."""
    made = sensor(4000)
    turned = dict(zip(MAG, [sign * made[MAG[k]] for k, sign in zip(axes, signs, strict=True)],
                      strict=True))  # fmt: skip
    result = calibrate(save(tmp_path / "t.csv", texts(made | turned)), Config())
    assert not result.converged
    (reason,) = result.reasons()
    assert reason.startswith(f"not converged: {words}")
    assert reason.endswith(": put this right and calibrate again")
    assert [text for text in result.json("magyc")["warnings"] if words in text] == [reason]
    right = calibrate(save(tmp_path / "right.csv", texts(made)), Config())
    assert right.converged
    assert not [text for text in right.all_warnings() if "put this right" in text]


def texts(columns: dict[str, np.ndarray]) -> dict[str, list[str]]:
    return {name: [f"{value:.9g}" for value in values] for name, values in columns.items()}


def lines_of(cells: dict[str, list[str]], separator: str = ",") -> list[str]:
    rows = zip(*cells.values(), strict=True)
    return [separator.join(cells), *(separator.join(row) for row in rows)]


def save(path: Path, cells: dict[str, list[str]], separator: str = ",") -> Path:
    path.write_text("\n".join(lines_of(cells, separator)) + "\n")
    return path


def same(table, columns: dict[str, np.ndarray], rows: slice = slice(None)) -> None:
    np.testing.assert_allclose(table.rows.time_s, columns[TIME][rows], atol=1e-6)
    mag = np.column_stack([columns[name] for name in MAG])[rows]
    gyro = np.column_stack([columns[name] for name in GYRO])[rows]
    np.testing.assert_allclose(table.rows.raw_b_gauss, mag, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(table.rows.gyro_b_rad_s, gyro, rtol=1e-6, atol=1e-7)


# -- texts -----------------------------------------------------------------------------------------

PLAIN = "\n".join(lines_of(texts(sensor()))) + "\n"
COMMENTED = "\n".join(f"{line}\n# a remark" if k % 100 == 7 else line
                      for k, line in enumerate(PLAIN.splitlines())) + "\n"  # fmt: skip
HEADER = PLAIN.splitlines()[0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (PLAIN.encode("utf-8-sig"), ""),
        (PLAIN.encode("utf-16"), "the text is UTF-16"),
        (PLAIN.encode("utf-16-le"), "the text is UTF-16"),
        (PLAIN.replace("\n", "\r\n").encode(), ""),
        (PLAIN.replace("\n", "\r\r\n").encode(), ""),
        (PLAIN.replace("\n", "\r").encode(), ""),
        (PLAIN.replace(",", ";").encode(), "separated by semicolons"),
        (PLAIN.replace(",", "\t").encode(), "separated by tabs"),
        (PLAIN.replace(",", "  ").encode(), "separated by blanks"),
        (PLAIN.replace(",", ";").replace(".", ",").encode(), "decimal commas"),
        (b"sep=;\n" + PLAIN.replace(",", ";").encode(), "separated by semicolons"),
        (b'"sep=,"\r\n' + PLAIN.encode(), ""),
        (b"# logger 3\n\n# started at noon\n" + PLAIN.encode(), ""),
        (b"# " + PLAIN.encode(), ""),
        (b"% " + PLAIN.replace(",", " ").encode(), "separated by blanks"),
        (COMMENTED.encode(), "4 comment lines"),
        (PLAIN.upper().replace("E-", "e-").encode(), "without their capitals"),
        (PLAIN.replace(",", ", ").encode(), ""),
        (PLAIN.replace("\n", ",\n").encode(), ""),
        (PLAIN.replace("\n", ",\n").replace(HEADER + ",", HEADER).encode(), ""),
        (PLAIN.replace(HEADER, HEADER + ",,").encode(), ""),
        (PLAIN.replace(HEADER, ",".join(f'"{n}"' for n in HEADER.split(","))).encode(), ""),
        (PLAIN.encode() + bytes(5000), "5000 NUL bytes"),
        (PLAIN.encode() + b"20.0,0.1,0.2", "the last row is cut off"),
        (PLAIN.replace(HEADER, HEADER + ",Temperatur_\u00b0C").replace("\n", ",1\n")
         .replace("C,1\n", "C\n").encode("cp1252"), ""),
    ],
)  # fmt: skip
@pytest.mark.parametrize("zipped", [False, True])
def test_texts_of_other_programs_are_read(tmp_path, content, words, zipped):
    path = tmp_path / ("t.csv" + ".gz" * zipped)
    path.write_bytes(gzip.compress(content) if zipped else content)
    table = read_table(path)
    same(table, sensor())
    assert table.starts == (0,)
    assert words in " ".join(table.notes)
    assert words or not table.notes


def test_a_gzip_that_is_cut_off_gives_its_whole_rows(tmp_path):
    path = tmp_path / "t.csv.gz"
    path.write_bytes(gzip.compress(PLAIN.encode())[:-9_000])
    table = read_table(path)
    assert 20 < len(table.rows) < COUNT
    same(table, sensor(), slice(0, len(table.rows)))
    assert "the gzip file is truncated after" in table.notes[0]


def test_repeated_header_of_a_restarted_logger_is_accepted(tmp_path):
    rows = PLAIN.splitlines()
    path = tmp_path / "t.csv"
    path.write_text("\n".join([*rows[:201], rows[0], *rows[221:]]) + "\n")
    table = read_table(path)
    assert len(table.rows) == 380
    assert table.starts == (0, 200)
    assert "left out amid the rows: 1 more line of names" in table.notes[0]


def test_few_rows_with_a_wrong_number_of_cells_are_left_out(tmp_path):
    rows = PLAIN.splitlines()
    rows[100] = rows[100].rsplit(",", 3)[0]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(rows) + "\n")
    table = read_table(path)
    assert (len(table.rows), table.starts) == (COUNT - 1, (0, 99))
    assert "left out for another number of cells: 1 row, first row 101" in table.notes
    path.write_text("\n".join(row.rsplit(",", k % 2)[0] for k, row in enumerate(rows)) + "\n")
    with pytest.raises(RecordingError, match=r"row 2 has 9 cells where 10 are named|no number"):
        read_table(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"time_s\n", "has no column mag_x_gauss"),
        (HEADER.encode() + b"\n", "has 0 rows, 20 are needed"),
        (b"\n".join(PLAIN.encode().splitlines()[1:]), "row 1 holds numbers where the columns'"),
        (bytes(4000), "NUL bytes"),
        (b"\n\n\n", "it has no rows"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "is a Git LFS pointer"),
        (b"<!DOCTYPE html><html>", "is a web page"),
        (b"PK\x03\x04" + bytes(200), "is a zip archive or a spreadsheet"),
        (b"x" * 3_000_000, "has no line end within its first"),
        (HEADER.encode() + b",mag_y_gauss\n", "mag_y_gauss twice"),
    ],
)
def test_unreadable_table_is_refused_in_one_line(tmp_path, content, words):
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        open_recording(path)
    assert words in str(caught.value)
    assert str(caught.value).isprintable()


# -- names and units -------------------------------------------------------------------------------


def foreign(unit: dict[str, float], stems: tuple[str, str, str]) -> dict[str, np.ndarray]:
    columns = sensor()
    out = {"stamp": columns[TIME] / unit["time"]}
    for stem, names, kind in zip(stems, (MAG, GYRO, ACCEL), ("mag", "gyro", "accel"), strict=True):
        for axis, name in zip("XYZ", names, strict=True):
            out[f"{stem}{axis}"] = columns[name] / unit[kind]
    return out


G, DEG = 9.80665, np.pi / 180


@pytest.mark.parametrize(
    ("time", "mag", "gyro", "accel"),
    [
        (("s", 1.0), ("T", 1e4), ("deg/s", DEG), ("g", G)),
        (("ms", 1e-3), ("uT", 1e-2), ("dps", DEG), ("mg", 1e-3 * G)),
        (("us", 1e-6), ("\u00b5T", 1e-2), ("\u00b0/s", DEG), ("m/s^2", 1.0)),
        (("ns", 1e-9), ("nT", 1e-5), ("rad/s", 1.0), ("m/s2", 1.0)),
        (("MS", 1e-3), ("mG", 1e-3), ("mrad/s", 1e-3), ("G", G)),
        (("s", 1.0), ("G", 1.0), ("Deg/s", DEG), ("m_s2", 1.0)),
        (("s", 1.0), ("mT", 10.0), ("rad/s", 1.0), ("g", G)),
    ],
)
def test_columns_can_be_given_with_names_and_units(tmp_path, time, mag, gyro, accel):
    unit = {"time": time[1], "mag": mag[1], "gyro": gyro[1], "accel": accel[1]}
    columns = foreign(unit, ("Mag", "Gyr", "Acc"))
    path = save(tmp_path / "t.csv", {k: [repr(float(x)) for x in v] for k, v in columns.items()})
    said = [f"time=stamp:{time[0]}"]
    for stem, short, (name, _) in (
        ("Mag", "mag", mag),
        ("Gyr", "gyro", gyro),
        ("Acc", "accel", accel),
    ):
        said += [f"{short}_{axis.lower()}={stem}{axis}:{name}" for axis in "XYZ"]
    table = read_table(path, columns=parse_columns([",".join(said)]))
    same(table, sensor())
    np.testing.assert_allclose(table.rows.accel_b_m_s2[:, 0], sensor()[ACCEL[0]], atol=1e-6)
    assert table.rows.covariates == {}


def test_minus_inverts_a_column_and_commas_in_names_are_escaped(tmp_path):
    columns = sensor()
    cells = texts({**columns, MAG[1]: -columns[MAG[1]]})
    cells["field, z: [G]"] = cells.pop(MAG[2])
    rows = lines_of(cells)
    rows[0] = rows[0].replace("field, z: [G]", '"field, z: [G]"')
    (tmp_path / "t.csv").write_text("\n".join(rows) + "\n")
    given = parse_columns([r"mag_y=-mag_y_gauss", r"mag_z=field\, z: [G]:G"])
    same(read_table(tmp_path / "t.csv", columns=given), columns)


def test_counts_of_nanoseconds_lose_no_digit(tmp_path):
    columns = sensor()
    cells = texts(columns)
    cells[TIME] = [str(1_700_000_000_123_456_789 + 50_000_000 * k) for k in range(COUNT)]
    path = save(tmp_path / "t.csv", cells)
    with pytest.raises(RecordingError, match=r"is no sensor's rate.*--columns time=NAME:ns"):
        read_table(path)
    table = read_table(path, columns=parse_columns(["time=time_s:ns"]))
    np.testing.assert_allclose(table.rows.time_s, 0.05 * np.arange(COUNT), atol=1e-9)


def test_milliseconds_since_1970_are_recognised_with_a_note(tmp_path):
    cells = texts(sensor())
    cells[TIME] = [str(1_700_000_000_000 + 50 * k) for k in range(COUNT)]
    path = save(tmp_path / "t.csv", cells)
    with pytest.raises(RecordingError, match="if it is in ms: --columns time=NAME:ms"):
        read_table(path)
    table = read_table(path, columns=parse_columns(["time=time_s:ms"]))
    np.testing.assert_allclose(np.diff(table.rows.time_s), 0.05, atol=1e-9)


@pytest.mark.parametrize(
    "stamp",
    [
        lambda k: f"2024-05-01T23:59:{55 + k // 20:02d}.{50 * (k % 20):03d}Z" if k < 100 else
                  f"2024-05-02T00:00:{(k - 100) // 20:02d}.{50 * (k % 20):03d}Z",
        lambda k: f"2024-05-01 10:00:{k // 20:02d}.{50 * (k % 20):03d}",
        lambda k: f"2024-05-01T10:00:{k // 20:02d}.{50 * (k % 20):03d}+02:00",
        lambda k: f"2024-05-01 10:00:{k // 20:02d},{50 * (k % 20):03d}",
        lambda k: f"10:00:{k // 20:02d}.{50 * (k % 20):03d}",
    ],
)  # fmt: skip
def test_times_of_day_and_dates(tmp_path, stamp):
    cells = texts(sensor())
    cells[TIME] = [f'"{stamp(k)}"' for k in range(COUNT)]
    table = read_table(save(tmp_path / "t.csv", cells))
    np.testing.assert_allclose(np.diff(table.rows.time_s), 0.05, atol=1e-6)
    assert len(table.rows) == COUNT


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mag_x", "is no entry; write NAME=COLUMN:UNIT"),
        ("=MagX", "is no entry"),
        ("mag_x=", "is no entry"),
        ("mag_x=MagX:furlong", "'furlong' is no unit of mag_x_gauss; it may be G, mG, T"),
        ("mag_x=A,mag_x=B", "is given twice"),
        ("time=t:y", "'y' is no unit of time_s; it may be s, ms"),
        ("mag_x=\x1b[2JX:q", "\\x1b[2JX"),
    ],
)
def test_a_wrong_option_is_refused_by_its_entry(text, words):
    with pytest.raises(AhrsdError) as caught:
        parse_columns([text])
    assert words in str(caught.value)


def test_missing_column_is_reported_with_the_nearest_name(tmp_path):
    path = save(tmp_path / "t.csv", texts(sensor()))
    with pytest.raises(RecordingError, match=r"no column mag_x_gaus .*is mag_x_gauss meant"):
        read_table(path, columns=parse_columns(["mag_x=mag_x_gaus:G"]))


def test_error_message_has_the_option_that_reads_the_table(tmp_path):
    unit = {"time": 1e-3, "mag": 1e-2, "gyro": DEG, "accel": G}
    columns = foreign(unit, ("mag_", "gyr_", "acc_"))
    named = {name.replace("mag_", "mag").replace("X", "_x_uT").replace("Y", "_y_uT")
             .replace("Z", "_z_uT") if name.startswith("mag_") else name: values
             for name, values in columns.items()}  # fmt: skip
    path = save(tmp_path / "t.csv", {k: [repr(float(x)) for x in v] for k, v in named.items()})
    with pytest.raises(RecordingError) as caught:
        read_table(path)
    option = str(caught.value).split("--columns ")[1].rstrip(")")
    assert "mag_x=mag_x_uT:uT" in option
    assert "gyro_x=gyr_X" in option
    assert "time=stamp" in option


def test_the_exporter_of_the_sdk(tmp_path):
    columns = sensor()
    cells = texts({
        "Temperature": np.full(COUNT, 25.0),
        **{f"UncompMag{a}": columns[n] for a, n in zip("XYZ", MAG, strict=True)},
        **{f"UncompAcc{a}": columns[n] for a, n in zip("XYZ", ACCEL, strict=True)},
        **{f"UncompGyro{a}": columns[n] for a, n in zip("XYZ", GYRO, strict=True)},
        **{f"Mag{a}": columns[n] + 1 for a, n in zip("XYZ", MAG, strict=True)},
    })  # fmt: skip
    cells["TimeStartup"] = [str(5_000_000_000 + 50_000_000 * k) for k in range(COUNT)]
    table = read_table(save(tmp_path / "t.csv", cells))
    same(table, {**columns, TIME: 0.05 * np.arange(COUNT)})
    assert table.rows.covariates["temperature_c"][0] == 25.0
    assert "VectorNav's SDK" in table.notes[0]


def test_foreign_column_names_are_escaped(tmp_path):
    cells = texts(sensor())
    cells["\x1b[2J$x$"] = ["1"] * COUNT
    cells["y" * 1_000_000] = ["2"] * COUNT
    table = read_table(save(tmp_path / "t.csv", cells))
    assert all(name.isprintable() and len(name) <= 64 for name in table.rows.covariates)
    assert "\\x1b[2J$x$" in table.rows.covariates


# -- clocks ----------------------------------------------------------------------------------------


def calibrated_times(stamps: np.ndarray, tmp_path: Path, count: int = 2000, rate_hz: float = 100.0):
    columns = sensor(count, rate_hz)
    cells = texts(columns) | {TIME: [repr(float(stamp)) for stamp in stamps]}
    return read_table(save(tmp_path / "t.csv", cells), check_units=False)


def bunched(instants: np.ndarray, period_s: float = 0.016, seed: int = 2) -> np.ndarray:
    """Stamps of an adapter that hands over what came since its last packet."""
    draw = np.random.default_rng(seed)
    packets = np.ceil(instants / period_s) * period_s
    inside = np.concatenate([[0], np.diff(packets) == 0]).astype(float)
    place = np.arange(len(instants)) - np.maximum.accumulate(
        np.where(inside == 0, np.arange(len(instants)), 0)
    )
    return packets + 1.5e-4 * place + 2e-5 * draw.random(len(instants))


@pytest.mark.parametrize(
    ("stamps", "scatter_ms"),
    [
        (bunched, (3.0, 6.0)),
        (lambda t: np.floor(t / 0.02 + 1e-9) * 0.02, (3.0, 7.0)),
        (lambda t: np.floor(t + 1e-9), (250.0, 320.0)),
        (lambda t: np.floor(t * 10 + 1e-9) / 10, (25.0, 35.0)),
    ],
)
def test_stamps_of_a_host_are_put_on_the_regular_clock(tmp_path, stamps, scatter_ms):
    instants = 5.0 + np.arange(2000) / 100.0
    table = calibrated_times(stamps(instants), tmp_path)
    assert table.starts == (0,)
    np.testing.assert_allclose(np.diff(table.rows.time_s), 0.01, rtol=2e-3)
    note = next(note for note in table.notes if "regular clock" in note)
    assert "of 100 Hz" in note
    assert scatter_ms[0] < float(note.split("scatter by ")[1].split(" ms")[0]) < scatter_ms[1]


def test_lost_samples_and_pauses_are_gaps_of_bunched_stamps(tmp_path):
    instants = np.delete(np.arange(2400) / 100.0, np.r_[700:703, 1500:1897])
    table = calibrated_times(bunched(instants), tmp_path, count=len(instants))
    steps = np.diff(table.rows.time_s)
    assert len(table.starts) == 3
    assert abs(table.starts[1] - 700) < 12
    assert table.starts[2] == 1497
    np.testing.assert_allclose(np.delete(steps, np.array(table.starts[1:]) - 1), 0.01, rtol=5e-3)
    assert steps[table.starts[1] - 1] == pytest.approx(0.04, abs=2e-3)
    assert steps[1496] == pytest.approx(3.98, abs=0.02)


def test_even_and_irregular_stamps_stay_as_they_are(tmp_path):
    draw = np.random.default_rng(5)
    even = np.arange(2000) / 100.0
    for stamps in (
        even,
        even + 1e-3 * draw.random(2000),
        np.cumsum(np.tile([0.007, 0.013], 1000)),
        np.cumsum(0.004 + draw.exponential(0.006, 2000)),
    ):
        table = calibrated_times(stamps, tmp_path)
        np.testing.assert_allclose(table.rows.time_s, stamps, atol=1e-7)


@pytest.mark.parametrize("jump_s", [1.7e9, 200_000.0, -2.0, -0.5, -1.7e9, -3600.0])
def test_a_clock_that_was_set_is_a_gap(tmp_path, jump_s):
    stamps = np.arange(2000) / 100.0
    stamps[800:] += jump_s
    table = calibrated_times(stamps, tmp_path)
    assert table.starts == (0, 800)
    assert np.isnan(table.rows.dt_s[800])
    assert np.all(np.diff(table.rows.time_s) > 0)
    assert table.rows.time_s[-1] - table.rows.time_s[0] <= 86400.0 + 20.0
    assert "the clock was set once, at row 802" in table.notes[0]


def test_an_hour_forward_is_a_gap_as_it_is(tmp_path):
    stamps = np.arange(2000) / 100.0
    stamps[800:] += 3600.0
    table = calibrated_times(stamps, tmp_path)
    assert table.starts == (0, 800)
    np.testing.assert_allclose(table.rows.time_s, stamps, atol=1e-6)


def test_equal_stamps_and_a_clock_that_was_set(tmp_path):
    stamps = np.floor(np.arange(2000) / 2.0) / 50.0
    stamps[1000:] += 1.7e9
    table = calibrated_times(stamps, tmp_path)
    assert table.starts == (0, 1000)
    np.testing.assert_allclose(np.delete(np.diff(table.rows.time_s), 999), 0.01, rtol=1e-3)
    assert [note.split(",")[0] for note in table.notes][:1] == ["the clock was set once"]


def test_rows_out_of_order_and_a_file_appended_to_itself_are_refused(tmp_path):
    stamps = np.arange(2000) / 100.0
    stamps[[900, 901]] = stamps[[901, 900]]
    with pytest.raises(RecordingError, match="row 903, column time_s: time goes back"):
        calibrated_times(stamps, tmp_path)
    cells = {name: values[:300] + values[100:] for name, values in texts(sensor()).items()}
    with pytest.raises(RecordingError, match="row 302 and those behind it repeat row 102"):
        read_table(save(tmp_path / "t.csv", cells))


# -- acceleration ----------------------------------------------------------------------------------


def with_holes(rows: slice) -> dict[str, list[str]]:
    cells = texts(sensor())
    for name in ACCEL:
        for k in range(*rows.indices(COUNT)):
            cells[name][k] = ""
    return cells


@pytest.mark.parametrize("rows", [slice(50, 52), slice(0, 400, 5), slice(0, 7), slice(390, 400),
                                  slice(100, 160)])  # fmt: skip
def test_holes_of_the_acceleration_are_carried_over(tmp_path, rows):
    table = read_table(save(tmp_path / "t.csv", with_holes(rows)))
    true = np.column_stack([sensor()[name] for name in ACCEL])
    assert len(table.rows) == COUNT
    np.testing.assert_allclose(table.rows.accel_b_m_s2, true, atol=0.15)
    assert ": filled from the rows next to it, turned by the gyro" in table.notes[0]


def test_long_gaps_of_the_acceleration_are_left_out(tmp_path):
    columns = sensor(4000)
    cells = texts(columns)
    for name in ACCEL:
        cells[name][1000:1300] = [""] * 300
    table = read_table(save(tmp_path / "t.csv", cells))
    assert (len(table.rows), table.starts) == (3700, (0, 1000))
    assert np.isfinite(table.rows.accel_b_m_s2).all()
    for name in ACCEL:
        cells[name][1000:3300] = ["nan"] * 2300
    table = read_table(save(tmp_path / "t.csv", cells))
    assert len(table.rows) == 4000
    assert np.isnan(table.rows.accel_b_m_s2).all()
    assert "the acceleration was left out: 2300 of 4000 rows have none" in table.notes


@pytest.mark.parametrize(("unit", "factor"), [("g", G), ("mg", 1e-3 * G)])
def test_acceleration_in_g_is_converted_with_a_note(tmp_path, unit, factor):
    columns = sensor()
    for name in ACCEL:
        columns[name] = columns[name] / factor
    table = read_table(save(tmp_path / "t.csv", texts(columns)))
    assert f"the acceleration was in {unit}: taken as m/s^2" in table.notes
    np.testing.assert_allclose(np.linalg.norm(table.rows.accel_b_m_s2, axis=1), G, rtol=1e-6)


def test_one_axis_missing(tmp_path):
    cells = texts(sensor())
    del cells[ACCEL[2]]
    table = read_table(save(tmp_path / "t.csv", cells))
    assert np.isnan(table.rows.accel_b_m_s2).all()
    assert "column accel_z_m_s2 is missing, so the acceleration was left out" in table.notes


# -- Parquet and limits ----------------------------------------------------------------------------


def test_parquet_with_nested_and_other_types(tmp_path):
    columns = sensor()
    body: dict[str, object] = dict(columns)
    body["nested"] = [{"a": [1, 2]}] * COUNT
    body["list"] = [[1.0, 2.0]] * COUNT
    body["text"] = ["x"] * COUNT
    body["flag"] = [True] * COUNT
    body[TIME] = pyarrow.array((columns[TIME] * 1e9).astype("datetime64[ns]"))
    path = tmp_path / "t.parquet"
    pyarrow.parquet.write_table(pyarrow.table(body), path)
    table = read_table(path)
    same(table, columns)
    assert list(table.rows.covariates) == ["flag"]
    assert sorted(note.split()[1] for note in table.notes) == ["list", "nested", "text"]


def test_nested_required_column_is_refused(tmp_path):
    body = {**sensor(), MAG[0]: [[1.0]] * COUNT}
    pyarrow.parquet.write_table(pyarrow.table(body), tmp_path / "t.parquet")
    with pytest.raises(RecordingError, match="column mag_x_gauss holds list"):
        read_table(tmp_path / "t.parquet")


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, ({bytes}, {bytes}))
from ahrsd.__main__ import main
main(sys.argv[1:])
"""


def limited(*arguments: str | Path, gigabytes: float = 3.0) -> subprocess.CompletedProcess[str]:
    """The command line in a process that may not have more memory than so much."""
    program = LIMITED.format(bytes=int(gigabytes * 2**30))
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True, text=True, timeout=600, check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip


def zeros(path: Path, start: bytes = b"") -> Path:
    """A gzip file of some megabytes that unpacks to 640 MB, above the limit of a table."""
    path.write_bytes(gzip.compress(start) + 40 * gzip.compress(bytes(2**24)))
    return path


def refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    shown = done.stdout + done.stderr
    assert done.returncode == 2, shown
    assert len(shown.splitlines()) == 1
    for word in words:
        assert word in shown


@pytest.mark.slow
def test_gzip_bomb_is_refused_in_one_line(tmp_path):
    bomb = zeros(tmp_path / "bomb.csv.gz")
    refused(limited("calibrate", bomb, gigabytes=1.5), "has no line end within its first")
    rows = zeros(tmp_path / "rows.csv.gz", PLAIN.encode())
    refused(limited("calibrate", rows, gigabytes=2.5), "bytes of text and more; the limit is")


def test_a_stream_without_a_message_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr("ahrsd.offline.replay.GARBAGE_BYTES", 2**18)
    (tmp_path / "zeros.vnraw").write_bytes(bytes(2**20))
    with pytest.raises(RecordingError, match=r"no VN-100 message in 2\d{5} bytes"):
        calibrate(tmp_path / "zeros.vnraw", Config())


@pytest.mark.slow
def test_a_bomb_without_a_message_is_given_up(tmp_path):
    bomb = zeros(tmp_path / "bomb.vnraw.gz")
    refused(limited("calibrate", bomb, gigabytes=1.5), "no VN-100 message in 16", "bytes")


@pytest.mark.slow
def test_parquet_bomb_is_refused_in_one_line(tmp_path):
    names = [f"c{k}" for k in range(90)]
    schema = pyarrow.schema([(name, pyarrow.float64()) for name in (*REQUIRED, *names)])
    path = tmp_path / "bomb.parquet"
    with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        column = pyarrow.array(np.zeros(1_000_000))
        for _ in range(2):
            writer.write_table(pyarrow.table([column] * len(schema), schema=schema))
    assert path.stat().st_size < 20e6
    refused(limited("calibrate", path, gigabytes=1.5), "the limit is", "cut it in parts")


@pytest.mark.slow
def test_a_hundred_thousand_columns_end_in_one_line(tmp_path):
    header = ",".join([*REQUIRED, *(f"c{k}" for k in range(100_000))])
    row = ",".join(["0"] * 100_007)
    (tmp_path / "wide.csv").write_text("\n".join([header, *[row] * 30]) + "\n")
    refused(limited("calibrate", tmp_path / "wide.csv"), "has 100,007 columns; the limit is 1,000")


def test_a_span_of_years_is_refused(tmp_path):
    stamps = np.arange(2000) * 1.0
    stamps += np.repeat(np.arange(500) * 80_000.0, 4)
    with pytest.raises(RecordingError, match="s from its first to its last row; the limit is"):
        calibrated_times(stamps, tmp_path)


@pytest.mark.slow
def test_file_name_that_is_not_text_is_handled(tmp_path):
    name = os.fsencode(str(tmp_path)) + b"/\xff\x1b[31mred.csv"
    Path(os.fsdecode(name)).write_text(PLAIN)
    done = subprocess.run(
        [sys.executable, "-m", "ahrsd", "calibrate", name],
        capture_output=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    assert b"\\xff\\x1b[31mred.csv: 400 samples" in done.stdout
    done = subprocess.run(
        [sys.executable, "-m", "ahrsd", "calibrate", name[:-4] + b".xyz"],
        capture_output=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert b"\\xff\\x1b[31mred.xyz: does not exist" in done.stderr


@pytest.mark.parametrize(("hold", "first"), [(10, 0), (5, 3), (2, 1)])
def test_a_slower_magnetometer_leaves_cells_empty(tmp_path, hold, first):
    columns = sensor(4000, 100.0)
    cells = texts(columns)
    for name in MAG:
        for k in range(4000):
            if k % hold != first:
                cells[name][k] = ""
    table = read_table(save(tmp_path / "t.csv", cells))
    assert len(table.rows) == 4000 - first
    assert f"a reading in {4000 // hold} of 4000 rows" in table.notes[0]
    for name, held in zip(MAG, table.rows.raw_b_gauss.T, strict=True):
        np.testing.assert_allclose(held[::hold], columns[name][first::hold], rtol=1e-6, atol=1e-7)
        np.testing.assert_array_equal(held[1::hold], held[: len(held[1::hold]) * hold : hold])


@pytest.mark.parametrize("name", ["calibrate", "replay", "diagnose", "evaluate", "simulate"])
def test_every_command_with_a_recording_accepts_column_names(name):
    command = importlib.import_module(module_of(name)).command
    assert "--columns" in [text for option in command.params for text in option.opts]


@pytest.mark.parametrize("command", ["calibrate", "replay"])
def test_the_command_line_reads_a_foreign_table(tmp_path, capsys, command):
    unit = {"time": 1e-3, "mag": 1e4, "gyro": DEG, "accel": G}
    columns = foreign(unit, ("field.", "rate.", "acc."))
    path = save(tmp_path / "t.csv", {k: [repr(float(x)) for x in v] for k, v in columns.items()})
    given = ["time=stamp:ms", *(f"mag_{a}=field.{a.upper()}:T" for a in "xyz")]
    given += [f"gyro_{a}=rate.{a.upper()}:deg/s" for a in "xyz"]
    with pytest.raises(SystemExit) as end:
        main(
            [command, str(path), "--columns", ",".join(given[:4]), "--columns", ",".join(given[4:])]
        )
    shown = capsys.readouterr().out
    assert end.value.code in (0, 1)
    assert "400 samples" in shown
    assert "it looks like" not in shown


# -- names that other programs write ---------------------------------------------------------------


def renamed(names: dict[str, tuple[str, float]]) -> dict[str, list[str]]:
    """Cells under other names, in other units."""
    columns = sensor()
    return {
        other: [f"{value:.12g}" for value in factor * columns[name]]
        for name, (other, factor) in names.items()
    }


def vectors(names: tuple[str, ...], pattern: str, factor: float = 1.0):
    return {n: (pattern.format(axis), factor) for n, axis in zip(names, "xyz", strict=True)}


def rostopic(mag_factor: float = 1e-4) -> dict[str, list[str]]:
    cells = renamed(
        {
            **vectors(MAG, "field.mag.magnetic_field.{}", mag_factor),
            **vectors(GYRO, "field.imu.angular_velocity.{}"),
            **vectors(ACCEL, "field.imu.linear_acceleration.{}"),
        }
    )
    stamps = [str(1_747_130_000_000_000_000 + round(1e9 * t)) for t in sensor()[TIME]]
    return {"%time": stamps, "field.header.frame_id": ["imu"] * COUNT, **cells}


def test_the_table_of_rostopic_is_read(tmp_path):
    table = read_table(save(tmp_path / "imu.csv", rostopic()))
    columns = sensor()
    np.testing.assert_allclose(table.rows.time_s - table.rows.time_s[0], columns[TIME], atol=1e-6)
    np.testing.assert_allclose(
        table.rows.raw_b_gauss, np.column_stack([columns[name] for name in MAG]), rtol=1e-9
    )
    assert any("those of ROS messages" in note for note in table.notes)


def test_rostopic_field_in_gauss_is_reported_and_read_with_the_option(tmp_path):
    path = save(tmp_path / "imu.csv", rostopic(1.0))
    with pytest.raises(RecordingError, match="it looks like gauss") as refused:
        read_table(path)
    option = str(refused.value).split("--columns ")[1]
    assert option.startswith("mag_x=field.mag.magnetic_field.x:gauss,")
    given = parse_columns([option])
    mag = np.column_stack([sensor()[name] for name in MAG])
    np.testing.assert_allclose(read_table(path, columns=given).rows.raw_b_gauss, mag, rtol=1e-9)


@pytest.mark.parametrize(
    ("time", "mag", "gyro", "accel", "factors"),
    [
        ("Time (s)", "Magnetic field {} (µT)", "Gyroscope {} (rad/s)", "Acceleration {} (m/s^2)",
         (1.0, 100.0, 1.0, 1.0)),
        ("TimeStartup [ns]", "UnCompMag{} [Gauss]", "UnCompGyro{} [rad/s]", "UnCompAcc{} [m/s^2]",
         (1e9, 1.0, 1.0, 1.0)),
        ("Zeit [s]", "mag_{} [nT]", "gyr_{} [mrad/s]", "acc_{} [m/s²]", (1.0, 1e5, 1e3, 1.0)),
        ("timestamp (ms)", "mag_{} (uT)", "gyro_{} (deg/s)", "acc_{} (g)",
         (1e3, 100.0, 180.0 / np.pi, 1 / 9.80665)),
    ],
)  # fmt: skip
def test_units_in_brackets_are_read(tmp_path, time, mag, gyro, accel, factors):
    cells = renamed(
        {
            TIME: (time, factors[0]),
            **vectors(MAG, mag, factors[1]),
            **vectors(GYRO, gyro, factors[2]),
            **vectors(ACCEL, accel, factors[3]),
        }
    )
    same(read_table(save(tmp_path / "phone.csv", cells)), sensor())


def test_ambiguous_columns_are_not_used(tmp_path):
    cells = renamed(
        {
            TIME: ("Time (s)", 1.0),
            **vectors(MAG, "Mag {} (uT)", 100.0),
            **vectors(GYRO, "Gyro {} (rad/s)"),
        }
    )
    cells["Mag filtered x (uT)"] = cells["Mag x (uT)"]
    with pytest.raises(RecordingError, match="has no column mag_x_gauss"):
        read_table(save(tmp_path / "phone.csv", cells))


@pytest.mark.parametrize(
    ("time", "mag", "gyro", "accel", "option"),
    [
        ("time", "m{}", "g{}", "a{}",
         "time=time,mag_x=mx,mag_y=my,mag_z=mz,gyro_x=gx,gyro_y=gy,gyro_z=gz,"
         "accel_x=ax,accel_y=ay,accel_z=az"),
        ("t", "B{}_nT", "w{}_dps", "acc_{}",
         "time=t,mag_x=Bx_nT:nT,mag_y=By_nT:nT,mag_z=Bz_nT:nT,gyro_x=wx_dps:dps,gyro_y=wy_dps:dps,"
         "gyro_z=wz_dps:dps,accel_x=acc_x,accel_y=acc_y,accel_z=acc_z"),
    ],
)  # fmt: skip
def test_suggested_option_contains_short_column_names(tmp_path, time, mag, gyro, accel, option):
    cells = renamed(
        {
            TIME: (time, 1.0),
            **vectors(MAG, mag, 1e5 if "nT" in mag else 1.0),
            **vectors(GYRO, gyro, 180.0 / np.pi if "dps" in gyro else 1.0),
            **vectors(ACCEL, accel),
        }
    )
    path = save(tmp_path / "logger.csv", cells)
    with pytest.raises(RecordingError, match="has no column time_s") as refused:
        read_table(path)
    assert str(refused.value).endswith(f"--columns {option})")
    same(read_table(path, columns=parse_columns([option])), sensor())


@pytest.mark.parametrize("name", ["log.txt", "log.tsv", "log", "log.dat", "log.bin", "log.txt.gz"])
@pytest.mark.parametrize("separator", ["\t", "   ", ","])
@pytest.mark.parametrize("comment", ["", "# "])
def test_rows_of_numbers_are_a_table_whatever_the_file_is_called(
    tmp_path, name, separator, comment
):
    cells = renamed({one: (one, 1.0) for one in (TIME, *MAG, *GYRO, *ACCEL)})
    path = save(tmp_path / "table.csv", cells)
    text = comment + path.read_text(encoding="utf-8").replace(",", separator)
    data = text.encode()
    renamed_path = tmp_path / name
    renamed_path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    opened = open_recording(renamed_path)
    assert opened.table is not None
    same(opened.table, sensor())


@pytest.mark.parametrize(
    "line",
    ["$VNYMR,+010.071,+000.278,-002.026,-01.0670,-00.2568,+03.0696,-00.019,+00.320,-09.802,"
     "-00.002801,-00.001186,-00.001582*65",
     "VNYMR,+010.071,+000.278,-002.026,-01.0670,-00.2568,+03.0696,-00.019,+00.320,-09.802,"
     "-00.002801,-00.001186,-00.001582",
     "1,2,3,4,5,6", "one,two,three,four,five,six,seven,eight"],
)  # fmt: skip
def test_other_lines_are_no_table(line):
    assert not is_table_text(f"{line}\n".encode() * 40)


def test_specific_force_of_zero_counts_as_missing(tmp_path):
    cells = renamed({one: (one, 1.0) for one in (TIME, *MAG, *GYRO, *ACCEL)})
    for name in ACCEL:
        cells[name] = ["0"] * len(cells[name])
    table = read_table(save(tmp_path / "imu.csv", cells))
    assert np.isnan(table.rows.accel_b_m_s2).all()
    assert "the acceleration was left out: it is 0 throughout, not even gravity" in table.notes


def lines_of_a_device(count: int = 400) -> list[bytes]:
    data = ros_files.sensor(count)
    return [
        encode_sentence("VNYMR", [0.0, 0.0, 0.0, *m, *a, *w], None, None, "xor")
        for m, a, w in zip(data["mag"], data["accel"], data["gyro"], strict=True)
    ]


@pytest.mark.parametrize("cell", ['"{line}"', '"{line}\n"', '"{line}\r\n"'])
@pytest.mark.parametrize("more", ["", "imu1_Frame,0.037773,-0.2727,2.653e-05,"])
def test_rows_with_device_lines_are_read_from_these_lines(tmp_path, cell, more):
    """As drivers written by students store them: time, values in some units, and the line."""
    lines = [line.decode().strip() for line in lines_of_a_device()]
    rows = [
        f"{1763590172.75 + k / 20:.6f},{more}{cell.format(line=line)}\n"
        for k, line in enumerate(lines)
    ]
    names = "t,frame_id,gyro_x,gyro_z,mag_x,raw" if more else "ros_t,raw"
    path = tmp_path / "imu.csv"
    path.write_text(names + "\n" + "".join(rows), newline="")
    recording = open_recording(path)
    heard = [one for one in recording.inputs() if isinstance(one, Received) and b"$VN" in one.data]
    assert [one.data.decode().split("$")[1].strip('"\r\n ') for one in heard] == [
        line[1:] for line in lines
    ]
    assert heard[0].host_ns == pytest.approx(1763590172.75e9, abs=1e3)
    assert heard[100].host_ns - heard[0].host_ns == pytest.approx(5e9, abs=1e4)


def test_lines_without_a_field_leave_the_table_a_table(tmp_path):
    rows = foreign_rows(tmp_path).read_text().splitlines()
    path = tmp_path / "ypr.csv"
    line = '"$VNYPR,+010.000,+001.000,+002.000*66"'
    path.write_text("\n".join([rows[0] + ",raw", *(f"{row},{line}" for row in rows[1:])]))
    assert open_recording(path).table is not None


def foreign_rows(folder):
    data = ros_files.sensor(200)
    path = folder / "plain.csv"
    columns = np.column_stack([data["time_s"], data["mag"], data["gyro"]])
    names = "time_s," + ",".join(
        f"{kind}_{axis}_{unit}" for kind, unit in (("mag", "gauss"), ("gyro", "rad_s"))
        for axis in "xyz"
    )  # fmt: skip
    np.savetxt(path, columns, delimiter=",", header=names, comments="", fmt="%.9f")
    return path


def test_quoted_cells_of_several_lines_are_cells(tmp_path):
    rows = foreign_rows(tmp_path).read_text().splitlines()
    path = tmp_path / "notes.csv"
    said = ['"two\nlines"', '"a ""word""\nand more\n"', "plain"]
    more = [f"{row},{said[k % 3]}" for k, row in enumerate(rows[1:])]
    path.write_text("\n".join([rows[0] + ",note", *more]) + "\n")
    np.testing.assert_array_equal(
        open_recording(path).table.rows.raw_b_gauss,
        open_recording(tmp_path / "plain.csv").table.rows.raw_b_gauss,
    )


def test_unclosed_quote_loses_no_rows(tmp_path):
    rows = foreign_rows(tmp_path).read_text().splitlines()
    path = tmp_path / "inches.csv"
    path.write_text("\n".join([rows[0] + ",note", *(f'{row},5" pipe' for row in rows[1:])]) + "\n")
    assert len(open_recording(path).table.rows) == 200


def test_the_table_of_bagpy_is_read(tmp_path):
    data = ros_files.sensor(200)
    names = (
        "Time,header.seq,header.stamp.secs,header.stamp.nsecs,imu.angular_velocity.x,"
        "imu.angular_velocity.y,imu.angular_velocity.z,mag_field.magnetic_field.x,"
        "mag_field.magnetic_field.y,mag_field.magnetic_field.z"
    )
    stamps = 1678937272.7 + data["time_s"]
    zero = np.zeros((200, 3))
    columns = np.column_stack([stamps, zero, data["gyro"], 1e-4 * data["mag"]])
    path = tmp_path / "imu.csv"
    np.savetxt(path, columns, delimiter=",", header=names, comments="", fmt="%.9f")
    rows = open_recording(path).table.rows
    np.testing.assert_allclose(rows.raw_b_gauss, data["mag"], atol=1e-5)
    np.testing.assert_allclose(np.diff(rows.time_s), 0.05, atol=1e-6)
