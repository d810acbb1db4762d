"""Do the gates for flash open in worlds of another author, and how wrong is the heading then?

    python tests/benchmarks/gates/bench_gates.py [--seeds N] [--first SEED] [--trouble NAME ...]

Each world (../shared/worlds, written apart from this project; the command says so and ends where
they are not) goes through the pipeline of `ahrsd run`. A world has no device, no place on the Earth
and no temperature, and what it is calibrated against is nothing: gates that ask for these are left
out, which can only open more. `opened`: worlds in which all others were green at once at any time;
`above 1 deg`: of these, where the heading by the estimate of such a moment was off by more.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd import events
from ahrsd.calibration import Estimate
from ahrsd.config.config import Config
from ahrsd.gates import Level, for_level
from ahrsd.offline.replay import replay

sys.path.append(str(Path(__file__).parents[1] / "estimator"))

from bench_worlds import WORLDS

#: gates that ask for what a world has not
LEFT_OUT = (
    "input_basis.", "field.position", "field.model", "field.inclination", "gyro_bias.", "step.",
    "better.", "bounds.scale", "stationarity.temperature", "evidence.complete",
)  # fmt: skip


def opened(folder: Path, worlds: Any, motion: str, trouble: str, seed: int) -> list[Estimate]:
    """The estimates of the moments in which the gates were open."""
    name = worlds.write(folder, motion, trouble, seed)
    found: list[Estimate] = []
    newest: list[Estimate] = []

    def hear(event: events.Event) -> None:
        if isinstance(event, events.Estimated):
            newest[:] = [event.estimate]
        elif isinstance(event, events.Judged):
            gates = for_level(event.gates, Level.FLASH)
            if all(gate.ok or gate.gate.startswith(LEFT_OUT) for gate in gates):
                found.extend(newest)

    replay(folder / f"{name}.csv", Config(), listeners=[hear])
    return found


def heading_error_deg(estimate: Estimate, truth: dict[str, Any], scorer: Any) -> float:
    """The worst at the attitudes driven, by the other author's score: the kindest truth counts."""
    correction = np.linalg.inv(estimate.soft_iron)
    return min(
        float(
            scorer.heading_err(
                correction, estimate.hard_iron_gauss, np.array(truth["A"]), np.array(truth[iron]),
                np.array(truth["h"]), truth["tilt_deg"],
            )
        )
        for iron in ("b", "b_end", "b_mean")
    )  # fmt: skip


def main() -> int:
    """Run the worlds of some seeds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--trouble", action="append", help="default: clean and gradient")
    options = parser.parse_args()
    if not WORLDS.is_dir():
        print(f"{WORLDS} is not here: the other author's worlds are needed", file=sys.stderr)
        return 2
    sys.path.insert(0, str(WORLDS))
    worlds, scorer = importlib.import_module("worlds"), importlib.import_module("score_worlds")
    print(
        "| trouble | worlds | opened | above 1 deg | worst, deg |\n|---|---|---|---|---|",
        flush=True,
    )
    for trouble in options.trouble or ["clean", "gradient"]:
        count, worst = 0, []
        for seed in range(options.first, options.first + options.seeds):
            for motion in worlds.MOTIONS:
                count += 1
                with tempfile.TemporaryDirectory() as scratch:
                    folder = Path(scratch)
                    moments = opened(folder, worlds, motion, trouble, seed)
                    _, truth = worlds.world(motion, trouble, seed)
                if moments:
                    worst.append(max(heading_error_deg(one, truth, scorer) for one in moments))
        above = sum(error > 1.0 for error in worst)
        most = f"{max(worst):.2f}" if worst else ""
        print(f"| {trouble} | {count} | {len(worst)} | {above} | {most} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
