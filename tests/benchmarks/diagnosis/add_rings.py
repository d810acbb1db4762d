"""Scores of several opened rings added up: shares only, with each ring's own.

    python tests/benchmarks/diagnosis/add_rings.py
        ring600{i,j,k} [--scores docs/validation/trials/scores.csv]

The table of scores has a row per round, tool and score, as `ahrsd challenge score` printed it.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

SCORES = Path(__file__).parents[3] / "docs" / "validation" / "trials" / "scores.csv"


def shares(
    rows: Iterable[Mapping[str, str]], ring: str, tool: str = "ahrsd"
) -> dict[str, tuple[int, int, str]]:
    """Of every score of a ring that is a share: how many, of how many, what is wanted."""
    return {
        row["score"]: (
            round(float(row["value"][:-1]) * int(row["cases"]) / 100),
            int(row["cases"]),
            row["wanted"],
        )
        for row in rows
        if row["round"] == ring and row["tool"] == tool and row["value"].endswith("%")
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ring", nargs="+", help="name of a round in the table")
    parser.add_argument("--scores", type=Path, default=SCORES)
    asked = parser.parse_args()
    with asked.scores.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    unknown = set(asked.ring) - {row["round"] for row in rows}
    if unknown:
        parser.error(f"{asked.scores} has no round {', '.join(sorted(unknown))}")
    added: dict[str, list[tuple[int, int, str]]] = defaultdict(list)
    for ring in asked.ring:
        for score, told in shares(rows, ring).items():
            added[score].append(told)
    print("| score | cases | share | wanted | of each |\n|---|---|---|---|---|")
    for score, told in added.items():
        right, cases = sum(one[0] for one in told), sum(one[1] for one in told)
        each = ", ".join(f"{one[0]}/{one[1]}" for one in told)
        share = 100 * right / max(cases, 1)
        print(f"| {score} | {right} of {cases} | {share:.1f} % | {told[-1][2]} | {each} |")


if __name__ == "__main__":
    main()
