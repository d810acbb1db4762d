"""Unusable files are refused with exit code 2 and one line that names file, fault and remedy."""

from __future__ import annotations

import gzip
import io
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from streams import binary_device, content

from ahrsd.inputs import Received, Stop
from ahrsd.recording.capture import CaptureWriter

FOLDER = Path(__file__).parents[2] / "fixtures" / "replays"
STREAM = FOLDER / "tumble_binary_restart.vnbin.gz"
COLUMNS = ["time_s", *(f"mag_{a}_gauss" for a in "xyz"), *(f"gyro_{a}_rad_s" for a in "xyz")]
NMEA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"

Rows = np.ndarray


def table(path: Path, rows: Rows, columns: list[str] = COLUMNS) -> None:
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")


@pytest.fixture
def rows() -> Rows:
    """(100, 7) a good table."""
    draw = np.random.default_rng(1)
    time_s = np.arange(100.0)[:, None] / 40.0
    return np.hstack([time_s, 0.3 + 0.01 * draw.normal(size=(100, 3)), draw.normal(size=(100, 3))])


def changed(rows: Rows, row: int, column: int, value: float) -> Rows:
    rows = rows.copy()
    rows[row, column] = value
    return rows


def refused(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str], path: Path, *words: str
) -> None:
    """Both commands: exit 2, nothing on stdout, one line on stderr with the name and the words."""
    for command in ("replay", "calibrate"):
        assert run(command, path) == 2
        out, error = capsys.readouterr()
        assert out == ""
        (line,) = error.splitlines()
        assert line.startswith(f"ahrsd: {path}: ")
        for word in words:
            assert word in line, line


def test_missing_file_is_refused(run, capsys, tmp_path):
    refused(run, capsys, tmp_path / "a.vnraw", "does not exist; give the path")


def test_folder_is_refused(run, capsys, tmp_path):
    refused(run, capsys, tmp_path, "is a folder; give the path")


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.vnraw", b"", ("is empty (0 bytes); record again",)),
        ("a.vnraw.gz", gzip.compress(b"", mtime=0), ("is empty (0 bytes); record again",)),
        ("a.csv", b"", ("is empty (0 bytes); record again",)),
        ("a.mcap", b"", ("is empty",)),
        ("a.bin", bytes(range(1, 250)) * 20, ("no VN-100 message in 4980 bytes; wrong baud rate",)),
        ("a.log", NMEA * 50, ("no VN-100 message in 3350 bytes", "not a VN-100 stream")),
        ("a.mcap", b"no capture", ("is not a capture of ahrsd; give the file",)),
        ("a.xyz", b"anything", ("no recording by its name nor by its content", ".vnraw")),
    ],
)  # fmt: skip
def test_files_without_a_message_are_refused(run, capsys, tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    refused(run, capsys, tmp_path / name, *words)


def test_truncated_gzip_file_is_refused(run, capsys, tmp_path):
    path = tmp_path / "cut.vnbin.gz"
    path.write_bytes(STREAM.read_bytes()[:40_000])
    assert run("replay", path) == 0
    assert "warning: the gzip file is truncated after" in capsys.readouterr().out


def test_empty_capture_is_refused(run, capsys, tmp_path):
    with CaptureWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write(Stop(1, "end"))
    refused(run, capsys, tmp_path / "a.mcap", "holds nothing that a device sent; record again")


def test_truncated_capture_is_read_up_to_its_end_with_a_note(run, capsys, tmp_path):
    path = tmp_path / "a.mcap"
    device = binary_device(4, {})
    with CaptureWriter(path, {}) as writer:
        for step in range(400):
            writer.write(Received((step + 1) * 50_000_000, device.advance((step + 1) / 20)))
            if step % 40 == 39:
                time.sleep(0.3)  # a chunk is closed
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.7 * len(whole))])
    assert run("replay", path) == 0
    out = capsys.readouterr().out
    samples = int(out.split(": ")[1].split(" samples")[0])
    assert 300 < samples < 700
    assert "warning: a.mcap: " in out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: (r[:, [0, 4, 5, 6]], [COLUMNS[k] for k in (0, 4, 5, 6)]),
         ("has no column mag_x_gauss, mag_y_gauss, mag_z_gauss; a table needs time_s",)),
        (lambda r: (changed(r, 50, 0, 0.1), COLUMNS),
         ("row 52, column time_s: time goes back", "sort by time")),
        (lambda r: (changed(r, 50, 2, np.nan), COLUMNS),
         ("row 52, column mag_y_gauss", "leave such rows out")),
        (lambda r: (r * [1, 1000, 1000, 1000, 1, 1, 1], COLUMNS),
         ("it looks like mG; convert it to gauss",)),
        (lambda r: (r[:7], COLUMNS), ("has 7 rows, 20 are needed; record longer",)),
    ],
    ids=["columns", "time", "nan", "milligauss", "rows"],
)  # fmt: skip
def test_wrong_tables_are_refused(run, capsys, tmp_path, rows, change, words):
    table(tmp_path / "a.csv", *change(rows))
    refused(run, capsys, tmp_path / "a.csv", *words)


def test_cell_that_is_not_a_number_is_reported(run, capsys, tmp_path, rows):
    text = io.StringIO()
    np.savetxt(text, rows, delimiter=",", header=",".join(COLUMNS), comments="", fmt="%.9g")
    lines = text.getvalue().splitlines()
    lines[30] = lines[30].replace(lines[30].split(",")[1], "abc")
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    refused(run, capsys, tmp_path / "a.csv", "row 31, column mag_x_gauss", "is no number")


@pytest.mark.parametrize("option", ["--json", "--rerun"])
def test_unwritable_output_is_reported_first(run, capsys, tmp_path, option):
    assert run("replay", STREAM, option, tmp_path / "no" / "a.out") == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error == f"ahrsd: {tmp_path}/no/a.out: {tmp_path}/no is no folder; make it first\n"
    assert run("replay", STREAM, option, tmp_path) == 2
    assert capsys.readouterr().err == f"ahrsd: {tmp_path}: is a folder; name a file\n"


def test_unwritable_report_is_reported_first(run, capsys, tmp_path):
    assert run("calibrate", STREAM, "--report", tmp_path / "no" / "r.html") == 2
    assert "give a folder; the page is report.html in it" in capsys.readouterr().err


def test_a_full_disk_leaves_no_half_a_file(run, capsys, small_disk):
    filler = small_disk / "filler"
    with filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space left"):
        while True:
            file.write(bytes(4096))
    assert run("replay", STREAM, "--json", small_disk / "s.json") == 2
    assert "cannot be written: No space left on device" in capsys.readouterr().err
    assert [path.name for path in small_disk.iterdir()] == ["filler"]


def test_a_pipe_is_written_and_not_replaced(run, capsys, tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    path = tmp_path / "tiny.vnbin"
    path.write_bytes(content(STREAM)[:2_000])
    try:
        assert run("calibrate", path, "--json", pipe) == 1
        assert b'"schema": "ahrsd.calibration/1"' in os.read(reader, 100_000)
        assert pipe.is_fifo()
    finally:
        os.close(reader)


@pytest.mark.parametrize("rate", ["0", "-5", "nan", "inf"])
def test_invalid_rate_is_refused(run, capsys, rate):
    assert run("replay", FOLDER / "tumble_vnymr_damaged.vnraw.gz", "--rate", rate) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "give --rate in Hz" in line
