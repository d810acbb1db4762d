"""Names that only stand in for something of another form are taken back: unknown, there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.spatial.transform import Rotation

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    return driven(7500)


def driven(samples: int) -> Track:
    trial = Trial(seed=11, samples=samples, rate_hz=25.0, scenario="wam", noise="white")
    return made(trial).track


def turned(track: Track, angle_rad: np.ndarray) -> Track:
    """The magnetometer turned against the gyro by rotation vectors (N, 3)."""
    return replace(track, mag_b_gauss=Rotation.from_rotvec(angle_rad).apply(track.mag_b_gauss))


@pytest.mark.slow
def test_a_mount_that_stays_crooked_has_a_name() -> None:
    track = driven(3000)
    found = diagnose(turned(track, np.full((len(track), 3), 3e-3)))
    assert [one.effect for one in found.findings] == ["mag_gyro_misalignment"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_a_mount_that_bends_more_and_more_has_none(track: Track) -> None:
    share = np.linspace(0.0, 1.0, len(track))[:, None]
    found = diagnose(turned(track, share * np.array([6e-3, -4e-3, 5e-3])))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame in ("sensor", "gyro")


@pytest.mark.slow
def test_a_mount_that_bends_fast_and_then_stays_is_no_crowd_of_names(track: Track) -> None:
    """It has its mean turn, and beside it something unknown: how it came to that."""
    warmth = 1.0 - np.exp(-3.0 * np.linspace(0.0, 1.0, len(track)))[:, None]
    turns_rad = warmth * np.array([12e-3, -8e-3, 10e-3])
    found = diagnose(turned(track, turns_rad))
    assert [one.effect for one in found.findings] == ["mag_gyro_misalignment"]
    values = [one.value for one in found.findings[0].parameters]
    assert values == pytest.approx(turns_rad.mean(axis=0), abs=1.5e-3)
    assert found.unexplained.detected


@pytest.mark.slow
def test_a_gyro_bias_that_comes_and_goes_is_no_pair_of_steps(track: Track) -> None:
    phase = np.clip((track.time_s - 120.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * phase)[:, None] ** 2 * np.array([6e-4, -5e-4, 7e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + bump))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
