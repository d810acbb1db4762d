"""What is told beside a remainder, with the sensor's own mount and scales free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.delay import delayed_gyro
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.rules.findings import refined
from ahrsd.diagnosis.rules.itself import ITSELF, USUAL, beside_itself, gyro_matrix
from ahrsd.diagnosis.rules.regression import Base, base
from ahrsd.diagnosis.rules.spectrum import against, spectrum_of
from ahrsd.diagnosis.track import Track

LAG_S = 2e-3


def late(angle: float) -> Track:
    """A lag beside a mount that is off by `angle`, rad, in hand-like turns."""
    track = track_of(experiment("mam", motion="rov", samples=4000))
    turned = track.mag_b_gauss @ so3.exp(angle * np.array([[0.5, -0.7, 0.5]]))[0].T
    return delayed_gyro(replace(track, mag_b_gauss=turned), -LAG_S)


def basis_of(track: Track) -> Base:
    fit = fit_null(track, walk=False)
    context = fit.context()
    lag = EFFECTS["mag_time_lag"]
    columns = lag.columns(context, lag.settings(context)[0])
    return base(context, fit.filtered, [("term 0", columns)], 25.0)


def test_the_matrix_is_what_a_mount_and_a_scale_do() -> None:
    context = fit_null(late(0.0), walk=False).context()
    matrix = gyro_matrix(context).gyro
    W = np.arange(9.0).reshape(3, 3)
    np.testing.assert_allclose(matrix @ W.ravel(), context.rate_b_rad_s @ W.T)


def test_a_mount_of_a_degree_does_not_move_a_lag() -> None:
    basis = basis_of(late(0.025))
    plain = against(basis, spectrum_of(basis))
    off = abs(refined(plain, 0)[0][0] - LAG_S)
    value, deviation = refined(beside_itself(plain, ["mag_time_lag"]), 0)
    assert abs(value[0] - LAG_S) < min(3 * deviation[0], off)


def test_of_the_matrix_no_more_is_believed_than_sensors_have() -> None:
    """Without motion nothing is known of it but that."""
    basis = basis_of(late(0.0))
    none = np.zeros((4000, 3))
    at_rest = replace(basis.context, rate_b_rad_s=none, others_rate_b_rad_s=none)
    still = replace(basis, context=at_rest)
    told = beside_itself(still, [])
    flat = told.known.reshape(-1, told.known.shape[2])[:, told.groups[ITSELF]]
    deviation = np.sqrt(told.colour / np.diag(flat.T @ flat))
    np.testing.assert_allclose(deviation, USUAL)


@pytest.mark.parametrize("name", ["mag_gyro_misalignment", "gyro_scale"])
def test_what_is_a_part_of_the_matrix_is_told_without_it(name: str) -> None:
    basis = basis_of(late(0.0))
    assert ITSELF not in beside_itself(basis, [name]).groups
    assert ITSELF in beside_itself(basis, ["mag_time_lag"]).groups
