"""Scores of several rings, added up from the table of scores."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "diagnosis"))
from add_rings import SCORES, shares

TABLE = """round,tool,score,value,interval_95,cases,wanted,met
a,ahrsd,detected,98.9%,94.0% to 99.8%,91,>= 99.0%,NO
a,ahrsd,"onset error, median, s",0.16,,19,<= 1,yes
a,ahrsd,nothing added,100.0%,98.3% to 100.0%,217,,
a,stlsq,detected,50.0%,40.0% to 60.0%,91,>= 99.0%,NO
b,ahrsd,detected,50.0%,40.0% to 60.0%,91,>= 99.0%,NO
"""


def test_shares_of_one_ring_and_tool_are_counted_and_medians_are_not() -> None:
    assert shares(csv.DictReader(TABLE.splitlines()), "a") == {
        "detected": (90, 91, ">= 99.0%"),
        "nothing added": (217, 217, ""),
    }


def test_the_stored_table_has_the_newest_ring() -> None:
    with SCORES.open(encoding="utf-8", newline="") as file:
        newest = shares(csv.DictReader(file), "ring600q")
    assert newest["first name right, all detected"] == (213, 224, ">= 97.0%")
