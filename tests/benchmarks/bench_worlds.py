"""Answers in worlds of another author: how often is one wrong beyond its sigmas, and silent?

    python tests/benchmarks/bench_worlds.py [--seeds N] [--first SEED] [--json FILE]

The generator and its scores are in ../shared/worlds, written apart from this project; the command
says so and ends where they are not. Six motions by thirteen troubles for each seed, some .2 s each.
An answer is silent where it is converged and nothing warns. `any3`: some number beyond 3 sigma (3 %
by chance); `h3`: a heading beyond 3 x its expected error; `h3&1`: and by more than a degree.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.samples import Array, SampleBlock

WORLDS = Path(__file__).resolve().parents[3] / "shared" / "worlds"
COLUMNS = ("worlds", "converged", "silent", "any3", "h3", "h3&1")


def blocks(data: Array) -> Iterator[SampleBlock]:
    """Rows of time, field, rate and acceleration, cut where rows are missing."""
    time_s = data[:, 0]
    steps = np.diff(time_s)
    cuts = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1
    for rows in np.split(np.arange(len(data)), cuts):
        if len(rows) < 2:
            continue
        t = time_s[rows]
        m, w, a = (data[rows, k : k + 3] for k in (1, 4, 7))
        yield SampleBlock(t, np.r_[np.nan, np.diff(t)], t, m, w, a, {}, 0, True)


def answered(data: Array) -> dict[str, Any]:
    """The answer as the scorer reads it."""
    estimator = Estimator(at_once=WHOLE)
    for block in blocks(data):
        estimator.add(block)
    found = estimator.finish()
    if found is None:
        return {"converged": False}
    turned = estimator.misalignment()
    warnings = [*found.warnings, *(["turned"] if turned is not None and turned.significant else [])]
    sigma = found.sigma
    return {
        "converged": found.converged,
        "warnings": warnings,
        "hard_iron_gauss": found.hard_iron_gauss,
        "soft_iron": found.soft_iron,
        "gyro_bias_rad_s": found.gyro_bias_rad_s,
        "correction_matrix": np.linalg.inv(found.soft_iron),
        "standard_deviation": {
            "soft_iron": sigma[:6],
            "hard_iron_gauss": sigma[6:9],
            "gyro_bias_rad_s": sigma[9:],
        },
        "heading_error_deg": {"expected_worst": found.heading_sigma_deg},
        "observability": {"unobservable": []},
    }


def counted(scores: list[dict[str, Any]]) -> list[int]:
    """The columns."""
    silent = [s for s in scores if s["conv"] and not s["warn"]]
    wrong = [s for s in silent if s["hz"] > 3]
    return [
        len(scores),
        sum(s["conv"] for s in scores),
        len(silent),
        sum(max(s["zb"], s["zA"], s["zw"]) > 3 for s in silent),
        len(wrong),
        sum(s["head"] > 1 for s in wrong),
    ]


def main() -> int:
    """Run the worlds of some seeds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if not WORLDS.is_dir():
        print(f"{WORLDS} is not here: the other author's worlds are needed", file=sys.stderr)
        return 2
    sys.path.insert(0, str(WORLDS))
    worlds, scorer = importlib.import_module("worlds"), importlib.import_module("score_worlds")
    cells: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for seed in range(options.first, options.first + options.seeds):
        for motion in worlds.MOTIONS:
            for trouble in worlds.TROUBLES:
                data, truth = worlds.world(motion, trouble, seed)
                cells[trouble].append(scorer.score(answered(data), truth))
    rows = {trouble: counted(scores) for trouble, scores in cells.items()}
    rows["all"] = np.sum(list(rows.values()), axis=0).tolist()
    print(f"| trouble | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    for trouble, row in rows.items():
        print(f"| {trouble} | {' | '.join(map(str, row))} |")
    if options.json:
        body = {"first_seed": options.first, "seeds": options.seeds, "columns": COLUMNS} | rows
        options.json.write_text(json.dumps(body, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
