"""Intervals in which a time course departs from its usual level."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.where_and_when.address import departure_intervals


def test_departures_are_measured_from_the_most_frequent_level():
    edges = np.linspace(0.0, 400.0, 41)
    course = np.zeros((40, 3))
    course[12:20] = 2.0
    assert departure_intervals(edges, course, np.full(40, 0.1)) == [(120.0, 200.0)]
    course[20:] = 1.0
    course[:12] = -1.0
    assert departure_intervals(edges, course, np.full(40, 0.1)) == [(0.0, 200.0)]
