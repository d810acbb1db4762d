"""A decaying oscillation on the sensor is located and remains unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose

TIMES_S = np.array([21.0, 62.0, 85.5, 120.0, 171.0, 203.0])


def rung(time_s: np.ndarray) -> np.ndarray:
    """(N,) oscillations at 0.8 Hz that decay within some seconds."""
    since = time_s[:, None] - TIMES_S
    swing = np.exp(-np.maximum(since, 0.0) / 1.5) * np.cos(2 * np.pi * 0.8 * since)
    return np.where(since > 0, swing, 0.0).sum(axis=1)


@pytest.mark.slow  # bursts, which are reported alike, are a short test: test_bursts_located
def test_decaying_oscillations_are_an_unknown_cause_with_their_onsets() -> None:
    quiet = replace(made(Trial(seed=8, samples=6000)).track, covariates={})
    field = np.outer(rung(quiet.time_s), [1.5e-3, -1.0e-3, 1.2e-3])
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + field))
    assert answer.findings == ()
    assert answer.unexplained.detected
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
    begins = np.array(where.intervals_s)[:, 0]
    assert np.abs(begins[:, None] - TIMES_S).min(axis=1).max() < 2.0
    assert np.abs(begins[:, None] - TIMES_S).min(axis=0).max() < 2.0
