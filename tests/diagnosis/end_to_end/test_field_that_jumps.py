"""A field that jumps, and the filter that knows how strong it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.one_model.diagnose import diagnose

SAMPLES = 5000


@pytest.fixture(scope="module")
def made():
    return experiment("mam", samples=SAMPLES)


@pytest.fixture(scope="module")
def track(made):
    return track_of(made)


def test_a_filter_that_knows_the_strength_of_the_field_does_not_follow_it(made, track):
    model = true_model(made)
    second = np.arange(SAMPLES) > SAMPLES // 2
    field = (track.mag_b_gauss - model.hard_iron_gauss) @ np.linalg.inv(model.soft_iron)
    louder = np.where(second[:, None], 1.02 * field, field) @ model.soft_iron.T
    changed = replace(track, mag_b_gauss=louder + model.hard_iron_gauss)
    last = slice(SAMPLES - 500, SAMPLES)

    def off(**known):
        done = run_filter(changed, model, sensitive=False, **known)
        size = np.linalg.norm(done.nominal_b, axis=1)
        there = float(np.mean(np.linalg.norm(1.02 * field, axis=1)[last]))
        along = np.sum(done.innovation * done.nominal_b, axis=1) / size
        return float(np.mean(along[last])) / (there - float(size[0]))

    assert off(strength_known=True) == pytest.approx(1.0, abs=0.1)
    assert off() < 0.9


@pytest.fixture(scope="module")
def jumped(made, track):
    """The world's field jumps by a milligauss at 90 s."""
    jump = 1e-3 * np.array([0.6, -0.5, 0.6])
    turned = np.swapaxes(fit_null(track).context().R_nb, 1, 2) @ jump
    read = turned @ true_model(made).soft_iron.T
    later = (track.time_s - track.time_s[0] > 90.0)[:, None]
    return replace(track, mag_b_gauss=track.mag_b_gauss + later * read)


def test_a_field_that_jumps_has_its_name_and_its_time(jumped):
    """For some seconds it looks like a field of another strength."""
    found = diagnose(jumped)
    (step,) = found.findings
    assert step.effect == "field_step"
    assert step.setting["onset_s"] == pytest.approx(90.0, abs=0.5)
    assert step.confidence > 0.9
    assert not found.unexplained.detected
