"""A step of the world's field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.inference.diagnose import diagnose

SAMPLES = 5000
JUMP_GAUSS = 1e-3 * np.array([0.6, -0.5, 0.6])


@pytest.fixture(scope="module")
def made():
    return experiment("mam", samples=SAMPLES)


@pytest.fixture(scope="module")
def track(made):
    return track_of(made)


@pytest.fixture(scope="module")
def jumped(made, track):
    """The world's field changes by a milligauss at 90 s."""
    turned = np.swapaxes(fit_null(track).context().R_nb, 1, 2) @ JUMP_GAUSS
    read = turned @ true_model(made).soft_iron.T
    later = (track.time_s - track.time_s[0] > 90.0)[:, None]
    return replace(track, mag_b_gauss=track.mag_b_gauss + later * read)


@pytest.mark.slow
def test_field_step_is_found_with_its_time_and_size(jumped):
    """For some seconds it looks like a change of the field's strength."""
    found = diagnose(jumped)
    (step,) = found.findings
    assert step.effect == "field_step"
    assert step.setting["onset_s"] == pytest.approx(90.0, abs=2.0)
    for found_, true in zip(step.parameters, JUMP_GAUSS, strict=True):
        assert abs(found_.value - true) < 3 * found_.std < 6e-4
    assert step.confidence > 0.9
    assert not found.unexplained.detected
