"""The place of a magnetic object, beside a calibration that has taken a part of its field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ahrsd.diagnosis.effects.dipole import unit_fields
from ahrsd.diagnosis.rules.objects import closest_object
from ahrsd.samples import Array

#: m and degrees
PLACE, TURN_DEG = np.array([1.5, -2.0, 2.5]), 30.0


def _way() -> Array:
    t = np.linspace(0, 40, 2000)
    return np.column_stack([4 * np.sin(0.4 * t), 3 * np.cos(0.7 * t), np.sin(1.3 * t)])


def _turned(vectors: Array, deg: float) -> Array:
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.asarray(vectors @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T)


def _fields(at: Array) -> Array:
    return unit_fields(_turned(_way() - at[:3], at[3]), 2.0)


def _unfiltered(parts: Sequence[Array]) -> list[Array]:
    return list(parts)


def test_from_metres_away_and_another_heading_to_the_place() -> None:
    rng = np.random.default_rng(1)
    field = _fields(np.append(PLACE, TURN_DEG)) @ np.array([0.8, -0.5, 0.3])
    taken = np.tile(np.eye(3), (len(field), 1, 1))  # a constant is the calibration's
    noisy = field + [0.3, -0.2, 0.1] + 0.01 * rng.standard_normal(field.shape)
    start = np.append(PLACE + np.array([-1.0, 1.2, 0.8]), 160.0)
    found = closest_object(_fields, _unfiltered, taken, noisy, [start])
    assert np.linalg.norm(found[:3] - PLACE) < 0.05
    assert abs((found[3] - TURN_DEG + 180) % 360 - 180) < 1.0


def test_an_innovation_of_nothing_stays_where_it_starts_or_explains_next_to_nothing() -> None:
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((2000, 3))
    taken = np.tile(np.eye(3), (2000, 1, 1))
    found = closest_object(_fields, _unfiltered, taken, noise, [np.array([0.0, 0.0, 4.0, 0.0])])
    columns = _fields(found).reshape(-1, 3)
    left = noise - noise.mean(axis=0)
    moment = np.linalg.lstsq(columns, left.ravel(), rcond=None)[0]
    explained = np.sum(left**2) - np.sum((left.ravel() - columns @ moment) ** 2)
    assert explained < 40.0
