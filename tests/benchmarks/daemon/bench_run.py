"""The daemon against an emulated device: lost samples, processor time, memory.

    python tests/benchmarks/daemon/bench_run.py --rate 200 --seconds 600

The daemon is the real command in a process of its own, with its capture; figures of the process
are read from outside. Its start (imports) is left out of the processor time, its end is not.
Samples are counted twice: by the daemon, and in the capture by the device's own time.

Its processor time is compared with that of a peer in the same minutes: a program that opens such a
port, reads and parses, and nothing else. What other programs on the machine cost, both pay.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import serial

from ahrsd.inputs import Received
from ahrsd.recording.capture import CaptureReader
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.emulator.pty import EmulatorProcess
from drivers.vn100.emulator.scenarios import Setup

BAUD = 921600
SETTLE_S = 3.0
LOOK_S = 2.0
FLAT_FROM_S = 120.0


@dataclass(frozen=True)
class Figures:
    """expected: by the device's time; in_capture, taken: what the record and the daemon have.

    rss_mb: at the start, after every minute, and at the end; rss_slope_kb_min: from minute 2 on
    cpu_s, peer_s: processor time of the daemon, and of the peer that only reads and parses
    said:   what the daemon says of messages and gaps
    """

    rate_hz: int
    seconds: float
    expected: int
    in_capture: int
    taken: int
    cpu_s: float
    peer_s: float
    rss_mb: tuple[float, ...]
    rss_slope_kb_min: float
    threads: int
    descriptors: int
    exit_code: int
    stop_s: float
    said: str

    @property
    def cpu_percent(self) -> float:
        """Of one core, of the whole process."""
        return 100.0 * self.cpu_s / self.seconds

    @property
    def peer_ratio(self) -> float:
        """Processor time over that of the peer, in the same seconds."""
        return self.cpu_s / self.peer_s

    @property
    def lost(self) -> int:
        """Samples that are missing in the capture or in the daemon's count."""
        return self.expected - min(self.in_capture, self.taken)

    def __str__(self) -> str:
        return (
            f"{self.rate_hz} Hz, {self.seconds:.0f} s: {self.expected} samples expected, "
            f"{self.in_capture} in the capture, {self.taken} taken, {self.lost} lost\n"
            f"  CPU {self.cpu_percent:.2f} % of one core, {self.peer_ratio:.2f} x reading and "
            f"parsing alone\n"
            f"  RSS by the minute {' '.join(f'{mb:.1f}' for mb in self.rss_mb)} MB, "
            f"slope from minute {FLAT_FROM_S / 60:.0f} on {self.rss_slope_kb_min:+.0f} kB/min\n"
            f"  {self.threads} threads, {self.descriptors} descriptors; exit {self.exit_code} "
            f"{self.stop_s:.2f} s after SIGTERM; {self.said}"
        )


def measure(rate_hz: int, seconds: float, folder: Path, *, verbose: bool = False) -> Figures:
    """Run the daemon for so long and count."""
    setup = Setup("rov", seed=1, output="binary", rate_hz=rate_hz, baud=BAUD)
    with EmulatorProcess(setup, link=folder / "vn100") as emulated, _peer(setup) as peer:
        config = folder / "ahrsd.toml"
        config.write_text(
            f'state_directory = "{folder}"\n[device]\nport = "{emulated.path}"\nbaud = {BAUD}\n'
        )
        command = [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config)]
        log = (folder / "log").open("wb")
        with log, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log) as daemon:
            process = psutil.Process(daemon.pid)
            _wait_for(folder / "log", b"OBSERVING")
            time.sleep(SETTLE_S)
            watched = _watch(process, peer, seconds, verbose)
            asked = time.monotonic()
            daemon.send_signal(signal.SIGTERM)
            said = daemon.communicate()[0].decode()
            stop_s = time.monotonic() - asked
    count = re.search(r": (\d+) samples in", said)
    assert count is not None, said
    taken = int(count[1])
    expected, in_capture = count_in_capture(folder)
    rss, cpu_s, peer_s, lasted_s, threads, descriptors = watched
    late = [(t, size) for t, size in rss if t >= min(FLAT_FROM_S, lasted_s / 2)]
    slope = np.polyfit([t for t, _ in late], [size for _, size in late], 1)[0]
    return Figures(
        rate_hz=rate_hz,
        seconds=lasted_s,
        expected=expected,
        in_capture=in_capture,
        taken=taken,
        cpu_s=cpu_s,
        peer_s=peer_s,
        rss_mb=_by_minute(rss),
        rss_slope_kb_min=float(slope) * 60 / 1e3,
        threads=threads,
        descriptors=descriptors,
        exit_code=daemon.returncode,
        stop_s=stop_s,
        said="; ".join(re.findall(r"^  (messages: .*|\d+ gaps?, .*)$", said, re.MULTILINE)),
    )


def _by_minute(rss: list[tuple[float, int]]) -> tuple[float, ...]:
    """MB at the start, after every minute and at the end."""
    times = [t for t, _ in rss]
    wanted = [*np.arange(0.0, times[-1], 60.0), times[-1]]
    return tuple(rss[int(np.argmin(np.abs(np.subtract(times, t))))][1] / 1e6 for t in wanted)


def _wait_for(log: Path, text: bytes, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while text not in log.read_bytes():
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.05)


@contextlib.contextmanager
def _peer(setup: Setup) -> Iterator[psutil.Process]:
    """A program of its own on a device of its own that reads and parses, and nothing else."""
    with EmulatorProcess(setup) as emulated:
        command = [sys.executable, __file__, "--peer-of", str(emulated.path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"reading\n"
            try:
                yield psutil.Process(process.pid)
            finally:
                process.kill()


def read_and_parse(port: str) -> None:
    """The peer: until it is killed."""
    deframer, said = Deframer(), False
    with serial.Serial(port, BAUD) as line:
        while True:
            for frame in deframer.feed(line.read(max(1, line.in_waiting))):
                if isinstance(decode(frame), Measurement) and not said:
                    print("reading", flush=True)
                    said = True


def _cpu_s(process: psutil.Process) -> float:
    """User and system time so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def _watch(
    process: psutil.Process, peer: psutil.Process, seconds: float, verbose: bool
) -> tuple[list[tuple[float, int]], float, float, float, int, int]:
    """RSS over time, processor time, the peer's, how long, threads, descriptors."""
    began, before, peer_before = time.monotonic(), _cpu_s(process), _cpu_s(peer)
    rss = [(0.0, process.memory_info().rss)]
    while (at := time.monotonic() - began) < seconds:
        time.sleep(min(LOOK_S, seconds - at))
        rss.append((time.monotonic() - began, process.memory_info().rss))
        if verbose and len(rss) % 15 == 0:
            at, size = rss[-1]
            used = _cpu_s(process) - before
            print(f"{at:6.0f} s  CPU {100 * used / at:5.2f} %  RSS {size / 1e6:.1f} MB", flush=True)
    cpu_s, peer_s = _cpu_s(process) - before, _cpu_s(peer) - peer_before
    return rss, cpu_s, peer_s, time.monotonic() - began, process.num_threads(), process.num_fds()


def count_in_capture(folder: Path) -> tuple[int, int]:
    """Samples by the device's time, and samples found."""
    (path,) = sorted((folder / "captures").glob("*.mcap"))
    chunks = [item.data for item in CaptureReader(path) if isinstance(item, Received)]
    deframer, times = Deframer(), []
    for chunk in chunks:
        for frame in deframer.feed(chunk):
            event = decode(frame)
            if isinstance(event, Measurement):
                times.append(event.values[0])
    step_s = float(np.median(np.diff(times)))
    expected = round((times[-1] - times[0]) / step_s) + 1
    return expected, len(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--peer-of", metavar="PORT", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peer_of is not None:
        read_and_parse(arguments.peer_of)
    with tempfile.TemporaryDirectory() as folder:
        print(measure(arguments.rate, arguments.seconds, Path(folder), verbose=True))


if __name__ == "__main__":
    main()
