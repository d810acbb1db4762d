"""A current that comes late into the log, or as a mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.late import in_time
from ahrsd.diagnosis.rules.regression import base
from ahrsd.diagnosis.rules.settings import best_settings


@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_the_current_is_moved_to_its_time_and_only_then(late_s: float):
    track = track_of(experiment("wam", motion="rov", samples=3000))
    rng = np.random.default_rng(3)
    levels = np.repeat(rng.uniform(0.0, 10.0, 100), 30)
    field = levels[:, None] * np.array([0.4e-3, -0.3e-3, 0.5e-3])
    logged = np.interp(track.time_s - late_s, track.time_s, levels)
    track = replace(
        track, mag_b_gauss=track.mag_b_gauss + field, covariates={"motor_current_a": logged}
    )
    fit = fit_null(track, walk=False)
    basis = base(fit.context(), fit.filtered, [], 25.0)
    library = {"motor_current_field": EFFECTS["motor_current_field"]}
    (found,) = [in_time(basis, c) for c in best_settings(basis, library, [])]
    assert found.setting.get("late_s", 0.0) == pytest.approx(late_s, abs=0.051)
    assert found.evidence > 50.0


@pytest.mark.parametrize(
    ("memory_s", "mean_s"), [(0.5, 0.4), pytest.param(6.0, 0.2, marks=pytest.mark.slow)]
)
def test_a_current_that_is_logged_as_a_mean_has_its_field_and_no_field_of_its_change(
    memory_s: float, mean_s: float
):
    """Its mean comes late by half of it; what else it lacks is the current's second difference."""
    track = track_of(experiment("wam", seed=16, samples=4000))
    kept, count = np.exp(-track.step_s / memory_s), round(mean_s / track.step_s)
    drawn = np.random.default_rng(16).normal(0.0, np.sqrt(1 - kept**2), len(track))
    amps = 6.0 + 2.5 * lfilter([1.0], [1.0, -kept], drawn)
    before = np.concatenate([np.full(count - 1, amps[0]), amps])
    logged = np.convolve(before, np.ones(count) / count, "valid")
    per_ampere = np.array([1.2e-3, -0.7e-3, 0.5e-3])
    mag = track.mag_b_gauss + amps[:, None] * per_ampere
    found = diagnose(replace(track, mag_b_gauss=mag, covariates={"motor_current_a": logged}))
    (one,) = found.findings
    assert one.effect == "motor_current_field"
    assert one.setting["mean_s"] == mean_s
    assert one.setting["late_s"] == pytest.approx((count - 1) / 2 * track.step_s, abs=0.03)
    np.testing.assert_allclose([p.value for p in one.parameters], per_ampere, rtol=0.05)
    assert not found.unexplained.detected
