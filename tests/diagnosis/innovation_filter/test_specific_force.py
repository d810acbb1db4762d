"""The accelerometer's noise is no force: what follows the force is told in its size."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.innovation_filter.context import force_without_noise

RATE_HZ = 50.0


def swaying(count: int = 8000) -> np.ndarray:
    t = np.arange(count) / RATE_HZ
    x = 1.8 * np.sin(2 * np.pi * 0.11 * t + 0.3) + 0.3 * np.sin(2 * np.pi * 0.37 * t)
    return np.column_stack([x, 0.4 * np.cos(2 * np.pi * 0.07 * t), -9.8 + 0.2 * np.sin(t)])


def test_a_slow_force_is_kept_and_the_noise_is_not() -> None:
    force = swaying()
    noise = 0.2 * np.random.default_rng(1).standard_normal(force.shape)
    found = force_without_noise(force + noise, [slice(0, len(force))])
    assert np.sqrt(np.mean((found - force) ** 2)) < 0.25 * 0.2
    # nothing of the force has gone with the noise (the third axis sways no more than the noise)
    along = np.sum((found - found.mean(0)) * (force - force.mean(0)), axis=0)
    np.testing.assert_allclose(along / np.sum((found - found.mean(0)) ** 2, axis=0), 1.0, atol=0.03)


def test_at_rest_there_is_one_force() -> None:
    noise = 0.2 * np.random.default_rng(2).standard_normal((4000, 3))
    found = force_without_noise(np.array([0.1, -0.2, -9.8]) + noise, [slice(0, 4000)])
    assert found.std(axis=0).max() < 0.01


def test_runs_are_apart_and_what_is_short_or_has_holes_is_as_it_was() -> None:
    force = swaying(600)
    force[400:] += 50.0
    runs = [slice(0, 400), slice(400, 450), slice(450, 600)]
    force[500, 1] = np.nan
    found = force_without_noise(force, runs)
    np.testing.assert_array_equal(found[400:], force[400:])
    np.testing.assert_allclose(found[:400], force[:400], atol=0.02)
