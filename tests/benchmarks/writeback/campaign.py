"""The write-safety campaign: power cuts, histories with a red gate, random faults.

    python tests/benchmarks/writeback/campaign.py
        --cuts 3000 --histories 100000 --cycles 100000 --json FILE

Each part is done in chunks; the file is written after each, and a later call with the same seed and
file goes on where this one ended (or with `--seconds`, was ended). What a run of a part is, and
what counts as wrong, is said in campaign_*.py; figures: docs/validation/campaign.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

Tally = dict[str, Any]


def cuts_chunk(chunk: range, seed: int) -> Tally:
    """Power cuts, evenly over the steps."""
    from campaign_cuts import STEPS, CutTally, run_one

    tally = CutTally()
    for number in chunk:
        run_one(STEPS[number % len(STEPS)], number // len(STEPS), seed, tally)
    return dict(vars(tally))


def histories_chunk(chunk: range, seed: int) -> Tally:
    """Random histories in which something forbids a write."""
    from campaign_histories import HistoryTally, remembered, run_one

    tally = HistoryTally()
    with remembered():
        for number in chunk:
            run_one(number, seed, tally)
    return dict(vars(tally))


def cycles_chunk(chunk: range, seed: int) -> Tally:
    """Fault cycles; a schedule has several, so a chunk is whole schedules."""
    from campaign_faults import PER_SCHEDULE, FaultTally, run_one

    tally = FaultTally()
    for number in range(chunk.start // PER_SCHEDULE, chunk.stop // PER_SCHEDULE):
        run_one(number, seed, tally)
    return dict(vars(tally))


@dataclass(frozen=True)
class Part:
    """`chunk` runs are done at a time by `work`; in the result, `wrong` must be empty or 0."""

    chunk: int
    work: Callable[[range, int], Tally]
    wrong: tuple[str, ...]


PARTS = {
    "cuts": Part(240, cuts_chunk, ("unrecoverable", "disagreements", "flash_after")),
    "histories": Part(1000, histories_chunk, ("wrong",)),
    "cycles": Part(
        200,
        cycles_chunk,
        ("exceptions", "hangs", "differs", "outputs_changed", "leaked_threads", "leaked_files"),
    ),
}


def added(one: Any, other: Any) -> Any:
    """Counts add up, lists follow each other, tables are joined."""
    if isinstance(one, dict):
        return {
            key: added(one[key], other[key])
            if key in one and key in other
            else {**one, **other}[key]
            for key in sorted({**one, **other})
        }
    return one + other


def work(task: tuple[str, int, int, int]) -> tuple[int, Tally]:
    """One chunk, in a process of its own."""
    name, index, wanted, seed = task
    part = PARTS[name]
    chunk = range(index * part.chunk, min((index + 1) * part.chunk, wanted))
    return index, part.work(chunk, seed)


def run_part(
    name: str,
    wanted: int,
    options: argparse.Namespace,
    found: Tally,
    keep: Callable[[], None],
) -> None:
    """Do the chunks of a part that are not in `found` yet, and add them to it."""
    part = PARTS[name]
    begun, done = time.monotonic(), set(found.setdefault("chunks", []))
    tasks = [
        (name, index, wanted, options.seed)
        for index in range(-(-wanted // part.chunk))
        if index not in done
    ]
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        for index, tally in pool.imap_unordered(work, tasks):
            found["tally"] = added(found["tally"], tally) if "tally" in found else tally
            found["chunks"] = sorted([*found["chunks"], index])
            found["runs"] = sum(min(part.chunk, wanted - k * part.chunk) for k in found["chunks"])
            keep()
            took_s = time.monotonic() - begun
            print(
                f"\r{name}: {found['runs']} of {wanted}, {took_s:.0f} s ", end="", file=sys.stderr
            )
            if took_s > options.seconds:
                pool.terminate()
                break
    found["seconds"] = round(found.get("seconds", 0.0) + time.monotonic() - begun, 1)
    print(file=sys.stderr)
    keep()


def faulty(name: str, found: Tally) -> list[str]:
    """What must not be and was seen."""
    return [
        f"{name}: {key} {found['tally'][key]}" for key in PARTS[name].wrong if found["tally"][key]
    ]


def main() -> int:
    """Run the campaign; exit code 1 where something was seen that must not be."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cuts", type=int, default=3000)
    parser.add_argument("--histories", type=int, default=100_000)
    parser.add_argument("--cycles", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1, choices=[1, 2])
    parser.add_argument("--seconds", type=float, default=float("inf"), help="at most, per part")
    parser.add_argument("--json", type=Path, help="result; what is there already is not repeated")
    options = parser.parse_args()
    result: Tally = {"seed": options.seed, "python": platform.python_version(), "parts": {}}
    if options.json is not None and options.json.exists():
        result = json.loads(options.json.read_text())
        if result["seed"] != options.seed:
            parser.error(f"{options.json} is of seed {result['seed']}")

    def keep() -> None:
        if options.json is not None:
            options.json.write_text(json.dumps(result, indent=1) + "\n")

    seen: list[str] = []
    for name in PARTS:
        if wanted := getattr(options, name):
            found = result["parts"].setdefault(name, {})
            run_part(name, wanted, options, found, keep)
            seen += faulty(name, found)
    print("\n".join(seen) or "nothing that must not be was seen")
    return 1 if seen else 0


if __name__ == "__main__":
    sys.exit(main())
