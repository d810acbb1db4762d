"""What the daemon says of sound sensors and of gyroscopes of the wrong sign, in others' worlds.

    python tests/benchmarks/gates/bench_sensor_checks.py [--seeds N] [--first SEED]

The worlds are in ../shared/worlds, written apart from this project; the command says so and ends
where they are not. Six motions for each seed. `said`: worlds in which anything is said of a sensor.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.core.sensor_checks import SensorChecks
from ahrsd.samples import Array, SampleBlock

sys.path.append(str(Path(__file__).parents[1] / "estimator"))

from bench_worlds import WORLDS

#: what is done to the gyroscope: the worlds' trouble, and the factor of each axis
CASES: dict[str, tuple[str, tuple[int, int, int]]] = {
    "sound": ("clean", (1, 1, 1)),
    "sound, hard iron of 1 to 2 G": ("bighard", (1, 1, 1)),
    "sound, scale of 1 %": ("gyroscale", (1, 1, 1)),
    "all axes negated": ("clean", (-1, -1, -1)),
    "z negated": ("clean", (1, 1, -1)),
    "x negated": ("clean", (-1, 1, 1)),
}
ROWS = 50


def said_of(rows: Array, rate_hz: float) -> str:
    """The first thing that is said; empty where nothing is."""
    checks = SensorChecks()
    for first in range(0, len(rows), ROWS):
        part = rows[first : first + ROWS]
        time_s, dt_s = part[:, 0], np.full(len(part), 1.0 / rate_hz)
        if not first:
            dt_s[0] = np.nan
        block = SampleBlock(
            time_s, dt_s, time_s, part[:, 1:4], part[:, 4:7], part[:, 7:10], gap_before=not first
        )
        if found := checks.take(block):
            return found[0]
    return ""


def counted(worlds: Any, trouble: str, signs: tuple[int, int, int], seeds: range) -> list[str]:
    """What is said of each world in which something is."""
    found = []
    for seed in seeds:
        for motion in worlds.MOTIONS:
            rows, truth = worlds.world(motion, trouble, seed)
            rows = rows.copy()
            rows[:, 4:7] *= signs
            if text := said_of(rows, truth["rate"]):
                found.append(f"{motion} {seed}: {text}")
    return found


def main() -> int:
    """Run the worlds of some seeds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=1000)
    options = parser.parse_args()
    if not WORLDS.is_dir():
        print(f"{WORLDS} is not here: the other author's worlds are needed", file=sys.stderr)
        return 2
    sys.path.insert(0, str(WORLDS))
    worlds = importlib.import_module("worlds")
    seeds = range(options.first, options.first + options.seeds)
    print("| gyroscope | worlds | said |\n|---|---|---|", flush=True)
    for name, (trouble, signs) in CASES.items():
        found = counted(worlds, trouble, signs, seeds)
        print(f"| {name} | {len(seeds) * len(worlds.MOTIONS)} | {len(found)} |", flush=True)
        for text in found if name.startswith("sound") else ():
            print(f"  {text}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
