"""A run under SIGKILL, and on a cluster of three processes; the full form is a benchmark.

Recordings only take time here (`quick_fleet`); the benchmark calibrates and diagnoses them.
"""

from __future__ import annotations

import signal
import subprocess
import time

import pytest
from fleet_kills import (
    ENVIRONMENT,
    Cluster,
    Fleet,
    Reader,
    rows_of,
    still_running,
    summary,
    tree,
    under_fire,
)
from quick_fleet import write_quick_archive


def test_every_recording_has_one_row_after_kills(tmp_path):
    """The run cannot end before the last kill, because one recording waits for a file."""
    archive = tmp_path / "archive"
    write_quick_archive(archive, 29, milliseconds=100)
    (archive / "rov0" / "held.mcap").write_bytes(bytes(9))
    fleet = Fleet(archive, tmp_path / "out", quick=True)
    try:
        opens = archive / "rov0" / "open"
        reader = under_fire(fleet, recordings=30, kills=3, seed=7, least_s=0.0, opens=opens)
    finally:
        fleet.stop()
    found = summary(fleet, reader)
    assert found["rows"] == found["keys"] == found["recordings"] == 30
    assert found["outcomes"] == {"done": 30}
    assert found["left_running"] == found["partial_files"] == found["faults"] == []
    assert found["readings"] > 5
    assert sum(found["kills"].values()) == 3
    assert {"driver", "process"} <= found["kills"].keys()


@pytest.mark.slow
def test_interrupted_run_reports_it_and_leaves_no_process(tmp_path):
    """The run cannot end before the signal, because two recordings wait for a file."""
    archive = tmp_path / "archive"
    write_quick_archive(archive, 3, milliseconds=10)
    for number in range(2):
        (archive / "rov0" / f"held_{number}.mcap").write_bytes(bytes(10 + number))
    fleet = Fleet(archive, tmp_path / "out", jobs=3, quick=True)
    try:
        fleet.start()
        while fleet.rows() < 1:
            assert fleet.driver.poll() is None
            time.sleep(0.05)
        below = tree(fleet.driver.pid)
        fleet.driver.send_signal(signal.SIGINT)
        assert fleet.driver.wait(timeout=60) == 130
        assert still_running(below) == []
        assert "ahrsd: interrupted" in (tmp_path / "out.log").read_text()
        (archive / "rov0" / "open").touch()
        assert fleet.finish() == 0
    finally:
        fleet.stop()
    assert len(rows_of(tmp_path / "out")) == 5


@pytest.mark.slow
def test_run_recovers_from_a_killed_scheduler_and_worker(tmp_path):
    pytest.importorskip("distributed", reason="distributed (the extra cluster) is not installed")
    write_quick_archive(tmp_path / "archive", 24, milliseconds=500)
    cluster = Cluster(tmp_path)
    fleet = Fleet(tmp_path / "archive", tmp_path / "out", cluster=cluster, quick=True)
    reader = Reader(tmp_path / "out")
    try:
        reader.start()
        fleet.start()
        for goal, name in ((2, "worker 1"), (8, "scheduler")):
            while fleet.rows() < goal and fleet.driver.poll() is None:
                time.sleep(0.1)
            victim = cluster.processes[name]
            below = tree(victim.pid)
            victim.kill()
            victim.wait()
            assert still_running(below) == []
            cluster.start()
        fleet.driver.wait(timeout=120)
        if "gave up" in (tmp_path / "out.log").read_text():
            assert fleet.driver.returncode == 75
        assert fleet.finish() == 0
        reader.close()
        found = summary(fleet, reader)
        assert found["rows"] == found["keys"] == found["recordings"] == 24
        assert found["outcomes"] == {"done": 24}
        assert found["faults"] == []
    finally:
        fleet.stop()
        cluster.stop()


@pytest.mark.slow
def test_missing_cluster_is_a_one_line_error_after_five_seconds(tmp_path):
    pytest.importorskip("distributed", reason="distributed (the extra cluster) is not installed")
    write_quick_archive(tmp_path / "archive", 1, milliseconds=10)
    fleet = Fleet(tmp_path / "archive", tmp_path / "out", quick=True)
    done = subprocess.run(
        [*fleet.command, "--cluster", "tcp://127.0.0.1:9"],
        check=False, capture_output=True, text=True, timeout=120, env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 75
    assert done.stderr.startswith(
        "ahrsd: --cluster tcp://127.0.0.1:9: no scheduler answers within 5 s ("
    )
    assert done.stderr.count("\n") == 1
