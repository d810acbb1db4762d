"""A run under SIGKILL, and on a cluster of three processes; the full form is a benchmark."""

from __future__ import annotations

import signal
import subprocess
import time

import pytest
from fleet_kills import (
    Cluster,
    Fleet,
    Reader,
    rows_of,
    still_running,
    summary,
    tree,
    under_fire,
    write_archive,
)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("killed")
    write_archive(folder / "archive", 8)
    return folder / "archive"


def test_every_recording_has_one_row_whoever_is_killed(archive, tmp_path):
    fleet = Fleet(archive, tmp_path / "out")
    try:
        reader = under_fire(fleet, recordings=8, kills=3, seed=7, least_s=0.2)
    finally:
        fleet.stop()
    found = summary(fleet, reader)
    assert found["rows"] == found["keys"] == found["recordings"] == 8
    assert found["outcomes"] == {"done": 8}
    assert found["left_running"] == found["partial_files"] == found["faults"] == []
    assert found["readings"] > 5
    assert sum(found["kills"].values()) >= 2
    assert {"driver", "process"} <= found["kills"].keys()


def test_an_interrupted_run_says_so_and_leaves_nothing(archive, tmp_path):
    fleet = Fleet(archive, tmp_path / "out")
    fleet.start()
    while fleet.rows() < 1:
        assert fleet.driver.poll() is None
    below = tree(fleet.driver.pid)
    fleet.driver.send_signal(signal.SIGINT)
    assert fleet.driver.wait(timeout=60) == 130
    assert still_running(below) == []
    assert "ahrsd: interrupted" in (tmp_path / "out.log").read_text()
    assert fleet.finish() == 0
    assert len(rows_of(tmp_path / "out")) == 8


def test_on_a_cluster_a_scheduler_and_a_worker_may_die(archive, tmp_path):
    pytest.importorskip("distributed", reason="distributed (the extra cluster) is not installed")
    cluster = Cluster(tmp_path)
    fleet = Fleet(archive, tmp_path / "out", cluster=cluster)
    reader = Reader(tmp_path / "out")
    try:
        reader.start()
        fleet.start()
        for goal, name in ((2, "worker 1"), (4, "scheduler")):
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
        assert found["rows"] == found["keys"] == found["recordings"] == 8
        assert found["outcomes"] == {"done": 8}
        assert found["faults"] == []
    finally:
        fleet.stop()
        cluster.stop()


def test_a_cluster_that_is_not_there_is_one_line(archive, tmp_path):
    pytest.importorskip("distributed", reason="distributed (the extra cluster) is not installed")
    fleet = Fleet(archive, tmp_path / "out")
    done = subprocess.run(
        [*fleet_command(fleet), "--cluster", "tcp://127.0.0.1:9"],
        check=False, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 75
    assert done.stderr.startswith("ahrsd: --cluster tcp://127.0.0.1:9: no scheduler answers")
    assert done.stderr.count("\n") == 1


def fleet_command(fleet: Fleet) -> list[str]:
    from fleet_kills import PYTHON

    return [PYTHON, "-m", "ahrsd", "fleet", "run", str(fleet.archive), "-o", str(fleet.out)]
