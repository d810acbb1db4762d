"""Harmonics of the heading, which no column and no effect describes."""

from __future__ import annotations

import numpy as np
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.where_and_when.regime import HARMONICS, heading_columns


def test_heading_columns_are_the_harmonics_of_the_heading() -> None:
    context = fit_null(track_of(experiment("wam", samples=1500)), walk=False).context()
    columns = heading_columns(context).mag
    assert columns.shape == (len(context.track), 3, 6 * HARMONICS)
    R_nb = context.R_nb[17]
    heading_rad = np.arctan2(R_nb[1, 0], R_nb[0, 0])
    # the second cosine, and the third sine, on the third axis
    assert np.allclose(columns[17, :, 5], [0, 0, np.cos(2 * heading_rad) / 2])
    assert np.allclose(columns[17, :, 3 * (HARMONICS + 2) + 2], [0, 0, np.sin(3 * heading_rad) / 3])
