"""The vehicle's files with a live daemon: none can block it, and a trial ends in time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from patience import PATIENCE_S
from planted_operator import Operator

from ahrsd.daemon.vehicle_files import InterlockFile
from ahrsd.foreign_file import Contents


class HangingDisk:
    """A vehicle that renews its permission at each look, until the disk hangs for ever."""

    def __init__(self) -> None:
        self.hangs = threading.Event()
        self.let_go = threading.Event()
        self._count = 0

    def read(self, _path, _most):
        if self.hangs.is_set():
            self.let_go.wait()
        self._count += 1
        return Contents(b"safe", (1, 1, self._count, 4))


@pytest.fixture
def disk():
    made = HangingDisk()
    yield made
    made.let_go.set()


def test_hanging_reader_ends_the_trial_and_undoes_the_values(live, disk, tmp_path):
    with live({"output": "imu"}, mode="stage") as daemon:
        word = InterlockFile(tmp_path / "safe", 1.0, read=disk.read)
        daemon.files.interlock = word
        daemon.until(word.safe)
        Operator(daemon, "TRIAL", disk.hangs.set)
        daemon.until(lambda: "ROLLED_BACK" in daemon.states, 30.0)
        assert daemon.emulator.memory.ram == daemon.before
        assert "the vehicle says that a write is not safe now" in "\n".join(
            e.reason for e in daemon.events if getattr(e, "new", "") == "ROLLING_BACK"
        )
        daemon.flowing()
        assert daemon.error is None


@pytest.fixture
def program(emulated, tmp_path):
    """Starts `ahrsd run` with an emulated device; yields (process, log) of each start."""
    started = []

    def start(port, tables):
        config, log = tmp_path / "a.toml", tmp_path / "log"
        config.write_text(
            f'mode = "stage"\nstate_directory = "{tmp_path}"\n'
            f'[device]\nbaud = 115200\nport = "{port}"\n{tables}'
        )
        with log.open("ab") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)],
                stdout=file,
                stderr=file,
            )
        started.append(process)
        return process, log

    yield start
    for process in started:
        process.kill()
        process.wait()


def until(process, condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("key", "kind"),
    [
        ("terms", "a folder"),
        ("interlock", "a device"),
        pytest.param(
            "interlock", "a FIFO", marks=pytest.mark.slow
        ),  # short ones: test_hostile_files
        pytest.param("terms", "a FIFO", marks=pytest.mark.slow),
        pytest.param("interlock", "a folder", marks=pytest.mark.slow),
        pytest.param("terms", "a device", marks=pytest.mark.slow),
    ],
)
def test_daemon_continues_reports_the_file_once_and_stops_at_once(
    emulated, program, tmp_path, kind, key
):
    path = tmp_path / "word"
    if kind == "a FIFO":
        os.mkfifo(path)
    elif kind == "a folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    line = f"{key}.file = {path}: is {kind}, not a regular file"
    with emulated(output="imu") as (_, port):
        process, log = program(port, f'[{key}]\nfile = "{path}"\n')
        until(process, lambda: "OBSERVING" in log.read_text() and line in log.read_text())
        (capture,) = (tmp_path / "captures").glob("*.mcap")
        size = capture.stat().st_size
        until(process, lambda: capture.stat().st_size > size + 10_000)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    assert log.read_text().count(line) == 1


@pytest.mark.parametrize("key", ["terms.model", "config"])
def test_start_does_not_block_on_a_fifo(run, tmp_path, capsys, key):
    os.mkfifo(tmp_path / "fifo")
    config = tmp_path / "a.toml"
    config.write_text(f'[device]\nport = "/dev/null"\n[terms]\nmodel = "{tmp_path / "fifo"}"\n')
    path = config if key == "terms.model" else tmp_path / "fifo"
    assert run("run", "--config", path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "fifo: is a FIFO, not a regular file" in line
