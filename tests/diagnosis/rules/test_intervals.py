"""Change points of a course in segments."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.rules.intervals import change_points, explained, levels
from ahrsd.diagnosis.where_and_when.intervals import departures


def course_with(levels_at, noise=0.3, seed=0):
    """G and s of 40 segments whose neighbours share information; a fixed constant is unknown."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((40, 3))
    for start, end, value in levels_at:
        truth[start:end] = value
    band = np.eye(40) + 0.3 * (np.eye(40, k=1) + np.eye(40, k=-1))
    band -= band.sum(0)[:, None] * band.sum(0) / band.sum()
    G = np.kron(band / noise**2, np.eye(3))
    values, vectors = np.linalg.eigh(G)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return G, G @ truth.ravel() + root @ rng.standard_normal(120)


def test_a_step_and_a_pulse_are_found_where_they_are():
    G, s = course_with([(10, 40, [3.0, 0.0, -2.0])])
    assert change_points(G, s) == [10]
    G, s = course_with([(12, 20, [3.0, 0.0, -2.0])])
    assert change_points(G, s) == [12, 20]
    assert explained(G, s, [12, 20]) > 0.9 * explained(G, s, list(range(1, 40)))


def test_noise_has_no_change_points():
    assert [change_points(*course_with([], seed=k)) for k in range(20)] == [[]] * 20


def test_departures_are_from_the_level_that_holds_for_longest():
    edges = np.linspace(0.0, 400.0, 41)
    course = np.zeros((40, 3))
    course[12:20] = 2.0
    level = levels(course, np.full(40, 0.1), [12, 20])
    assert departures(edges, level, np.full(40, 0.1), course) == [(120.0, 200.0)]
    course[20:] = 1.0
    course[:12] = -1.0
    level = levels(course, np.full(40, 0.1), [12, 20])
    assert departures(edges, level, np.full(40, 0.1), course) == [(0.0, 200.0)]
