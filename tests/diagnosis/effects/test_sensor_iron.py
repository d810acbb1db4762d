"""Shapes of a drift of the hard iron."""

from __future__ import annotations

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.effects.library import EFFECTS


def test_every_drift_shape_goes_from_zero_to_the_whole_change() -> None:
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
