"""What a fleet costs beside its recordings: overhead, scaling, the driver's memory, questions.

    python tests/benchmarks/fleet/bench_fleet.py WHAT

    overhead   beside tasks of 2 s that sleep, 2 processes
    scaling    2 processes over 1: sleep, compute, recordings
    memory     peak of a driver of 10^3, 10^4, 10^5 tasks
    ask        questions over 10^6 made-up rows
    threads    CPU of a library caller, 1 BLAS thread or all

Each is the driver that `ahrsd fleet run` is, over an archive of files. What computes needs as many
idle cores as processes: beside it stand the load and what two processes gain with no fleet.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

import numpy as np
import pyarrow
import pyarrow.parquet
from fleet_kills import write_archive
from fleet_rows import computing, nothing, sleeping

from ahrsd.cli.recordings.fleet import EXAMINER, LOADS
from ahrsd.fleet.archive import Archive
from ahrsd.fleet.processes import Place
from ahrsd.fleet.questions import FleetRows
from ahrsd.fleet.run import Orders, run
from ahrsd.fleet.store import SCHEMA, Store

TASK_S = 2.0
DEVICES, DAY_MS = 500, 86_400_000


def ran(archive: Path, out: Path, jobs: int, task=EXAMINER) -> tuple[float, int]:
    """Wall seconds for each task of a process, and how many tasks; the start is left out.

    From the first answer to the last each process does all its tasks but one.
    """
    shutil.rmtree(out, ignore_errors=True)
    begun: list[float] = []

    def told(progress) -> None:
        if progress.done:
            begun.append(time.monotonic())
            del begun[1:-1]

    loads = LOADS if task is EXAMINER else ()
    done = run(Archive(str(archive)), Orders(out=str(out)), task, Place(jobs, loads), told)
    return (begun[-1] - begun[0]) / (done.done / jobs - 1.0), done.done


def simulated(folder: Path, number: int, milliseconds: int) -> Path:
    """An archive of tasks that sleep as long as their file is large."""
    archive = folder / f"archive{number}"
    for i in range(number):
        own = archive / f"rov{i // 1000}"
        own.mkdir(parents=True, exist_ok=True)
        (own / f"{i}.mcap").write_bytes(bytes(milliseconds))
    return archive


def overhead(folder: Path) -> None:
    for milliseconds, number in ((0, 2000), (round(1e3 * TASK_S), 60)):
        archive = simulated(folder / str(milliseconds), number, milliseconds)
        cpu = _cpu()
        each_s, count = ran(archive, folder / "out", 2, sleeping)
        beside_ms = 1e3 * each_s - milliseconds
        print(
            f"tasks of {milliseconds} ms, 2 processes: {beside_ms:.2f} ms beside each "
            f"({beside_ms / TASK_S / 10:.2f} % of one of {TASK_S:g} s), "
            f"{1e3 * (_cpu() - cpu) / count:.2f} ms CPU with starting and compacting; {_load()}"
        )


def scaling(folder: Path) -> None:
    archive = simulated(folder / "simulated", 20, round(1e3 * TASK_S))
    write_archive(folder / "archive", 24, seconds=60.0)
    for name, tasks, task in (
        (f"tasks that sleep {TASK_S:g} s", archive, sleeping),
        (f"tasks of {TASK_S:g} s of CPU", archive, computing),
        ("recordings of 60 s", folder / "archive", EXAMINER),
    ):
        whole = []
        for jobs in (1, 2):
            each_s, _ = ran(tasks, folder / f"out{jobs}", jobs, task)
            whole.append(each_s / jobs)
            print(f"{name}, {jobs} processes: {60 / whole[-1]:.1f} a minute; {_load()}", flush=True)
        print(f"{name}: 2 processes are {whole[0] / whole[1]:.2f} times as fast as one", flush=True)
        if task is not sleeping:
            print(
                f"two processes that only compute, with no fleet: {plain():.2f} times", flush=True
            )


def plain() -> float:
    """How many times as fast as one two processes are here and now, with no fleet round them."""
    burn = "import time\nwhile time.process_time() < 5.0: sum(range(10_000))"
    whole = []
    for jobs in (1, 2):
        begun = time.monotonic()
        running = [subprocess.Popen([sys.executable, "-c", burn]) for _ in range(jobs)]
        for process in running:
            process.wait()
        whole.append((time.monotonic() - begun) / jobs)
    return whole[0] / whole[1]


def memory(folder: Path, most: int, *, kept: bool) -> None:
    """Peak of the driver's resident size; each number of tasks has a driver of its own."""
    for number in (1_000, 10_000, 100_000):
        if number <= most:
            words = [sys.executable, __file__, "driver", str(folder / str(number))]
            simulated(folder / str(number), number, 0)
            subprocess.run(
                [*words, "--most", str(number), *(["--rows"] if kept else [])], check=True
            )


def driver(folder: Path, number: int, *, kept: bool) -> None:
    """One of the drivers of `memory`."""
    archive = folder / f"archive{number}"
    begun = time.monotonic()
    ran(archive, folder / "out", 2, sleeping if kept else nothing)
    wall_s = time.monotonic() - begun
    status = Path("/proc/self/status").read_text()
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    rows = len(Store(folder / "out").known("key", failures=True))
    peak_mb = int(peak.split()[1]) / 1e3
    print(f"{number:,} tasks, {rows:,} rows: peak {peak_mb:.1f} MB, {wall_s:.0f} s", flush=True)


def ask(folder: Path, rows: int) -> None:
    store = made_up(folder / "rows", rows)
    size = sum(part.stat().st_size for part in store.parts()) / 1e6
    print(f"{rows:,} rows, {len(store.parts())} parts, {size:.0f} MB")
    begun = time.monotonic()
    known = store.known("stamp", failures=True)
    print(f"what a resumed run reads: {time.monotonic() - begun:.2f} s, {len(known):,} stamps")
    begun = time.monotonic()
    with FleetRows(store) as asked:
        print(f"opened in {time.monotonic() - begun:.2f} s")
        for question in (asked.drift, asked.recurring, asked.failures, asked.counts):
            for _ in range(3):
                begun, cpu = time.monotonic(), time.process_time()
                question()
                print(
                    f"{question.__name__}: {time.monotonic() - begun:.2f} s, "
                    f"{time.process_time() - cpu:.2f} s CPU"
                )
        stepped = [one for one in asked.drift() if one.iron.changes]
    print(f"devices with a step: {len(stepped)} (one in ten has one)")
    for _ in range(2):
        begun, cpu = time.monotonic(), _cpu()
        subprocess.run(
            [sys.executable, "-m", "ahrsd", "fleet", "ask", str(store.root), "drift"],
            check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        print(
            f"the whole command `ask drift`: {time.monotonic() - begun:.2f} s, "
            f"{_cpu() - cpu:.2f} s CPU; {_load()}"
        )


def made_up(root: Path, rows: int) -> Store:
    """A store of devices of which one in ten steps by 10 mG on each axis half-way."""
    rng = np.random.default_rng(0)
    store = Store(root)
    store.create()
    each = rows // DEVICES
    for device in range(DEVICES):
        at = 20_000 * DAY_MS + np.sort(rng.integers(0, 365 * DAY_MS, each))
        step = 0.01 * (np.arange(each) > each // 2) if device % 10 == 0 else 0.0
        names = [f"{device * each + i:032x}" for i in range(each)]
        found = np.where(rng.random(each) > 0.8, 1, 0)
        finding = {"effect": "motor_current", "probability": 0.9, "frame": "sensor", "words": "w"}
        columns = {
            "key": names, "stamp": names, "version": ["0.1.0"] * each, "options": [""] * each,
            "outcome": ["done"] * each, "serial_number": [100_032_000 + device] * each,
            "vehicle": [f"rov{device % 50}"] * each, "recorded_by": ["its name"] * each,
            "recorded_utc": pyarrow.array(at).cast(pyarrow.timestamp("ms")),
            "temperature_c": rng.normal(15.0, 5.0, each), "converged": rng.random(each) > 0.2,
            "field_gauss": np.full(each, 0.5), "heading_sigma_deg": rng.random(each),
            "findings": [[finding] if one else [] for one in found], "seconds": np.full(each, 2.0),
            **{f"hard_iron_{a}_gauss": rng.normal(0.05, 0.002, each) + step for a in "xyz"},
            **{f"hard_iron_sigma_{a}_gauss": np.full(each, 1e-4) for a in "xyz"},
            **{f"gyro_bias_{a}_rad_s": rng.normal(0.0, 1e-3, each) for a in "xyz"},
            **{f"gyro_bias_sigma_{a}_rad_s": np.full(each, 1e-4) for a in "xyz"},
        }  # fmt: skip
        empty = {one.name: pyarrow.nulls(each, one.type) for one in SCHEMA}
        store.add_part(pyarrow.table({**empty, **columns}, schema=SCHEMA))
    return store


def threads(folder: Path) -> None:
    write_archive(folder / "archive", 1, seconds=120.0)
    (path,) = (folder / "archive").rglob("*.parquet")
    code = (
        "import sys, time; from pathlib import Path\n"
        "from ahrsd.offline.diagnose import diagnose_recording as ask\n"
        "ask = ask if sys.argv[2] == 'one' else ask.__wrapped__\n"
        "t = time.process_time(); ask(Path(sys.argv[1])); print(time.process_time() - t)"
    )
    env = {name: value for name, value in os.environ.items() if "OPENBLAS" not in name}
    for how in ("one", "all"):
        done = subprocess.run(
            [sys.executable, "-c", code, str(path), how],
            env=env, check=True, capture_output=True, text=True,
        )  # fmt: skip
        print(f"diagnose as a library, {how}: {float(done.stdout):.2f} s CPU")


def _cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def _load() -> str:
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = ["overhead", "scaling", "memory", "ask", "threads", "driver"]
    words.add_argument("what", choices=parts)
    words.add_argument("folder", nargs="?", type=Path, help="Of `driver`, which `memory` starts.")
    words.add_argument("--most", type=int, help="Tasks of memory, rows of ask.")
    words.add_argument("--rows", action="store_true", help="Tasks of memory leave their rows.")
    given = words.parse_args()
    if given.what == "driver":
        driver(given.folder, given.most, kept=given.rows)
        return
    folder = Path(tempfile.mkdtemp(prefix="bench-fleet-"))
    try:
        if given.what == "memory":
            memory(folder, given.most or 100_000, kept=given.rows)
        elif given.what == "ask":
            ask(folder, given.most or 1_000_000)
        else:
            {"overhead": overhead, "scaling": scaling, "threads": threads}[given.what](folder)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
