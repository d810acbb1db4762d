"""A fleet's run under SIGKILL: recordings, a driver started again, who is killed, what holds.

Used by the short test and by the full one (tests/benchmarks/fleet/fleet_kill.py).
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pyarrow.parquet
from free_port import free_port

from ahrsd.fleet.store import Store
from ahrsd.offline.simulate import write_experiment
from ahrsd.simulation import ScenarioSettings, simulate

GRACE_S = 10.0  # after a death, in which all that belonged to it has to end
PYTHON = sys.executable
ENVIRONMENT = {
    **os.environ,
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONUNBUFFERED": "1",
    "PYTHONPATH": str(Path(__file__).parent),  # a process of a quick run finds its task
    # how long Dask looks for a scheduler that is gone: 30 s as it comes
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s",
}
QUICK = Path(__file__).with_name("quick_fleet.py")


def write_archive(folder: Path, recordings: int, *, seconds: float = 24.0, first: int = 0) -> None:
    """Recordings of three vehicles, all different, named by when they were made."""
    for number in range(first, first + recordings):
        own = folder / f"rov{number % 3}"
        own.mkdir(parents=True, exist_ok=True)
        settings = ScenarioSettings(scenario="wam", seed=number, samples=round(25 * seconds))
        write_experiment(
            own / f"dive_202607{1 + number % 28:02d}_{number}.parquet", simulate(settings)
        )


@dataclass
class Cluster:
    """A Dask scheduler and two workers, each a process; whoever was killed is started again."""

    folder: Path
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    port: int = 0

    def __post_init__(self) -> None:
        self.port = free_port()
        self.start()

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Whatever of the three does not run, until all are there: a worker whose scheduler died
        ends by itself some seconds later."""
        from distributed import Client

        until = time.monotonic() + 120
        while True:
            self._start_missing()
            try:
                with Client(self.address, timeout=10, set_as_default=False) as client:
                    client.wait_for_workers(2, timeout=5)
                    return
            except OSError:  # no scheduler, or too few workers
                if time.monotonic() > until:
                    raise

    def _start_missing(self) -> None:
        commands = {
            "scheduler": ["scheduler", "--host", "127.0.0.1", "--port", str(self.port)],
            **{
                f"worker {n}": ["worker", self.address, "--no-nanny", "--nthreads", "1",
                                "--local-directory", str(self.folder / f"w{n}")]
                for n in (1, 2)
            },
        }  # fmt: skip
        for name, words in commands.items():
            if name not in self.processes or self.processes[name].poll() is not None:
                with (self.folder / f"{name.replace(' ', '')}.log").open("ab") as log:
                    self.processes[name] = subprocess.Popen(
                        [PYTHON, "-m", "dask", *words, "--no-dashboard"],
                        stdout=log, stderr=log, env=ENVIRONMENT,
                    )  # fmt: skip

    def stop(self) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()


@dataclass
class Fleet:
    """A run that is killed and started again.

    quick: its recordings are those of `quick_fleet`
    """

    archive: Path
    out: Path
    jobs: int = 2
    quick: bool = False
    cluster: Cluster | None = None
    driver: subprocess.Popen[bytes] | None = None
    kills: Counter[str] = field(default_factory=Counter)
    starts: int = 0
    left_running: list[str] = field(default_factory=list)

    def start(self, *options: str) -> None:
        """The driver, as a person would start it."""
        place = (
            ["--jobs", str(self.jobs)]
            if self.cluster is None
            else ["--cluster", self.cluster.address]
        )
        # a person's shell lets Ctrl-C through; whoever runs the tests may ignore it
        inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with self.out.with_suffix(".log").open("ab") as log:
                self.driver = subprocess.Popen(
                    [*self.command, *place, *options], stdout=log, stderr=log, env=ENVIRONMENT
                )
        finally:
            signal.signal(signal.SIGINT, inherited)
        self.starts += 1

    @property
    def command(self) -> list[str]:
        program = [str(QUICK)] if self.quick else ["-m", "ahrsd"]
        return [PYTHON, *program, "fleet", "run", str(self.archive), "-o", str(self.out)]

    def rows(self) -> int:
        """FleetRows that are there now."""
        return len(keys_of(self.out)) if (self.out / "parts.json").exists() else 0

    def kill_one(self, rng: random.Random) -> None:
        """SIGKILL anything of the run, and look what its death leaves."""
        assert self.driver is not None
        victims = [("driver", psutil.Process(self.driver.pid))]
        victims += [("process", p) for p in tree(self.driver.pid)]
        if self.cluster is not None:
            for name, process in self.cluster.processes.items():
                victims.append((name.split()[0], psutil.Process(process.pid)))
                victims += [("guarded process", p) for p in tree(process.pid)]
        kind, victim = rng.choice(victims)
        below = tree(victim.pid)
        self.kills[kind] += 1
        try:
            victim.send_signal(signal.SIGKILL)
        except psutil.NoSuchProcess:
            return
        still_running([victim])
        if kind in ("driver", "worker"):
            self.left_running += still_running(below)
        if kind in ("driver", "scheduler"):
            self.driver.wait(timeout=120)
        if self.cluster is not None:
            self.cluster.start()

    def stop(self) -> None:
        """Whatever of it still runs."""
        if self.driver is not None and self.driver.poll() is None:
            self.driver.kill()
            self.driver.wait()

    def finish(self, *options: str, timeout_s: float = 600.0) -> int:
        """Run to the end; the exit code."""
        if self.driver is not None and self.driver.poll() is None:
            self.driver.wait(timeout=timeout_s)
        self.start(*options)
        assert self.driver is not None
        return self.driver.wait(timeout=timeout_s)


def tree(process: int) -> list[psutil.Process]:
    try:
        return psutil.Process(process).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def still_running(processes: list[psutil.Process]) -> list[str]:
    """What of them runs after the grace; whoever is dead and not reaped does not."""
    until = time.monotonic() + GRACE_S
    while (alive := [text for one in processes if (text := running(one))]) and (
        time.monotonic() < until
    ):
        time.sleep(0.02)
    return alive


def running(process: psutil.Process) -> str:
    """Its number and command line; empty where it has ended."""
    try:
        if process.status() == psutil.STATUS_ZOMBIE:
            return ""
        return f"{process.pid} {' '.join(process.cmdline())[:80]}"
    except psutil.NoSuchProcess:
        return ""


def keys_of(out: Path) -> list[str]:
    """Keys of all rows as any reader sees them: the spool, then the parts that count.

    ValueError, or Arrow's error, where a file that counts is not whole.
    """
    store = Store(out)
    spooled = [row["key"] for row in store.spooled()]
    found: list[str] = []
    for part in store.parts():
        try:
            found += pyarrow.parquet.read_table(part, columns=["key"], partitioning=None)[
                "key"
            ].to_pylist()
        except FileNotFoundError:  # it was replaced between list and file: the next list has it
            return keys_of(out)
    assert len(found) == len(set(found)), "a key is in two parts"
    return sorted({*spooled, *found})


class Reader(threading.Thread):
    """Reads all rows over and over; what it could not read is kept."""

    def __init__(self, out: Path) -> None:
        super().__init__(daemon=True)
        self.out, self.readings, self.faults = out, 0, []
        self._closing = threading.Event()

    def run(self) -> None:
        fewest = 0
        while not self._closing.wait(0.2):
            if not (self.out / "parts.json").exists():
                continue
            try:
                count = len(keys_of(self.out))
                if count < fewest:
                    self.faults.append(f"{fewest} rows, then {count}")
                fewest = max(fewest, count)
            except (ValueError, OSError, AssertionError) as error:
                self.faults.append(f"{type(error).__name__}: {error}")
            self.readings += 1

    def close(self) -> None:
        self._closing.set()
        self.join()


def partial_files(out: Path) -> list[str]:
    """Files that a killed process left half written and that are still there."""
    return [str(path) for path in out.rglob(".*") if path.is_file()]


def rows_of(out: Path) -> list[dict[str, object]]:
    """All rows of a finished run."""
    tables = [pyarrow.parquet.read_table(p, partitioning=None) for p in Store(out).parts()]
    assert not list((out / "spool").glob("*.json"))
    return [row for table in tables for row in table.to_pylist()]


def under_fire(
    fleet: Fleet,
    recordings: int,
    kills: int,
    seed: int,
    least_s: float,
    opens: Path | None = None,
) -> Reader:
    """Kill so often while it runs, start it again each time, and let it end; who read meanwhile.

    opens: the file without which it cannot end (`quick_fleet`), made after the last kill
    """
    rng = random.Random(seed)
    reader = Reader(fleet.out)
    reader.start()
    fleet.start()
    for number in range(kills):
        goal = (number + 1) * recordings // (kills + 2)
        until = time.monotonic() + 300
        while fleet.rows() < goal and time.monotonic() < until:
            if fleet.driver.poll() is not None:
                fleet.start()
            time.sleep(0.1)
        time.sleep(least_s + rng.random())
        if fleet.driver.poll() is None:
            fleet.kill_one(rng)
        if fleet.driver.poll() is not None:
            fleet.start()
    if opens is not None:
        opens.touch()
    code = fleet.finish()
    assert code == 0, fleet.out.with_suffix(".log").read_text()[-2000:]
    reader.close()
    return reader


def summary(fleet: Fleet, reader: Reader) -> dict[str, object]:
    """What is to be judged."""
    rows = rows_of(fleet.out)
    keys = Counter(row["key"] for row in rows)
    return {
        "rows": len(rows),
        "keys": len(keys),
        "twice": sum(number > 1 for number in keys.values()),
        "recordings": len({row["recording"] for row in rows}),
        "outcomes": dict(Counter(row["outcome"] for row in rows)),
        "kills": dict(fleet.kills),
        "starts": fleet.starts,
        "left_running": fleet.left_running,
        "partial_files": partial_files(fleet.out),
        "readings": reader.readings,
        "faults": reader.faults,
    }


def printed(body: dict[str, object]) -> str:
    return json.dumps(body, indent=1)
