"""A current that comes late into the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
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
