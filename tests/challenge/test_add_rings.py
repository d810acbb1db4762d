"""Scores of several rings, added up from their reports."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from add_rings import shares

REPORT = """# Sealed trial

## Scores of ahrsd

| score | value | 95 % | cases | wanted | met |
| --- | --- | --- | --- | --- | --- |
| detected | 98.9% | 94.0% to 99.8% | 91 | >= 99.0% | NO |
| onset error, median, s | 0.16 |  | 19 | <= 1 | yes |
| nothing added | 100.0% | 98.3% to 100.0% | 217 |  |  |

## Scores of stlsq

| detected | 50.0% | 40.0% to 60.0% | 91 | >= 99.0% | NO |
"""


def test_shares_of_our_own_scores_are_counted_and_medians_are_not() -> None:
    assert shares(REPORT) == {
        "detected": (90, 91, ">= 99.0%"),
        "nothing added": (217, 217, ""),
    }
