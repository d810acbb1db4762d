"""A field that turns with the heading, which no column and no name has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import refined
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.refined import heading_nats
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.diagnosis.where_and_when.by_heading import HARMONICS, heading_columns
from ahrsd.simulation import simulate


def turret(gauss: float) -> Track:
    """Four waves in a turn, each axis of the turret's own."""
    trial = made(Trial(4))
    R_nb = simulate(trial.settings).R_nb
    phase = 4 * np.arctan2(R_nb[:, 1, 0], R_nb[:, 0, 0])[:, None]
    field_b = np.cos(phase) * [0.6, 0.0, 0.8] + np.sin(phase) * [0.0, 1.0, 0.0]
    return replace(trial.track, mag_b_gauss=trial.track.mag_b_gauss + gauss * field_b)


def basis_of(track: Track):
    problem, cold = problem_of(track, Spec(), {}, LIMITS)
    return formed_basis_of(State(problem, fit_null(problem.track, problem.spec, cold, walk=False)))


def test_waves_by_hand() -> None:
    basis = basis_of(turret(0.0))
    columns = heading_columns(basis.context).mag
    assert columns.shape == (len(basis.context.track), 3, 6 * HARMONICS)
    R_nb = basis.context.R_nb[17]
    heading_rad = np.arctan2(R_nb[1, 0], R_nb[0, 0])
    # the second cosine, and the third sine, on the third axis
    assert np.allclose(columns[17, :, 5], [0, 0, np.cos(2 * heading_rad) / 2])
    assert np.allclose(columns[17, :, 3 * (HARMONICS + 2) + 2], [0, 0, np.sin(3 * heading_rad) / 3])


def test_what_a_turret_is_worth_and_what_noise_is() -> None:
    assert heading_nats(basis_of(turret(0.0))) < np.log(100.0)
    assert heading_nats(basis_of(turret(5e-4))) > np.log(1e6)


def test_without_a_field_by_heading_a_weak_turret_is_not_seen(monkeypatch) -> None:
    monkeypatch.setattr(refined, "heading_nats", lambda _: -1.0)
    assert not diagnose(turret(6e-5), library={}).unexplained.detected
