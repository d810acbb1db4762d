"""Everything around the daemon fails at once: what it costs the samples.

    sudo python tests/benchmarks/writeback/bench_siege.py --rate 200 --seconds 60

The viewer's process is stopped (SIGSTOP), the disk of the capture is full (a small tmpfs, so root
is needed), and eight readers of the socket ask for everything and never read. A ninth reader
measures: samples by the device's time against samples received, and how long it takes from the
bytes of each sample (its `host_s`, which is never later than its arrival) to its record on the
socket.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import psutil

from ahrsd.telemetry.protocol import line_of
from ahrsd.telemetry.unix_socket import DaemonConnection
from drivers.vn100.emulator.pty import EmulatorProcess
from drivers.vn100.emulator.scenarios import Setup

BAUD, READERS = 921600, 8
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Figures:
    """expected: by the device's time; latency in s of each sample; stopped: the viewer's state."""

    rate_hz: int
    seconds: float
    expected: int
    received: int
    latency_s: np.ndarray
    stopped: bool
    disk_full: bool
    said_full: bool
    exit_code: int
    stop_s: float

    @property
    def lost(self) -> int:
        """Samples that the device sent and the reader did not get."""
        return self.expected - self.received

    @property
    def p99_s(self) -> float:
        """99 % of the samples came so soon."""
        return float(np.quantile(self.latency_s, 0.99))

    def __str__(self) -> str:
        ms = 1e3 * np.quantile(self.latency_s, [0.5, 0.99, 1.0])
        return (
            f"{self.rate_hz} Hz, {self.seconds:.0f} s, {READERS} readers that never read, viewer "
            f"stopped {self.stopped}, disk full {self.disk_full} (said: {self.said_full}): "
            f"{self.lost} of {self.expected} samples lost; from byte to socket {ms[0]:.1f} ms "
            f"(median), {ms[1]:.1f} ms (99 %), {ms[2]:.1f} ms (worst); exit {self.exit_code} after "
            f"{self.stop_s:.1f} s"
        )


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A file system of 2 MiB; needs root."""
    disk = folder / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)], check=True)
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def deaf_reader(path: Path) -> socket.socket:
    """A client that asks for everything and never reads."""
    reader = socket.socket(socket.AF_UNIX)
    reader.connect(str(path))
    reader.sendall(line_of({"ask": "watch", "of": ["status", "events", "samples"]}))
    return reader


def fill(disk: Path) -> bool:
    """Fill the disk; whether it is full."""
    with contextlib.suppress(OSError), (disk / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(b"x" * 4096)
    return os.statvfs(disk).f_bavail == 0


def listen(path: Path, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Device times of all samples, and how late each was."""
    times: list[float] = []
    latency: list[float] = []
    with DaemonConnection(path) as asked:
        end = time.monotonic() + seconds
        for record in asked.watch(("samples",)):
            now = time.monotonic()
            if record.get("record") == "samples":
                times += record["time_s"]
                latency += [now - host_s for host_s in record["host_s"]]
            if now > end:
                break
    return np.array(times), np.array(latency)


@contextlib.contextmanager
def running(command: list[str], log: BinaryIO) -> Iterator[subprocess.Popen[bytes]]:
    """The daemon; killed where what is measured breaks off."""
    with subprocess.Popen(command, stdout=log, stderr=log) as daemon:
        try:
            yield daemon
        finally:
            daemon.kill()


def measure(rate_hz: int, seconds: float, folder: Path, disk: Path) -> Figures:
    """One siege."""
    setup = Setup("rov", seed=1, output="binary", rate_hz=rate_hz, baud=BAUD)
    with EmulatorProcess(setup, link=folder / "vn100") as emulated:
        config = folder / "ahrsd.toml"
        config.write_text(
            f'state_directory = "{folder}"\n[device]\nport = "{emulated.path}"\nbaud = {BAUD}\n'
            f'[capture]\ndirectory = "{disk}"\n[rerun]\nfile = "{folder / "live.rrd"}"\n'
            f'[socket]\npath = "{folder / "socket"}"\n'
        )
        command = [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)]
        log = (folder / "log").open("wb")
        with log, running(command, log) as daemon:
            viewer = _viewer_of(daemon.pid, folder / "log")
            viewer.suspend()
            full = fill(disk)
            readers = [deaf_reader(folder / "socket") for _ in range(READERS)]
            time.sleep(3.0)
            times, latency = listen(folder / "socket", seconds)
            stopped = viewer.status() == psutil.STATUS_STOPPED
            asked = time.monotonic()
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(30.0)
            stop_s = time.monotonic() - asked
        for reader in readers:
            reader.close()
    return Figures(
        rate_hz=rate_hz,
        seconds=seconds,
        expected=round((times[-1] - times[0]) * rate_hz) + 1,
        received=len(times),
        latency_s=latency,
        stopped=stopped,
        disk_full=full,
        said_full=b"No space left" in (folder / "log").read_bytes(),
        exit_code=daemon.returncode,
        stop_s=stop_s,
    )


def _viewer_of(pid: int, log: Path) -> psutil.Process:
    """The viewer's process, once the daemon observes and the viewer runs."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        children = psutil.Process(pid).children(recursive=True)
        viewers = [p for p in children if "ahrsd.viewer.process" in p.cmdline()]
        if viewers and b"OBSERVING" in log.read_bytes():
            return viewers[0]
        time.sleep(0.1)
    raise AssertionError(log.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rate", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, small_disk(Path(folder)) as disk:
        print(measure(arguments.rate, arguments.seconds, Path(folder), disk))


if __name__ == "__main__":
    main()
