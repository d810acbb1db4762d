"""A run: one row per recording with the results of the commands, and repeated runs."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import ulog_files as ul
from fleet_kills import write_archive
from fleet_rows import row, store_of
from ros_files import sensor

from ahrsd.cli.recordings.fleet import EXAMINER, LOADS
from ahrsd.config.config import Config
from ahrsd.errors import AhrsdError
from ahrsd.fleet.archive import Archive
from ahrsd.fleet.processes import Place
from ahrsd.fleet.questions import FleetRows
from ahrsd.fleet.run import Orders, Progress, run
from ahrsd.fleet.store import Store
from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.diagnose import diagnose_recording
from ahrsd.offline.simulate import write_experiment
from ahrsd.simulation import ScenarioSettings, simulate

pytest.importorskip("duckdb", reason="duckdb (the extra fleet) is not installed")

PLACE = Place(2, LOADS)
ONE = Place(1, LOADS)  # for a single recording
BARE = Place(1, ())  # for recordings that are refused before any computation


def ran(archive: Path | str, out: Path, place: Place = ONE, **orders: object) -> Progress:
    given = Orders(out=str(out), **orders)  # type: ignore[arg-type]
    return run(Archive(str(archive)), given, EXAMINER, place, lambda _: None)


def rows(out: Path) -> dict[str, dict[str, object]]:
    with FleetRows(Store(out)) as asked:
        found = asked.sql("select * from results").json()
    assert len({one["key"] for one in found}) == len(found)
    return {Path(one["recording"]).name: one for one in found}


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Three recordings of three vehicles, a PX4 log, and files that are none."""
    folder = tmp_path_factory.mktemp("fleet") / "archive"
    write_archive(folder, 3)
    (folder / "rov0" / "empty.mcap").touch()
    (folder / "rov0" / "broken.csv").write_text("a,b\n1,2\n")
    (folder / "rov0" / "cut.parquet").write_bytes(b"PAR1" + bytes(100))
    (folder / "rov0" / "notes.md").write_text("calm sea")
    (folder / "gone.vnraw").symlink_to(folder / "nowhere")
    shutil.copy(folder / "rov1" / "dive_20260702_1.parquet", folder / "rov1" / "copy.parquet")
    return folder


@pytest.fixture(scope="module")
def out(archive):
    done = ran(archive, archive.parent / "out", PLACE)
    assert done.left_out == {".md": 1}
    assert done.done == done.total == 8
    assert done.failed == 4
    return archive.parent / "out"


def test_every_recording_is_one_row_including_failures(archive, out):
    found = rows(out)
    outcomes = {name: one["outcome"] for name, one in found.items()}
    copies = {"dive_20260702_1.parquet", "copy.parquet"} & outcomes.keys()
    assert len(copies) == 1  # the same bytes are one row
    outcomes.pop(copies.pop())
    assert outcomes == {
        "dive_20260701_0.parquet": "done",
        "dive_20260703_2.parquet": "done",
        "empty.mcap": "refused",
        "broken.csv": "refused",
        "cut.parquet": "refused",
        "gone.vnraw": "unreadable",
    }
    assert found["empty.mcap"]["error"] == "calibrate and diagnose: is empty (0 bytes)"
    assert "time_s" in found["broken.csv"]["error"]
    assert "--columns" in found["broken.csv"]["remedy"]
    assert found["gone.vnraw"]["error"] == "No such file or directory"


def test_row_has_the_results_of_the_commands(archive, out):
    path = archive / "rov0" / "dive_20260701_0.parquet"
    found = rows(out)[path.name]
    body = calibrate(path, Config()).json("magyc")
    diagnosis = diagnose_recording(path)
    for axis, value, sigma in zip(
        "xyz", body["hard_iron_gauss"], body["standard_deviation"]["hard_iron_gauss"], strict=True
    ):
        assert found[f"hard_iron_{axis}_gauss"] == pytest.approx(value, rel=1e-6)
        assert found[f"hard_iron_sigma_{axis}_gauss"] == pytest.approx(sigma, rel=1e-6)
    for axis, value in zip("xyz", body["gyro_bias_rad_s"], strict=True):
        assert found[f"gyro_bias_{axis}_rad_s"] == pytest.approx(value, rel=1e-6)
    assert found["heading_sigma_deg"] == pytest.approx(
        body["heading_error_deg"]["expected_worst"], rel=1e-6
    )
    assert found["converged"] is body["converged"]
    assert found["mismatch"] == diagnosis.mismatch
    assert [one["effect"] for one in found["findings"]] == [f.effect for f in diagnosis.findings]
    assert found["samples"] == 600
    assert found["vehicle"] == "rov0"
    assert found["recorded_utc"] == "2026-07-01 00:00:00"
    assert found["recorded_by"] == "its name"
    assert found["recording"] == str(path)
    assert found["seconds"] > 0.0
    assert found["version"] == "0.1.0"


def test_repeated_run_processes_only_new_files(archive, out):
    before = rows(out)
    done = ran(archive, out)
    assert (done.before, dict(done.outcomes)) == (7, {"was there": 1})
    assert rows(out) == before


@pytest.mark.slow
def test_failures_are_repeated_when_requested(archive, out):
    before = rows(out)
    done = ran(archive, out, again=True)
    assert (done.failed, done.done) == (4, 5)
    after = rows(out)
    assert after.keys() == before.keys()
    assert after["empty.mcap"]["finished_utc"] > before["empty.mcap"]["finished_utc"]
    assert after["dive_20260701_0.parquet"] == before["dive_20260701_0.parquet"]


@pytest.mark.slow
def test_repaired_file_has_its_own_row(archive, tmp_path):
    small = tmp_path / "archive"
    small.mkdir()
    (small / "dive.csv").write_text("a,b\n1,2\n")
    assert dict(ran(small, tmp_path / "out", BARE).outcomes) == {"refused": 1}
    (small / "dive.csv").write_text("a,c\n1,2\n")
    assert dict(ran(small, tmp_path / "out", BARE).outcomes) == {"refused": 1}
    with FleetRows(Store(tmp_path / "out")) as asked:
        assert asked.counts()["recordings"] == 2


def test_odd_entries_are_rows_and_the_number_of_a_folder_is_the_serial_number(tmp_path):
    folder = tmp_path / "archive" / "vn100-100130608 (2)"
    folder.mkdir(parents=True)
    os.mkfifo(folder / "pipe.csv")
    (folder / "bag").mkdir()
    (folder / "bag" / "metadata.yaml").touch()
    (folder / "bag" / "bag_0.db3").symlink_to("nowhere")
    (tmp_path / "archive" / "more").symlink_to(folder)
    done = ran(tmp_path / "archive", tmp_path / "out", BARE, levels=("serial",))
    assert (done.linked, done.first_linked) == (1, str(tmp_path / "archive" / "more"))
    found = rows(tmp_path / "out")
    assert {name: (one["outcome"], one["error"]) for name, one in found.items()} == {
        "pipe.csv": ("unreadable", "is a FIFO, not a regular file"),
        "bag": ("unreadable", "No such file or directory"),
    }
    assert {one["serial_number"] for one in found.values()} == {100130608}


@pytest.mark.slow
def test_options_are_in_the_key_and_labels_come_from_folders(archive, tmp_path):
    deep = tmp_path / "archive" / "harbour" / "SN100032"
    deep.mkdir(parents=True)
    shutil.copy(archive / "rov0" / "dive_20260701_0.parquet", deep / "a.parquet")
    given = {"levels": ("place", "serial"), "vehicle": "barge"}
    ran(tmp_path / "archive", tmp_path / "out", **given)
    (found,) = rows(tmp_path / "out").values()
    assert (found["place"], found["serial_number"], found["vehicle"]) == (
        "harbour",
        100032,
        "barge",
    )
    assert (tmp_path / "out" / "parts" / "serial=100032").is_dir()
    assert ran(tmp_path / "archive", tmp_path / "out", **given).done == 0
    assert ran(tmp_path / "archive", tmp_path / "out", rate_hz=25.0, **given).done == 1
    with FleetRows(Store(tmp_path / "out")) as asked:
        every = asked.sql("select options, converged from results").rows
    assert every == [(json.dumps({"rate_hz": 25.0}), found["converged"])]


@pytest.mark.slow
def test_rows_are_the_same_through_fsspec(archive, out, tmp_path):
    pytest.importorskip("fsspec", reason="fsspec (the extra fleet) is not installed")
    small = tmp_path / "archive" / "rov0"
    small.mkdir(parents=True)
    shutil.copy(archive / "rov0" / "dive_20260701_0.parquet", small)
    ran(f"file://{tmp_path}/archive", tmp_path / "out")
    (found,) = rows(tmp_path / "out").values()
    here = rows(out)["dive_20260701_0.parquet"]
    same = ["content_sha256", "key", "vehicle", "outcome", "hard_iron_x_gauss", "recorded_utc"]
    assert [found[name] for name in same] == [here[name] for name in same]
    assert found["recording"].startswith("file://")


@pytest.mark.slow
def test_autopilot_logs_are_recordings(tmp_path):
    pytest.importorskip("pyulog", reason="pyulog (the extra px4) is not installed")
    (tmp_path / "archive").mkdir()
    fast = sensor(3000, 100.0)
    fields = ul.mags(fast["time_s"][::5], fast["mag"][::5])
    rates = ul.combined(fast["time_s"], fast["gyro"], fast["accel"])
    ul.save(tmp_path / "archive" / "flight.ulg", [*fields, *rates], {})
    ran(tmp_path / "archive", tmp_path / "out")
    (found,) = rows(tmp_path / "out").values()
    assert found["outcome"] == "done", found["error"]


def test_run_is_refused_while_another_is_active(archive, tmp_path):
    store = store_of(tmp_path / "out", [row(1)])
    with store.alone(), pytest.raises(AhrsdError, match="another `ahrsd fleet`"):
        ran(archive, tmp_path / "out")


@pytest.mark.slow
def test_warnings_of_a_recording_are_in_its_row_and_not_printed(tmp_path, capfd):
    """The gyro's x axis is negated, which the core reports while reading, and so does the
    verdict.
    """
    made = simulate(ScenarioSettings("wam", "slow", seed=1, samples=3000))
    gyro = made.samples.gyro_b_rad_s * [-1.0, 1.0, 1.0]
    (tmp_path / "archive").mkdir()
    mirrored = replace(made, samples=replace(made.samples, gyro_b_rad_s=gyro))
    write_experiment(tmp_path / "archive" / "a.csv", mirrored)
    ran(tmp_path / "archive", tmp_path / "out")
    (only,) = rows(tmp_path / "out").values()
    assert "the gyro's x y z are the magnetometer's -x y z" in only["verdict"]
    assert capfd.readouterr().err == ""
