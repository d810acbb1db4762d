"""Device-days in hours: what grows, and whether an update takes longer the longer it runs.

    python tests/benchmarks/daemon/bench_soak.py
        --days 7 --out docs/validation/soak   # an hour or two
    python tests/benchmarks/daemon/bench_soak.py --days 7 --wall 15 --out DIR    # as far as it gets

The daemon's shell and core, with capture, journal and log, on the byte stream of an emulated
device, as fast as one core goes. `--loop` minutes of the stream are emulated once and then played
over and over, with the device's time going on (and the CRC made anew), so what is measured is the
daemon. Between two rounds the device is unplugged, every `RESTART_ROUNDS` it restarts, and about
every `DAMAGE_S` a byte is damaged: registers are read again, gaps and restarts are counted.

One row per ten minutes of device time: RSS, the bytes that are live in the C heap (numpy's arrays
are in it) and the blocks that are live in Python's, descriptors, threads, processor time, and the
processor time of the estimator per update. Other programs on the machine make the same work take
half as long again, so a slice of fixed work (`reference_work`) is done every `SLICE_S` of device
time, some 40 ms of it per row, and times are also given in units of it. Writes soak.json, soak.png.
"""

from __future__ import annotations

import argparse
import gc
import json
import logging
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from sys import getallocatedblocks
from typing import Any

import numpy as np
import psutil

from ahrsd import inputs
from ahrsd.config.config import Config, check_config, core_settings
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import DAEMON_KEEPS, JournalKeeper, Shell, journal_in
from ahrsd.daemon.heap import needed_bytes, take_heap
from ahrsd.estimator.online import Estimator
from ahrsd.events import Estimated, Event
from ahrsd.recording.capture import CaptureWriter
from drivers.vn100.emulator.scenarios import Setup, build
from drivers.vn100.messages import crc16

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))
from live_heap import heap_bytes
from reference_work import ReferenceWork

CHUNK_S = 0.25
AWAY_S = 2.0  # unplugged between two rounds
RESTART_ROUNDS = 8
DAMAGE_S = 60.0
SLICE_S = 15.0
ROW_S = 600.0
HOUR_S, DAY_S = 3600.0, 86400.0
SETTLED_S = 4500.0  # the histories, of an hour at most, are full
TIME = slice(6, 14)  # TimeStartup in a packet of the calibration set, ns
_LINES = ",\n"
COLUMNS = (
    "device_s",
    "rss_mb",
    "heap_mb",
    "blocks",
    "descriptors",
    "threads",
    "cpu_s",
    "estimator_s",
    "updates",
    "samples",
    "gaps",
    "reference_s",
    "slices",
)


class Device:
    """The emulated device: some minutes of its stream over and over, and its answers."""

    def __init__(self, setup: Setup, loop_s: float, seed: int = 1) -> None:
        emulator = build(setup)
        end_s = 1.0 + loop_s
        packets = [p for _, p in emulator.deliver(end_s) if p.startswith(b"\xfa")]
        length = len(packets[0])
        table = np.frombuffer(b"".join(p for p in packets if len(p) == length), np.uint8)
        self._packets = table.reshape(-1, length).copy()
        self._times_s = self._packets[:, TIME].copy().view("<u8")[:, 0] * 1e-9
        self._times_s -= self._times_s[0]
        self.loop_s = loop_s
        self._talker, self._talk_s = build(replace(setup, output="ascii", rate_hz=1)), 1.0
        self._dice = np.random.default_rng(seed)
        self._answers: dict[bytes, bytes] = {}

    def answer(self, said: bytes) -> bytes:
        """Its replies; the same question is answered from memory."""
        if said not in self._answers:
            self._talker.receive(said, self._talk_s)
            self._talk_s += 0.05
            lines = self._talker.advance(self._talk_s).splitlines(keepends=True)
            self._answers[said] = b"".join(line for line in lines if not line.startswith(b"$VNYMR"))
        return self._answers[said]

    def round(self, begins_s: float) -> Iterator[tuple[float, bytes]]:
        """Seconds since the round began, and bytes; device time at its start: `begins_s`."""
        edges = np.arange(0.0, self._times_s[-1], CHUNK_S)
        cuts = [*np.searchsorted(self._times_s, edges).tolist(), len(self._times_s)]
        for at_s, a, b in zip(edges.tolist(), cuts[:-1], cuts[1:], strict=True):
            part = self._packets[a:b].copy()
            part[:, TIME] = _as_bytes(self._times_s[a:b] + begins_s)
            for packet in part:
                packet[-2:] = np.frombuffer(crc16(packet[1:-2].tobytes()).to_bytes(2), np.uint8)
            data = bytearray(part.tobytes())
            if self._dice.random() < CHUNK_S / DAMAGE_S:
                data[self._dice.integers(len(data))] ^= 1 << int(self._dice.integers(8))
            yield at_s + CHUNK_S, bytes(data)


def _as_bytes(time_s: np.ndarray) -> np.ndarray:
    return np.round(time_s * 1e9).astype("<u8")[:, None].view(np.uint8)


@dataclass(frozen=True)
class Figures:
    """What was found. rows: COLUMNS, one row per `row_s` of device time; sums since the start."""

    rate_hz: int
    days: float
    wall_s: float
    rows: np.ndarray

    def column(self, name: str) -> np.ndarray:
        """One column."""
        return np.asarray(self.rows[:, COLUMNS.index(name)])

    def slope_per_day(self, name: str, since_s: float = SETTLED_S) -> float:
        """Growth of a column per day of device time; nan where too little is there."""
        t = self.column("device_s")
        late = t > since_s
        if np.count_nonzero(late) < 3:
            return float("nan")
        return float(np.polyfit(t[late] / DAY_S, self.column(name)[late], 1)[0])

    def per_update_ms(self, name: str, from_s: float, to_s: float) -> float:
        """Processor time (`cpu_s` or `estimator_s`) per update in a stretch of device time."""
        t = self.column("device_s")
        a, b = np.searchsorted(t, [from_s, to_s])
        row = self.rows[min(b, len(t) - 1)] - self.rows[a]
        per = "slices" if name == "reference_s" else "updates"
        return float(1e3 * row[COLUMNS.index(name)] / row[COLUMNS.index(per)])

    def last_to_first(self, name: str, stretch_s: float = HOUR_S) -> float:
        """Time per update in the last stretch over that in the first one."""
        end_s = float(self.column("device_s")[-1])
        first = self.per_update_ms(name, 0.0, stretch_s)
        return self.per_update_ms(name, end_s - stretch_s, end_s) / first

    def by_reference(self, name: str, stretch_s: float = HOUR_S) -> float:
        """`last_to_first` in slices of the fixed work: the load of the machine is not in it."""
        return self.last_to_first(name, stretch_s) / self.last_to_first("reference_s", stretch_s)

    def __str__(self) -> str:
        t = self.column("device_s")
        hour, last = min(HOUR_S, float(t[-1])), self.rows[-1].tolist()
        facts = dict(zip(COLUMNS, last, strict=True))
        span = [f"{self.column(n).min():.0f} to {self.column(n).max():.0f}" for n in COLUMNS[4:6]]
        return (
            f"{self.days:.2f} device-days at {self.rate_hz} Hz in {self.wall_s / 60:.1f} minutes "
            f"({t[-1] / self.wall_s:.0f} x real time): {facts['samples']:.0f} samples, "
            f"{facts['updates']:.0f} updates, {facts['gaps']:.0f} gaps\n"
            f"  RSS {self.rows[0][1]:.1f} MB at the start, {facts['rss_mb']:.1f} at the end, "
            f"{self.slope_per_day('rss_mb'):+.3f} MB/day after the first {SETTLED_S / 60:.0f} min\n"
            f"  live in the C heap {facts['heap_mb']:.1f} MB, "
            f"{self.slope_per_day('heap_mb'):+.3f} MB/day; live blocks of Python "
            f"{facts['blocks']:.0f}, {self.slope_per_day('blocks'):+.0f} a day\n"
            f"  descriptors {span[0]}, threads {span[1]}\n"
            f"  estimator {self.per_update_ms('estimator_s', 0.0, hour):.1f} ms per update in the "
            f"first hour, last over first {self.last_to_first('estimator_s', hour):.3f}; "
            f"everything {self.per_update_ms('cpu_s', 0.0, hour):.0f} ms, "
            f"{self.last_to_first('cpu_s', hour):.3f}\n"
            f"  fixed work {self.per_update_ms('reference_s', 0.0, hour):.2f} ms a slice, "
            f"{self.last_to_first('reference_s', hour):.3f}; by it, the estimator "
            f"{self.by_reference('estimator_s', hour):.3f}, everything "
            f"{self.by_reference('cpu_s', hour):.3f}"
        )


@contextmanager
def _estimator_time() -> Iterator[list[float]]:
    """[seconds of processor time that the estimator has taken], while it lasts."""
    spent = [0.0]
    saved = {name: getattr(Estimator, name) for name in ("add", "estimate")}

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: object) -> object:
            before = time.thread_time()
            try:
                return function(*args)
            finally:
                spent[0] += time.thread_time() - before

        return call

    try:
        for name, function in saved.items():
            setattr(Estimator, name, timed(function))
        yield spent
    finally:
        for name, function in saved.items():
            setattr(Estimator, name, function)


class Soak:
    """One run; `run` may be left early by `wall_s`."""

    def __init__(self, device: Device, config: Config, folder: Path) -> None:
        self._device = device
        self._now_s = 0.0
        capture = CaptureWriter(
            folder / "soak.mcap", {}, part_bytes=16_000_000, keep_bytes=64_000_000
        )
        core = Core(replace(core_settings(config), keep=DAEMON_KEEPS))
        keeper = JournalKeeper(journal_in(folder), lambda: int(self._now_s * 1e9))
        self.shell = Shell(core, capture, keeper, None, [self._count])
        self._updates = 0
        self._work, self._reference_s, self._slices = ReferenceWork(), 0.0, 0
        self._process = psutil.Process()

    def _count(self, event: Event) -> None:
        self._updates += isinstance(event, Estimated)

    def run(self, days: float, wall_s: float, row_s: float = ROW_S) -> np.ndarray:
        """Rows of COLUMNS."""
        rows = np.zeros((int(days * DAY_S / row_s) + 2, len(COLUMNS)))  # here, not growing
        began, cpu_s = time.monotonic(), time.process_time()
        count = 0
        with _estimator_time() as spent:
            for _ in self._inputs():
                if self._now_s >= self._slices * SLICE_S:
                    self._reference_s += self._work.timed()
                    self._slices += 1
                if self._now_s < count * row_s:
                    continue
                own_s = time.process_time() - cpu_s - self._reference_s
                rows[count] = self._row(own_s, spent[0])
                count += 1
                if self._now_s >= days * DAY_S or time.monotonic() - began > wall_s:
                    break
        self.shell.capture.close()
        return rows[:count]

    def _row(self, cpu_s: float, estimator_s: float) -> tuple[float, ...]:
        while self.shell.capture.status.queued_bytes:  # what the disk has not got yet is no growth
            time.sleep(0.001)
        gc.collect()
        core = self.shell.core
        return (
            self._now_s,
            self._process.memory_info().rss / 1e6,
            heap_bytes() / 1e6,
            getallocatedblocks(),
            self._process.num_fds(),
            self._process.num_threads(),
            cpu_s,
            estimator_s,
            self._updates,
            core.stream.facts.samples,
            core.stream.all_gaps.count,
            self._reference_s,
            self._slices,
        )

    def _inputs(self) -> Iterator[None]:
        """Round after round, for ever; yields after every chunk."""
        self._feed(inputs.WallClock(0, 1.7e9, "soak", 0.0))
        number, device_s = 0, 10.0
        while True:
            began_s = self._now_s
            self._feed(inputs.LinkOpened(self._ns, "soak", 921600, None))
            for at_s, data in self._device.round(device_s):
                self._now_s = began_s + at_s
                self._feed(inputs.Received(self._ns, data))
                due = self.shell.core.deadline_ns
                if due is not None and due <= self._ns:
                    self._feed(inputs.Tick(self._ns))
                yield
            self._feed(inputs.LinkLost(self._ns, "unplugged"))
            self._now_s += AWAY_S
            number += 1
            device_s += self._now_s - began_s
            if number % RESTART_ROUNDS == 0:
                device_s = 10.0

    @property
    def _ns(self) -> int:
        return int(self._now_s * 1e9)

    def _feed(self, item: inputs.Input) -> None:
        """One input, and what the device answers to what is sent."""
        said = self.shell.feed(item)
        while said:
            said = self.shell.feed(inputs.Received(self._ns, self._device.answer(said)))


def measure(
    folder: Path,
    *,
    days: float,
    rate_hz: int = 40,
    loop_s: float = 1800.0,
    wall_s: float = float("inf"),
    row_s: float = ROW_S,
    estimator: dict[str, object] | None = None,
) -> Figures:
    """Soak for so many days of device time, or as far as `wall_s` lets it."""
    state = {"state_directory": str(folder), "estimator": estimator or {}}
    config = check_config(state, folder / "soak.toml")
    setup = Setup("rov", seed=1, output="binary", rate_hz=rate_hz, baud=921600)
    soak = Soak(Device(setup, loop_s), config, folder)
    took_s = time.monotonic()
    rows = soak.run(days, wall_s, row_s)
    return Figures(rate_hz, float(rows[-1][0]) / DAY_S, time.monotonic() - took_s, rows)


def plot(found: Figures, path: Path) -> None:
    """Memory, time per update, descriptors and threads over device time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 11), layout="constrained")
    memory, speed, ratio, counts = figure.subplots(4, 1, sharex=True)
    hours = found.column("device_s") / HOUR_S
    memory.plot(hours, found.column("rss_mb"), label="resident")
    memory.plot(hours, found.column("heap_mb"), label="live in the C heap")
    title = f"{found.days:.2f} device-days at {found.rate_hz} Hz in {found.wall_s / 60:.0f} minutes"
    memory.set(ylabel="MB", ylim=(0, None), title=title)
    updates = np.maximum(np.diff(found.column("updates")), 1)
    slices = 1e3 * np.diff(found.column("reference_s")) / np.diff(found.column("slices"))
    for name, label in (("cpu_s", "everything"), ("estimator_s", "estimator alone")):
        each = 1e3 * np.diff(found.column(name)) / updates
        speed.plot(hours[1:], each, label=label)
        ratio.plot(hours[1:], each / slices, label=label)
    speed.set(ylabel="processor ms per update", ylim=(0, None))
    ratio.set(ylabel="the same, in slices\nof the fixed work", ylim=(0, None))
    for name in ("descriptors", "threads"):
        counts.plot(hours, found.column(name), label=name)
    counts.set(ylabel="count", ylim=(0, None), xlabel="device time, hours")
    for axes in (memory, speed, ratio, counts):
        axes.legend(loc="lower right")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=90)


def save(found: Figures, folder: Path) -> None:
    """soak.json and soak.png."""
    folder.mkdir(parents=True, exist_ok=True)
    facts = asdict(found) | {
        "columns": COLUMNS,
        "rows": [],
        "rss_mb_per_day": found.slope_per_day("rss_mb"),
        "heap_mb_per_day": found.slope_per_day("heap_mb"),
        "estimator_last_to_first_hour": found.last_to_first("estimator_s"),
        "everything_last_to_first_hour": found.last_to_first("cpu_s"),
        "reference_last_to_first_hour": found.last_to_first("reference_s"),
        "estimator_by_reference": found.by_reference("estimator_s"),
        "everything_by_reference": found.by_reference("cpu_s"),
    }
    rows = [json.dumps([round(value, 3) for value in row]) for row in found.rows.tolist()]
    text = json.dumps(facts, indent=1).replace('"rows": []', f'"rows": [\n{_LINES.join(rows)}\n]')
    (folder / "soak.json").write_text(text + "\n")
    plot(found, folder / "soak.png")


def main() -> None:
    """Run, print, save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--rate", type=int, default=40)
    parser.add_argument("--loop", type=float, default=30.0, help="minutes of emulated stream")
    parser.add_argument("--wall", type=float, default=float("inf"), help="at most so many minutes")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    take_heap(needed_bytes(Config().estimator.parameters()))
    with tempfile.TemporaryDirectory() as folder:
        found = measure(
            Path(folder),
            days=arguments.days,
            rate_hz=arguments.rate,
            loop_s=60.0 * arguments.loop,
            wall_s=60.0 * arguments.wall,
        )
    print(found)
    if arguments.out is not None:
        save(found, arguments.out)


if __name__ == "__main__":
    main()
