"""Effect of an added field on the calibration and on the heading."""

from __future__ import annotations

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.answer.added_field import (
    calibration_basis,
    heading_deviation_deg,
    project_out_calibration,
    rms_about_mean,
)
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.model import Context


@pytest.fixture(scope="module")
def context() -> Context:
    track = track_of(experiment("wam", seed=8, samples=3000))
    return fit_null(track, walk=False).context()


def test_iron_field_is_absorbed_by_the_calibration(context: Context) -> None:
    take = calibration_basis(context)
    iron = context.field_b @ np.array([[0.1, 0.02, 0], [0.02, -0.1, 0.03], [0, 0.03, 0]]) + 0.05
    assert rms_about_mean(iron) > 0.01
    assert rms_about_mean(project_out_calibration(iron, take)) < 1e-12


def test_heading_error_follows_the_field_across_the_horizontal_field(context: Context) -> None:
    field = context.field_b @ context.model.soft_iron.T
    read = np.einsum("nij,nj->ni", context.R_nb, field).mean(axis=0)
    level = float(np.hypot(*read[:2]))
    across = np.array([-read[1], read[0], 0.0]) / level
    sign = np.where(np.arange(len(context.track)) % 2, 1.0, -1.0)[:, None]
    added = np.einsum("nji,j->ni", context.R_nb, 5e-3 * across) * sign
    assert heading_deviation_deg(added, context) == pytest.approx(
        np.degrees(5e-3 / level), rel=0.02
    )
    along = np.einsum("nji,j->ni", context.R_nb, 5e-3 * read / np.linalg.norm(read)) * sign
    assert heading_deviation_deg(along, context) < 0.05 * heading_deviation_deg(added, context)
