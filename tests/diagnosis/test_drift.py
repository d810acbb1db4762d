"""A hard iron that settles: one course, one name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.rules.engine import diagnose


def test_a_warm_up_that_nobody_logged_is_one_drift() -> None:
    quiet = replace(made(Trial(seed=8)).track, covariates={})
    passed_s = quiet.time_s - quiet.time_s[0]
    part = -np.expm1(-passed_s / 90.0) / -np.expm1(-passed_s[-1] / 90.0)
    field = part[:, None] * np.array([2e-3, -3e-3, 1.5e-3])
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + field))
    assert [one.effect for one in answer.findings] == ["hard_iron_drift"]
    assert not answer.unexplained.detected
    found = [one.value for one in answer.findings[0].parameters]
    assert found == pytest.approx([2e-3, -3e-3, 1.5e-3], abs=2e-4)
    assert answer.findings[0].setting["time_constant_s"] == pytest.approx(90.0, rel=0.2)


def test_every_shape_of_a_drift_goes_from_nothing_to_the_whole_change() -> None:
    readings = made(Trial(seed=8, samples=3000)).track  # 120 s
    drift = EFFECTS["hard_iron_drift"]
    span = {"start_s": float(readings.time_s[0]), "span_s": float(np.ptp(readings.time_s))}
    shapes = [
        {**span, "shape": "line"},
        {**span, "shape": "log", "relaxation_s": 10.0},
        {**span, "shape": "settling", "time_constant_s": 20.0},
    ]
    half = len(readings) // 2
    for setting, middle in zip(shapes, (0.5, 0.759, 0.953), strict=True):
        mag = drift.terms(readings, setting).mag
        assert mag is not None
        assert mag[0] == pytest.approx(np.zeros((3, 3)))
        assert mag[-1] == pytest.approx(np.eye(3))
        assert mag[half, 1, 1] == pytest.approx(middle, abs=0.01)
