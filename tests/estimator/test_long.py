"""Cost and memory of a long run: the short form of `tests/benchmarks/estimator/bench_long.py`."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest


@pytest.mark.slow
def test_cost_of_the_hundred_thousandth_sample_equals_that_of_the_first(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks" / "estimator"))
    points, error = importlib.import_module("bench_long").measure(100_000)
    assert points[0].samples == 10_000
    assert points[-1].samples == 100_000
    assert (
        min(p.cost_us for p in points[5:]) < 1.1 * points[0].cost_us
    )  # other processes use the machine
    assert points[-1].resident_mb - points[3].resident_mb < 1.0
    assert np.linalg.norm(error) < 2e-4
