"""A source that is not in the library, with logged columns that correlate with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import coloured, experiment, track_of

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.samples import Array

AXIS = np.array([0.6, -0.7, 0.39]) / np.linalg.norm([0.6, -0.7, 0.39])
ACROSS = np.array([0.7, 0.6, 0.0]) / np.linalg.norm([0.7, 0.6, 0.0])
ROWS = 3500


def _slow(rng: np.random.Generator, highest_hz: float) -> Array:
    return coloured(rng, (ROWS,), (0.0, highest_hz))


def _found(added: Array, current: Array, speed: Array) -> Diagnosis:
    track = track_of(experiment("wam", seed=14, samples=ROWS, sigma_mag=5e-4))
    columns = {"motor_current_a": 12 + 4 * current, "speed_m_s": 2 + 0.6 * speed}
    return diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added).with_columns(columns))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4, 5, 6, 7, 8])
def test_columns_correlated_with_an_unlogged_source_are_not_reported_as_its_cause(
    seed: int,
) -> None:
    """The part they explain and the residual have one direction. It was once reported as a speed
    field.
    """
    rng = np.random.default_rng(seed)
    load = _slow(rng, 0.08)
    current = 0.6 * load + 0.8 * _slow(rng, 0.08)
    speed = 0.5 * load + 0.87 * _slow(rng, 0.05)
    found = _found(1.5e-3 * load[:, None] * AXIS, current, speed)
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where is not None
    assert abs(np.array(found.unexplained.where.direction) @ AXIS) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_current_is_found_with_an_unknown_source_of_another_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    current, load = _slow(rng, 0.08), _slow(rng, 0.08)
    added = 1.5e-3 * current[:, None] * AXIS + 1.5e-3 * load[:, None] * ACROSS
    found = _found(added, current, _slow(rng, 0.05))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    assert found.unexplained.detected
    assert found.unexplained.where is not None
    assert abs(np.array(found.unexplained.where.direction) @ ACROSS) > 0.95
