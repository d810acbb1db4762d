"""Effects that only imitate an error of another form are rejected, and the cause is unknown."""

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
    """The magnetometer rotated relative to the gyro by rotation vectors (N, 3)."""
    return replace(track, mag_b_gauss=Rotation.from_rotvec(angle_rad).apply(track.mag_b_gauss))


@pytest.mark.slow
def test_constant_misalignment_is_found() -> None:
    track = driven(3000)
    found = diagnose(turned(track, np.full((len(track), 3), 3e-3)))
    assert [one.effect for one in found.findings] == ["mag_gyro_misalignment"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_steadily_growing_misalignment_is_unknown(track: Track) -> None:
    share = np.linspace(0.0, 1.0, len(track))[:, None]
    found = diagnose(turned(track, share * np.array([6e-3, -4e-3, 5e-3])))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame in ("sensor", "gyro")


@pytest.mark.slow
def test_misalignment_that_settles_is_found_as_its_mean_with_an_unknown_rest(track: Track) -> None:
    """Its mean is the finding; how it reached its final value remains unknown."""
    warmth = 1.0 - np.exp(-3.0 * np.linspace(0.0, 1.0, len(track)))[:, None]
    turns_rad = warmth * np.array([12e-3, -8e-3, 10e-3])
    found = diagnose(turned(track, turns_rad))
    assert [one.effect for one in found.findings] == ["mag_gyro_misalignment"]
    values = [one.value for one in found.findings[0].parameters]
    assert values == pytest.approx(turns_rad.mean(axis=0), abs=1.5e-3)
    assert found.unexplained.detected


@pytest.mark.slow
def test_temporary_gyro_bias_is_not_a_pair_of_steps(track: Track) -> None:
    phase = np.clip((track.time_s - 120.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * phase)[:, None] ** 2 * np.array([6e-4, -5e-4, 7e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + bump))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"
