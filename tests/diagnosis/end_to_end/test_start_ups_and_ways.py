"""Settings that are a size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.effects.base import Readings, readings_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.one_model.diagnose import diagnose
from ahrsd.diagnosis.track import Track


def _quiet(seed: int) -> tuple[Track, Readings]:
    track = replace(made(Trial(seed=seed, samples=7000)).track, covariates={})
    return track, readings_of(fit_null(track, walk=False).context())


def test_a_start_up_between_the_grids_time_constants() -> None:
    track, readings = _quiet(4)
    effect = EFFECTS["gyro_startup"]
    setting = {"start_s": float(track.time_s[0]), "time_constant_s": 35.0}
    value = np.array([1.2e-3, -0.9e-3, 0.8e-3])
    changed = effect.simulate(readings, value, setting).gyro_b_rad_s
    answer = diagnose(
        replace(track, gyro_b_rad_s=track.gyro_b_rad_s + changed - readings.gyro_b_rad_s)
    )
    assert [one.effect for one in answer.findings] == ["gyro_startup"]
    found = answer.findings[0]
    assert abs(found.setting["time_constant_s"] / 35.0 - 1) < 0.15
    got = np.array([one.value for one in found.parameters])
    assert np.abs(got - value).max() < 1e-4


@pytest.mark.slow
def test_a_way_through_a_gradient_is_unknown_where_no_position_is_logged() -> None:
    """Most of it is a wave of some length, and the rest may look like bumps."""
    track, readings = _quiet(5)
    logged = made(Trial(seed=5, samples=7000)).track.covariates
    north, east = logged["position_north_m"], logged["position_east_m"]
    course = np.column_stack([0.1 * north + 0.05 * east, -0.06 * north, 0.08 * north]) * 1e-3
    changed = np.einsum("nji,nj->ni", readings.R_nb, course) @ readings.soft_iron.T
    answer = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + changed))
    assert answer.findings == ()
    assert answer.unexplained.detected
    assert answer.unexplained.where.frame == "world"
