"""Unplug and plug in again, many times: what leaks, and how soon samples come back.

    python tests/benchmarks/daemon/bench_replug.py --cycles 1000

Emulated device and daemon are threads of this process, so its figures hold both.
"""

from __future__ import annotations

import argparse
import gc
import logging
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from ahrsd.config.config import check_config
from ahrsd.daemon.core_runner import close_shell, open_shell
from ahrsd.daemon.daemon import Daemon
from ahrsd.daemon.host_clock import HostClock
from ahrsd.events import Event, SamplesSeen
from drivers.vn100.emulator.pty import PtyEmulator
from drivers.vn100.emulator.scenarios import Setup, build

BAUD, RATE_HZ = 921600, 100
WARM_UP = 10  # cycles before the first count
AWAY_S = (0.02, 0.3)
PATIENCE_S = 20.0


@dataclass(frozen=True)
class Figures:
    """After the warm-up and at the end; seconds from plug to the next samples."""

    cycles: int
    back_s: np.ndarray
    descriptors: tuple[int, int]
    threads: tuple[int, int]
    rss_mb: tuple[float, float]
    rss_slope_kb: float

    @property
    def p99_s(self) -> float:
        """99 % of the cycles had samples again by then."""
        return float(np.quantile(self.back_s, 0.99))

    def __str__(self) -> str:
        return (
            f"{self.cycles} cycles: samples again after {np.median(self.back_s):.2f} s (median), "
            f"{self.p99_s:.2f} s (99 %), {self.back_s.max():.2f} s (worst)\n"
            f"  descriptors {self.descriptors[0]} -> {self.descriptors[1]}, threads "
            f"{self.threads[0]} -> {self.threads[1]}, RSS {self.rss_mb[0]:.1f} -> "
            f"{self.rss_mb[1]:.1f} MB, slope of the second half {self.rss_slope_kb:+.2f} kB/cycle"
        )


class Listener:
    """Notices samples that the host got after `since_s`, and when it noticed."""

    def __init__(self) -> None:
        self.since_s = self.at_s = 0.0
        self.came = threading.Event()

    def __call__(self, event: Event) -> None:
        if isinstance(event, SamplesSeen) and event.block.host_s[-1] > self.since_s:
            self.at_s = time.monotonic()
            self.came.set()


def measure(cycles: int, folder: Path, *, verbose: bool = False) -> Figures:
    """Run so many cycles."""
    emulator = build(Setup("rov", seed=1, output="binary", rate_hz=RATE_HZ, baud=BAUD))
    link = folder / "vn100"
    body = {
        "state_directory": str(folder),
        "device": {"port": str(link), "baud": BAUD},
        "estimator": {"epoch_steps": 64, "window_steps": 512},  # full before the first count
    }
    config, clock = check_config(body, "bench"), HostClock()
    shell = open_shell(config, clock, folder / "capture.mcap")
    listener = Listener()
    shell.listeners.append(listener)
    daemon = Daemon(config, shell, link, clock)
    thread = threading.Thread(target=daemon.run, name="daemon")
    process, draw = psutil.Process(), np.random.default_rng(0)
    back_s, rss = [], []
    with PtyEmulator(emulator, link=link):
        thread.start()
        assert listener.came.wait(PATIENCE_S)
        for cycle in range(WARM_UP + cycles):
            if cycle == WARM_UP:
                before = _counts(process)
            back_s.append(_cycle(emulator, link, listener, draw.uniform(*AWAY_S)))
            rss.append(process.memory_info().rss)
            if verbose and cycle % 50 == 49:
                print(f"{cycle + 1:5d}  {max(back_s[-50:]):.2f} s  {_counts(process)}", flush=True)
        after = _counts(process)
        daemon.stop("enough")
        thread.join()
    close_shell(shell)
    half = np.array(rss[len(rss) // 2 :], float)
    return Figures(
        cycles,
        np.array(back_s[WARM_UP:]),
        (before[0], after[0]),
        (before[1], after[1]),
        (before[2], after[2]),
        float(np.polyfit(np.arange(len(half)), half, 1)[0]) / 1e3,
    )


def _cycle(emulator: object, link: Path, listener: Listener, away_s: float) -> float:
    """Unplug, wait, plug in; seconds until samples came that cannot be from before."""
    emulator.plugged = False
    while link.is_symlink():
        time.sleep(0.001)
    time.sleep(away_s)
    emulator.plugged = True
    while not link.is_symlink():
        time.sleep(0.001)
    listener.since_s = time.monotonic()
    listener.came.clear()
    assert listener.came.wait(PATIENCE_S), "no samples after it was plugged in again"
    return listener.at_s - listener.since_s


def _counts(process: psutil.Process) -> tuple[int, int, float]:
    """Descriptors, threads and MB; what is open for a moment only is no leak."""
    gc.collect()
    seen = []
    for _ in range(20):
        seen.append((process.num_fds(), process.num_threads()))
        time.sleep(0.02)
    descriptors, threads = (min(values) for values in zip(*seen, strict=True))
    return descriptors, threads, process.memory_info().rss / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=1000)
    arguments = parser.parse_args()
    logging.getLogger("ahrsd").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        print(measure(arguments.cycles, Path(folder), verbose=True))


if __name__ == "__main__":
    main()
