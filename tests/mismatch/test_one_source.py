"""The test of a single direction: silent on noise of any colour, loud on one source."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.mismatch.one_source import (
    ALONG,
    NATS,
    along_field,
    course_root,
    directed,
    half_sphere,
)

COUNT, UNIT = 80, 1e-3


def measured(rng, truth, noise=0.3e-3):
    """Information and score of a course (80, 3) whose stretches are known unequally well."""
    size = rng.uniform(0.5, 2.0, (COUNT, 3)) / noise
    information = np.diag(size.ravel() ** 2)
    return information, information @ truth.ravel() + size.ravel() * rng.standard_normal(3 * COUNT)


def levels(rng, longest=5):
    """A course (80,) of zero mean, of levels that hold for one to `longest` stretches."""
    lengths = rng.integers(1, longest + 1, COUNT)
    course = np.repeat(rng.uniform(0.0, 1.0, COUNT), lengths)[:COUNT]
    return course - course.mean()


def test_noise_has_no_direction_however_coloured() -> None:
    rng = np.random.default_rng(3)
    for forgets in (0.25, 2.0, 8.0):
        root = course_root(COUNT, forgets)
        slow = [root @ rng.standard_normal((root.shape[1], 3)) for _ in range(20)]
        told = [directed(*measured(rng, 5e-4 * course), UNIT, 1.0)[0] for course in slow]
        assert max(told) < NATS


def test_a_source_has_one_and_it_is_found() -> None:
    rng = np.random.default_rng(4)
    direction = np.array([0.6, 0.0, -0.8])
    course = 1.2e-3 * levels(rng)
    nats, found = directed(*measured(rng, np.outer(course, direction)), UNIT, 1.0)
    assert nats > 2 * NATS
    assert abs(found @ direction) > 0.9
    assert directed(*measured(rng, np.outer(course, direction)), UNIT, 30.0)[0] > NATS
    weak = 1e-5 * levels(rng)
    assert directed(*measured(rng, np.outer(weak, direction)), UNIT, 1.0)[0] < NATS


def test_a_prior_course_has_unit_size_and_no_mean() -> None:
    root = course_root(COUNT, 1.0)
    power = np.sum(root**2, axis=1)
    assert np.abs(root.sum(axis=0)).max() < 1e-9
    assert power.mean() == pytest.approx(1.0, abs=0.05)


def test_directions_cover_half_a_sphere_evenly() -> None:
    directions = half_sphere(48)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1.0)
    rng = np.random.default_rng(1)
    anywhere = rng.standard_normal((2000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    nearest = np.abs(anywhere @ directions.T).max(axis=1)
    assert nearest.min() > np.cos(np.radians(20.0))
    assert directions.T @ directions / 48 == pytest.approx(np.eye(3) / 3, abs=0.02)


def test_slow_noise_along_a_steady_field_is_told_from_a_source() -> None:
    rng = np.random.default_rng(6)
    field = np.array([0.2, 0.0, 0.4]) + 0.02 * rng.standard_normal((500, 3))
    assert along_field(field, np.array([0.45, 0.0, 0.89])) > 0.9
    assert along_field(field, np.array([0.0, 1.0, 0.0])) < 0.1
    turning = rng.standard_normal((500, 3))
    assert along_field(turning, np.array([0.0, 0.0, 1.0])) < 0.4 < ALONG
