"""Facts: their intervals, and which other facts they explain."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Where
from ahrsd.diagnosis.data_quality.facts import (
    Fact,
    burst_is_explained,
    lost_turn_intervals,
    row_intervals,
)
from ahrsd.samples import Array


def test_row_intervals_of_a_mask() -> None:
    rows = np.array([0, 1, 1, 0, 1, 0, 0, 1], dtype=bool)
    assert row_intervals(rows) == [(1, 3), (4, 5), (7, 8)]
    assert row_intervals(rows, 1) == [(1, 5), (7, 8)]
    assert row_intervals(rows[:1]) == []


def test_noise_burst_around_a_lost_turn_is_explained_by_it() -> None:
    def fact(effect: str, *spans: tuple[float, float], turned: Array | None = None) -> Fact:
        return Fact(effect, "", Where(spans, ("x",), "link"), 1.0, turned=turned)

    lost = fact("dropped_samples", (20.0, 20.04), (313.1, 313.14), turned=np.ones(3))
    moments = lost_turn_intervals([lost])
    assert moments == [(20.0, 20.04), (313.1, 313.14)]
    assert burst_is_explained(fact("noise_burst", (313.0, 314.0)), moments)
    assert not burst_is_explained(fact("noise_burst", (313.0, 314.0), (400.0, 402.0)), moments)
    assert not burst_is_explained(fact("noise_level", (0.0, 400.0)), moments)
    stuck = fact("stuck_magnetometer", (313.0, 314.0))
    assert not burst_is_explained(fact("noise_burst", (313.0, 314.0)), lost_turn_intervals([stuck]))
