"""Scores of several opened rings added up from their reports: shares only, with each ring's own.

python tests/benchmarks/add_rings.py docs/challenge/ring600{d,e,f,g,h,i}
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

HEADING = "## Scores of ahrsd"


def shares(report: str) -> dict[str, tuple[int, int, str]]:
    """Of every score that is a share: how many, of how many, what is wanted."""
    found: dict[str, tuple[int, int, str]] = {}
    table = report.split(HEADING, 1)[1].split("\n## ", 1)[0]
    for line in table.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 6 and cells[1].endswith("%"):
            score, value, _, cases, wanted, _ = cells
            found[score] = (round(float(value[:-1]) * int(cases) / 100), int(cases), wanted)
    return found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ring", nargs="+", type=Path, help="folder of a ring's report.md")
    rings = parser.parse_args().ring
    added: dict[str, list[tuple[int, int, str]]] = defaultdict(list)
    for ring in rings:
        for score, told in shares((ring / "report.md").read_text()).items():
            added[score].append(told)
    print("| score | cases | share | wanted | of each |\n|---|---|---|---|---|")
    for score, told in added.items():
        right, cases = sum(one[0] for one in told), sum(one[1] for one in told)
        each = ", ".join(f"{one[0]}/{one[1]}" for one in told)
        share = 100 * right / max(cases, 1)
        print(f"| {score} | {right} of {cases} | {share:.1f} % | {told[-1][2]} | {each} |")


if __name__ == "__main__":
    main()
