"""Answers in worlds of another author: how often is one wrong beyond its sigmas, and silent?

    python tests/benchmarks/estimator/bench_worlds.py [--seeds N] [--first N] [--chance] [--json F]

The generator and its scores are in ../shared/worlds, written apart from this project; the command
says so and ends where they are not. Six motions by thirteen troubles for each seed, some .2 s each;
and three further troubles that are put onto these worlds here.
An answer is silent where it is converged and nothing warns. `any3`: some number beyond 3 sigma (3 %
by chance); `h3`: a heading beyond 3 x its expected error; `h3&1`: and by more than a degree.
`--chance` says how many h3 there were if every answer's covariance were right: the worst of some
650 headings and tilts is held against one sigma, so that a motion which shows all attitudes has
more than 0.3 %.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.estimator.chain import symmetric
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.samples import Array, SampleBlock

WORLDS = Path(__file__).resolve().parents[4] / "shared" / "worlds"
DRAWS = 20  # of errors by each answer's covariance
COLUMNS = ("worlds", "converged", "silent", "any3", "h3", "h3&1")


Further = tuple[Array, list[dict[str, Any]]]
"""Rows, and what may be called the truth of them: the answer is judged by the kindest."""


def warm_soft_iron(data: Array, truth: dict[str, Any], rng: np.random.Generator) -> Further:
    """The soft iron's entries follow the temperature, by .3 % (1 sigma) in the end."""
    iron, hard = np.array(truth["A"]), np.array(truth["b"])
    change = rng.normal(0.0, 0.003, (3, 3))
    change = (change + change.T) / 2
    time_s = data[:, 0] - data[0, 0]
    course = 1.0 - np.exp(-2.0 * time_s / time_s[-1])
    field = (data[:, 1:4] - hard) @ np.linalg.inv(iron).T
    found = data.copy()
    found[:, 1:4] += course[:, None] * (field @ change.T)
    shares = (0.0, float(np.mean(course)), float(course[-1]))
    irons = [iron + share * change for share in shares]
    return found, [{**truth, "A": (a / np.cbrt(np.linalg.det(a))).tolist()} for a in irons]


def g_sensitivity(data: Array, truth: dict[str, Any], rng: np.random.Generator) -> Further:
    """The gyro feels the specific force: each axis each, .1 deg/s for 1 g (1 sigma).

    What it makes of the mean force is a part of the bias for who has this attitude.
    """
    felt = data[:, 7:10] / 9.81 @ rng.normal(0.0, np.radians(0.1), (3, 3)).T
    found = data.copy()
    found[:, 4:7] += felt
    mean = np.mean(felt, axis=0)
    biases = {key: (np.array(truth[key]) + mean).tolist() for key in ("wb", "wb_end")}
    return found, [{**truth, **biases}]


#: name, trouble of the other author beneath it, and what is put onto it
FURTHER: tuple[tuple[str, str, Callable[..., Further]], ...] = (
    ("warm soft iron", "clean", warm_soft_iron),
    ("g-sensitivity", "clean", g_sensitivity),
    ("gyroscale and g-sensitivity", "gyroscale", g_sensitivity),
)


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
        "covariance": found.covariance,
        "correction_matrix": np.linalg.inv(found.soft_iron),
        "standard_deviation": {
            "soft_iron": sigma[:6],
            "hard_iron_gauss": sigma[6:9],
            "gyro_bias_rad_s": sigma[9:],
        },
        "heading_error_deg": {"expected_worst": found.heading_sigma_deg},
        "observability": {"unobservable": []},
    }


def by_chance(answer: dict[str, Any], truth: dict[str, Any], worst: Callable[..., float]) -> float:
    """Share of h3 among errors that an answer's own covariance makes; `worst` is the scorer's."""
    iron, hard = answer["soft_iron"], answer["hard_iron_gauss"]
    rng = np.random.default_rng(truth["seed"])
    errors = rng.multivariate_normal(np.zeros(9), answer["covariance"][:9, :9], DRAWS, method="svd")
    limit = 3.0 * answer["heading_error_deg"]["expected_worst"]
    found = [
        worst(
            answer["correction_matrix"],
            hard,
            iron + symmetric(error[:6]),
            hard + error[6:],
            np.array(truth["h"]),
            truth["tilt_deg"],
        )
        for error in errors
    ]
    return float(np.mean(np.array(found) > limit))


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
    parser.add_argument("--chance", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if not WORLDS.is_dir():
        print(f"{WORLDS} is not here: the other author's worlds are needed", file=sys.stderr)
        return 2
    sys.path.insert(0, str(WORLDS))
    worlds, scorer = importlib.import_module("worlds"), importlib.import_module("score_worlds")
    cells: dict[str, list[dict[str, Any]]] = defaultdict(list)
    chances: list[float] = []

    def judged(rows: Array, truths: list[dict[str, Any]]) -> dict[str, Any]:
        answer = answered(rows)
        scores = [scorer.score(answer, one) for one in truths]
        score = min(scores, key=lambda one: one.get("head", 0.0))
        if options.chance and score["conv"] and not score["warn"]:
            chances.append(by_chance(answer, truths[0], scorer.heading_err))
        return score

    for seed in range(options.first, options.first + options.seeds):
        for motion in worlds.MOTIONS:
            for trouble in worlds.TROUBLES:
                data, truth = worlds.world(motion, trouble, seed)
                cells[trouble].append(judged(data, [truth]))
            for number, (name, beneath, put_on) in enumerate(FURTHER):
                data, truth = worlds.world(motion, beneath, seed)
                rng = np.random.default_rng([seed, number])
                cells[name].append(judged(*put_on(data, truth, rng)))
    table = {trouble: counted(scores) for trouble, scores in cells.items()}
    table["all"] = np.sum(list(table.values()), axis=0).tolist()
    print(f"| trouble | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    for trouble, row in table.items():
        print(f"| {trouble} | {' | '.join(map(str, row))} |")
    if options.chance:
        print(f"h3 by chance, were every covariance right: {sum(chances):.1f} of {len(chances)}")
    if options.json:
        body = {"first_seed": options.first, "seeds": options.seeds, "columns": COLUMNS} | table
        options.json.write_text(json.dumps(body, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
