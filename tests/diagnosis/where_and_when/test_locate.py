"""Segments of a recording, and departures of a time course in them."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.diagnosis.where_and_when.address import extend_departures, joined_intervals
from ahrsd.diagnosis.where_and_when.locate import equal_segments


def test_neighbouring_segments_are_joined():
    edges = np.arange(6.0)
    assert joined_intervals(edges, np.array([True, True, False, False, True])) == [
        (0.0, 2.0),
        (4.0, 5.0),
    ]


def test_segments_cover_every_sample_once():
    time_s = np.linspace(3.0, 103.0, 1001)
    cut = equal_segments(time_s, 7)
    counts = np.bincount(cut.index, minlength=7)
    assert counts.sum() == 1001
    assert counts.max() - counts.min() <= 1
    assert cut.middle_s[0] == pytest.approx(3.0 + 100 / 14)


def test_slow_departure_is_extended_to_its_significant_slopes():
    """The levels alone miss the slopes; beyond them there is only noise."""
    rng = np.random.default_rng(2)
    course = 0.1 * rng.standard_normal((40, 3))
    course[10:18, 0] += 1.5 * np.sin(np.pi * (np.arange(8) + 0.5) / 8) ** 2 + 0.15
    inside = np.zeros(40, bool)
    inside[12:16] = True
    found = np.flatnonzero(extend_departures(inside, course, np.full(40, 0.1)))
    assert (found[0], found[-1]) in {(10, 17), (10, 16), (11, 17), (11, 16)}
    assert np.array_equal(found, np.arange(found[0], found[-1] + 1))
