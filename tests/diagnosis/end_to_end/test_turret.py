"""A field that depends on the heading or the tilt is unknown and fixed to the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.spatial.transform import Rotation

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track
from ahrsd.simulation import simulate


def turret(gauss: float) -> Track:
    """Four waves per turn, with another phase on each axis."""
    trial = made(Trial(4))
    R_nb = simulate(trial.settings).R_nb
    phase = 4 * np.arctan2(R_nb[:, 1, 0], R_nb[:, 0, 0])[:, None]
    field_b = np.cos(phase) * [0.6, 0.0, 0.8] + np.sin(phase) * [0.0, 1.0, 0.0]
    return replace(trial.track, mag_b_gauss=trial.track.mag_b_gauss + gauss * field_b)


@pytest.mark.slow
@pytest.mark.parametrize("library", [{}, EFFECTS])
def test_weak_field_by_heading_is_unknown_and_on_the_vehicle(library) -> None:
    """60 uG, 29 nats: free processes in time and the effects of the library do not describe it."""
    found = diagnose(turret(6e-5), library=library)
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "sensor"


@pytest.mark.slow
def test_no_field_by_heading_is_found_when_there_is_none() -> None:
    assert not diagnose(turret(0.0), library={}).unexplained.detected


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 7])
def test_magnet_kept_level_by_a_gimbal_is_not_a_sensor_error(seed: int) -> None:
    """2 mG. Effects that depend on the field's direction in the sensor explain most of it."""
    trial = made(Trial(seed))
    down = simulate(trial.settings).R_nb[:, 2]
    pitch, roll = -np.arcsin(down[:, 0]), np.arctan2(down[:, 1], down[:, 2])
    level = np.column_stack([np.zeros(len(down)), -pitch, np.zeros(len(down))])
    field_b = Rotation.from_rotvec(level).apply([0.6, -0.64, 0.48])
    leaning = np.column_stack([-roll, np.zeros((len(down), 2))])
    field_b = Rotation.from_rotvec(leaning).apply(field_b)
    found = diagnose(replace(trial.track, mag_b_gauss=trial.track.mag_b_gauss + 2e-3 * field_b))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "sensor"
