"""The test of a single direction: silent on noise of any colour, loud on one source."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.diagnosis.rules.one_source import NATS, course_root, directed, half_sphere

COUNT, UNIT = 80, 1e-3


def turning(rng, spread=1.0, about=(0.0, 0.0, 0.0)):
    """Unit vectors (80, 3) of a field about a direction."""
    field = np.asarray(about) + spread * rng.standard_normal((COUNT, 3))
    return field / np.linalg.norm(field, axis=1, keepdims=True)


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
        field = turning(rng)
        told = [directed(*measured(rng, 5e-4 * course), UNIT, 1.0, field) for course in slow]
        assert max(one.beyond_noise for one in told) < NATS
        assert min(one.beyond_white for one in told) > NATS


def test_white_noise_has_no_course() -> None:
    rng = np.random.default_rng(5)
    told = [
        directed(*measured(rng, np.zeros((COUNT, 3))), UNIT, 1.0, turning(rng)) for _ in range(30)
    ]
    assert max(one.beyond_white for one in told) < 2.0


def test_a_source_has_one_and_it_is_found() -> None:
    rng = np.random.default_rng(4)
    direction = np.array([0.6, 0.0, -0.8])
    course, field = 1.2e-3 * levels(rng), turning(rng)
    seen = directed(*measured(rng, np.outer(course, direction)), UNIT, 1.0, field)
    assert seen.beyond_white > seen.beyond_noise > 2 * NATS
    assert abs(seen.direction @ direction) > 0.9
    louder = directed(*measured(rng, np.outer(course, direction)), UNIT, 30.0, field)
    assert louder.beyond_noise > NATS
    weak = directed(*measured(rng, np.outer(1e-5 * levels(rng), direction)), UNIT, 1.0, field)
    assert weak.beyond_noise < NATS


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


@pytest.mark.parametrize(("spread", "told"), [(0.02, False), (0.4, True)])
def test_a_source_along_the_field_is_told_by_the_field_turning(spread, told) -> None:
    """Slow noise turns with the field, a source on the vehicle does not."""
    rng = np.random.default_rng(6)
    down = np.array([0.0, 0.0, 1.0])
    field, course = turning(rng, spread, down), 1.2e-3 * levels(rng)
    source = directed(*measured(rng, np.outer(course, down)), UNIT, 1.0, field)
    assert (source.beyond_noise > NATS) is told
    noise = directed(*measured(rng, course[:, None] * field), UNIT, 1.0, field)
    assert noise.beyond_noise < 1.0
    assert min(noise.beyond_white, source.beyond_white) > NATS
