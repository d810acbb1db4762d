"""Tables: values, gaps, and one line for each way in which a table can be wrong."""

from __future__ import annotations

import gzip
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from ahrsd.errors import RecordingError
from ahrsd.recording.table import MINIMUM_ROWS, read_table

NAMES = [
    "time_s",
    *(f"mag_{axis}_gauss" for axis in "xyz"),
    *(f"gyro_{axis}_rad_s" for axis in "xyz"),
    *(f"accel_{axis}_m_s2" for axis in "xyz"),
    "temperature_c",
    "label",
]
ROWS = 50


def columns() -> dict[str, list[str]]:
    """A good table as text, column by column."""
    values = {
        name: [f"{0.01 * (row + 1) * (column + 1):.4f}" for row in range(ROWS)]
        for column, name in enumerate(NAMES)
    }
    values["time_s"] = [f"{0.02 * k:.3f}" for k in range(ROWS)]
    values["label"] = ["walk"] * ROWS
    return values


def save(path: Path, values: dict[str, list[str]], separator: str = ",") -> Path:
    lines = [separator.join(values), *(separator.join(row) for row in zip(*values.values()))]
    text = "\n".join(lines) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz", "t.parquet"])
def test_values_units_and_covariates(tmp_path, name):
    values = columns()
    if name.endswith("parquet"):
        typed = {k: v if k == "label" else [float(x) for x in v] for k, v in values.items()}
        pyarrow.parquet.write_table(pyarrow.table(typed), tmp_path / name)
    else:
        save(tmp_path / name, values)
    table = read_table(tmp_path / name)
    rows = table.rows
    assert len(rows) == ROWS
    np.testing.assert_allclose(rows.time_s, 0.02 * np.arange(ROWS))
    np.testing.assert_allclose(rows.raw_b_gauss[4], [0.10, 0.15, 0.20])
    np.testing.assert_allclose(rows.gyro_b_rad_s[4], [0.25, 0.30, 0.35])
    np.testing.assert_allclose(rows.accel_b_m_s2[4], [0.40, 0.45, 0.50])
    assert list(rows.covariates) == ["temperature_c"]
    np.testing.assert_allclose(rows.covariates["temperature_c"][4], 0.55)
    assert table.notes == ("column label is text and was left out",)
    assert np.isnan(rows.dt_s[0])
    np.testing.assert_allclose(rows.dt_s[1:], 0.02)


def test_blocks_hold_every_row_once_and_never_span_a_gap(tmp_path):
    values = columns()
    values["time_s"] = [f"{0.02 * k + (5.0 if k >= 30 else 0.0):.3f}" for k in range(ROWS)]
    table = read_table(save(tmp_path / "t.csv", values))
    blocks = list(table.blocks(16))
    assert [len(block) for block in blocks] == [16, 14, 16, 4]
    assert [block.gap_before for block in blocks] == [True, False, True, False]
    assert np.isnan(blocks[2].dt_s[0])
    assert np.isnan(np.concatenate([block.dt_s for block in blocks])).sum() == 2
    np.testing.assert_array_equal(
        np.concatenate([block.raw_b_gauss for block in blocks]), table.rows.raw_b_gauss
    )
    np.testing.assert_array_equal(
        np.concatenate([block.covariates["temperature_c"] for block in blocks]),
        table.rows.covariates["temperature_c"],
    )


def test_two_alternating_steps_are_no_gaps_and_one_lost_sample_is(tmp_path):
    steps = np.tile([0.026, 0.044], ROWS // 2)
    steps[20] = 0.1
    values = columns()
    values["time_s"] = [f"{t:.4f}" for t in np.cumsum(steps)]
    assert read_table(save(tmp_path / "t.csv", values)).starts == (0, 20)


def test_a_rate_over_missing_rows_is_the_mean_of_the_step(tmp_path):
    """A rate that grows evenly: the mean is that of the rows that were there."""
    values, whole = columns(), 0.01 * 6 * (np.arange(ROWS) + 1)
    missing = np.zeros(ROWS, bool)
    missing[4:40:5] = missing[21] = True
    kept = np.flatnonzero(~missing)
    some = {name: [column[k] for k in kept] for name, column in values.items()}
    table = read_table(save(tmp_path / "t.csv", some))
    assert table.starts == (0,)
    means = [whole[a + 1 : b + 1].mean() for a, b in pairwise(kept.tolist())]
    np.testing.assert_allclose(table.rows.gyro_b_rad_s[1:, 1], means, atol=1e-12)
    np.testing.assert_allclose(table.rows.raw_b_gauss[:, 0], 0.02 * (kept + 1))


def test_without_acceleration_it_is_nan_and_covariates_may_have_holes(tmp_path):
    values = columns()
    del values["accel_y_m_s2"]
    values["temperature_c"][7] = ""
    table = read_table(save(tmp_path / "t.csv", values))
    assert np.isnan(table.rows.accel_b_m_s2).all()
    assert table.rows.accel_b_m_s2.shape == (ROWS, 3)
    assert np.flatnonzero(np.isnan(table.rows.covariates["temperature_c"])).tolist() == [7]
    assert "column accel_y_m_s2 is missing" in table.notes[1]


def cell(name: str, row: int, text: str):
    def change(values: dict[str, list[str]]) -> None:
        values[name][row] = text

    return change


def scaled(names: list[str], factor: float):
    def change(values: dict[str, list[str]]) -> None:
        for name in names:
            values[name] = [repr(float(text) * factor) for text in values[name]]

    return change


def dropped(*names: str):
    def change(values: dict[str, list[str]]) -> None:
        for name in names:
            del values[name]

    return change


def shortened(rows: int):
    def change(values: dict[str, list[str]]) -> None:
        for name in values:
            values[name] = values[name][:rows]

    return change


def doubled(*rows: int):
    def change(values: dict[str, list[str]]) -> None:
        for cells in values.values():
            for row in sorted(rows, reverse=True):
                cells.insert(row, cells[row])

    return change


def test_duplicate_rows_are_left_out_with_a_note(tmp_path):
    values = columns()
    doubled(7, 7, 30)(values)
    table = read_table(save(tmp_path / "t.csv", values))
    np.testing.assert_allclose(table.rows.time_s, 0.02 * np.arange(ROWS))
    np.testing.assert_allclose(table.rows.covariates["temperature_c"], 0.11 * np.arange(1, 51))
    assert "left out as repeated, time and all: 3 rows, first row 10" in table.notes


def test_a_row_after_doubled_ones_is_named_by_its_number_in_the_file(tmp_path):
    values = columns()
    cell("time_s", 9, "0.100")(values)
    doubled(3)(values)
    with pytest.raises(RecordingError, match="row 12, column time_s: time goes back"):
        read_table(save(tmp_path / "t.csv", values))


def test_one_row_written_many_times_is_too_short(tmp_path):
    values = {name: [cells[0]] * ROWS for name, cells in columns().items()}
    with pytest.raises(RecordingError, match="has 1 row"):
        read_table(save(tmp_path / "t.csv", values))


def renamed(old: str, new: str):
    def change(values: dict[str, list[str]]) -> None:
        values[new] = values.pop(old)

    return change


MAG, GYRO = NAMES[1:4], NAMES[4:7]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (cell("time_s", 9, "0.100"), "row 11, column time_s: time goes back (0.16 to 0.1 s"),
        (cell("mag_y_gauss", 3, ""), "row 5, column mag_y_gauss: empty, nan or infinite (1 row"),
        (cell("gyro_x_rad_s", 3, "nan"), "row 5, column gyro_x_rad_s: empty, nan"),
        (cell("gyro_z_rad_s", 48, "inf"), "row 50, column gyro_z_rad_s: empty, nan or infinite"),
        (cell("mag_z_gauss", 3, "0.1x"), "row 5, column mag_z_gauss: '0.1x' is no number"),
        (cell("time_s", 0, "2022-11-03"), "row 2, column time_s: '2022-11-03' is no number"),
        (dropped("mag_x_gauss", "mag_z_gauss"), "has no column mag_x_gauss, mag_z_gauss; a table"),
        (renamed("mag_x_gauss", "mag_x_mG"), "(is mag_x_mG meant? --columns mag_x=mag_x_mG:mG)"),
        (shortened(0), "has 0 rows"),
        (shortened(MINIMUM_ROWS - 1), f"has {MINIMUM_ROWS - 1} rows, {MINIMUM_ROWS} are needed"),
        (scaled(MAG, 1e3), "looks like mG; convert it to gauss"),
        (scaled(MAG, 1e2), "looks like uT"),
        (scaled(MAG, 1e5), "looks like nT"),
        (scaled(MAG, 1e-4), "looks like T; convert it to gauss, or say so: --columns mag_x=mag_x_"),
        (scaled(MAG, 1e-6), "another unit or a dead sensor"),
        (scaled(MAG, 0.0), "another unit or a dead sensor"),
        (scaled(GYRO, 57.3), "looks like deg/s; convert it to rad/s"),
        (scaled(["time_s"], 1e3), "20 s from row to row is no sensor's rate; give the time in s"),
        (scaled(["time_s"], 1e3), "if it is in ms: --columns time=NAME:ms"),
        (scaled(["time_s"], 1e9), "is no sensor's rate"),
        (scaled(["time_s"], 1e9), "if it is in ns: --columns time=NAME:ns"),
        (scaled(["time_s"], 1e-3), "2e-05 s from row to row"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(tmp_path, change, words):
    values = columns()
    change(values)
    with pytest.raises(RecordingError) as caught:
        read_table(save(tmp_path / "t.csv", values))
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "t.csv"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("t.csv", b"", "is empty"),
        ("t.csv", b"\n\n", "is no CSV table"),
        ("t.csv", b"time_s,mag_x_gauss\n1,2\n3\n", "has no column mag_y_gauss"),
        ("t.csv", b"\xff\xfe\x00\x80\n\x81\x82\n", "has no column"),
        ("t.csv", b"time_s,time_s\n1,2\n", "has the column time_s twice"),
        ("t.parquet", b"PAR1 no", "is no Parquet table"),
        (
            "t.csv.gz",
            gzip.compress(b"time_s,mag_x_gauss\n1,2\n" * 99, mtime=0)[:30],
            "has no column mag_y_gauss",
        ),
    ],
)
def test_file_that_is_no_table_is_refused_in_one_line(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read_table(tmp_path / name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_blanks_around_column_names_are_ignored(tmp_path):
    path = save(tmp_path / "t.csv", columns())
    head, *rest = path.read_text().splitlines()
    path.write_text("\n".join([head.replace(",", ", "), *rest]) + "\n")
    assert len(read_table(path).rows) > 0


@pytest.mark.slow
def test_every_real_table_loads(recordings):
    paths = [
        path
        for path in sorted(recordings.glob("**/*.csv.gz"))
        if not path.name.endswith((".gps.csv.gz", ".vnraw_lines.csv.gz"))
    ]
    assert len(paths) >= 20
    rows = {path.name: read_table(path) for path in paths}
    assert all(len(table.rows) == sum(map(len, table.blocks())) for table in rows.values())
    square = rows["walk_square_2024_sazgar.csv.gz"]
    assert len(square.rows) == 5466
    assert len(rows["F00379.csv.gz"].starts) == 31
    assert list(rows["log171_MAG2_10hz.csv.gz"].rows.covariates)[-3:] == [
        "motor_current_a",
        "battery_v",
        "throttle",
    ]


def test_a_real_table_of_positions_is_refused(recordings):
    with pytest.raises(RecordingError, match="has no column time_s, mag_x_gauss"):
        read_table(recordings / "vn100" / "drive_2022_rahul.gps.csv.gz")
