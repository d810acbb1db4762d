"""Settings that are a size: sought between the values of their grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mismatch_trials import Trial, made

from ahrsd.mismatch.effects.base import Readings, readings_of
from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.engine import diagnose
from ahrsd.mismatch.null import fit_null
from ahrsd.mismatch.track import Track


def _quiet(seed: int) -> tuple[Track, Readings]:
    track = replace(made(Trial(seed=seed, samples=7000)).track, covariates={})
    return track, readings_of(fit_null(track, walk=False).context())


def test_a_compensation_on_board_is_named_once_with_its_part() -> None:
    track, readings = _quiet(3)
    effect = EFFECTS["onboard_calibration_active"]
    setting = {"onset_s": float(track.time_s[0]), "time_constant_s": 105.0}
    changed = effect.simulate(readings, np.array([0.3, 0.02]), setting).mag_b_gauss
    answer = diagnose(
        replace(track, mag_b_gauss=track.mag_b_gauss + changed - readings.mag_b_gauss)
    )
    assert [one.effect for one in answer.findings] == ["onboard_calibration_active"]
    found = answer.findings[0]
    assert abs(found.parameters[0].value - 0.3) < 0.02
    assert abs(found.parameters[1].value - 0.02) < 0.005
    assert abs(found.setting["time_constant_s"] / 105.0 - 1) < 0.15
    assert found.where.frame == "sensor"


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
