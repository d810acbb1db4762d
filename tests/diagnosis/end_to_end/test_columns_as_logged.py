"""Columns that a logger held or added noise to: one finding, and no residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.ndimage import gaussian_filter1d
from tracks import experiment, track_of

from ahrsd.diagnosis.inference.diagnose import diagnose_logged

RATE_HZ = 25.0
FIELD_PER_M_S = np.array([9e-3, -6e-3, 4e-3])


def held(values, rows):
    return values[(np.arange(len(values)) // rows) * rows]


@pytest.mark.slow
def test_current_held_at_five_hertz_is_a_single_finding():
    one = made(
        Trial(seed=11, effects=(("motor_current_field", 1.0),), samples=8_000, rate_hz=RATE_HZ)
    )
    current = held(one.track.covariates["motor_current_a"], 5)
    track = one.track.with_columns({**one.track.covariates, "motor_current_a": current})
    found = diagnose_logged(track)
    # a held column is delayed, which a field by the current's derivative would explain
    assert [x.effect for x in found.findings] == ["motor_current_field"]
    assert not found.unexplained.detected
    assert (
        "column motor_current_a has a new value every 0.2 s: interpolated linearly" in found.notes
    )
    _, value, _ = one.truth[0]
    np.testing.assert_allclose([p.value for p in found.findings[0].parameters], value, rtol=0.02)


def smooth_values(seed: int, rows: int, width: float = 120.0) -> np.ndarray:
    """Smooth values with unit standard deviation."""
    values = gaussian_filter1d(np.random.default_rng(seed).normal(size=rows), width)
    return values / values.std()


def logged_values(values: np.ndarray, rows: int) -> np.ndarray:
    """One value every `rows` rows, linear interpolation between, four decimals as in a file."""
    at = np.arange(0, len(values), rows)
    return np.round(np.interp(np.arange(len(values)), at, values[at]), 4)


@pytest.mark.slow
def test_speed_field_is_found_from_a_noisy_column_without_residual() -> None:
    track = track_of(experiment("wam", motion="rov", seed=4, samples=3000, rate_hz=12.5))
    speed = 1.2 + 0.25 * smooth_values(10, 3000)
    mag = track.mag_b_gauss + speed[:, None] * FIELD_PER_M_S
    noisy = logged_values(speed + np.random.default_rng(11).normal(0.0, 0.05, 3000), 3)
    found = diagnose_logged(replace(track, mag_b_gauss=mag).with_columns({"speed_m_s": noisy}))
    assert [one.effect for one in found.findings] == ["speed_field"]
    assert not found.unexplained.detected
    assert any(note.startswith("column speed_m_s is noisy: ") for note in found.notes)
    for value, truth in zip(found.findings[0].parameters, FIELD_PER_M_S, strict=True):
        assert value.value == pytest.approx(truth, rel=0.05)
