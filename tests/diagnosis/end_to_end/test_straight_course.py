"""A vehicle that turned before an event and hardly turns afterwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


def _straight(seed: int, straight_s: float, swings_deg: float) -> Track:
    """Turns in any attitude; from `straight_s` on, slow swings by `swings_deg` about its own z."""
    made = experiment("wam", seed=seed, samples=3000, sigma_mag=1e-3)
    track, truth, rng = track_of(made), made.truth, np.random.default_rng(seed)
    first = int(np.searchsorted(track.time_s, straight_s))
    since_s = track.time_s[first:] - track.time_s[first]
    angle = np.radians(swings_deg) * np.sin(2 * np.pi * since_s / 37.0)
    about_z = np.array([0.0, 0.0, 1.0])
    turns = np.array([so3.exp(one * about_z) for one in angle])
    field_b = np.einsum("nji,j->ni", turns, made.field_b[first])
    rate = np.gradient(angle, since_s)[:, None] * about_z
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    mag[first:] = field_b @ np.asarray(truth.soft_iron).T + truth.hard_iron_gauss
    mag[first:] += 1e-3 * rng.normal(size=rate.shape)
    gyro[first:] = rate + truth.gyro_bias_rad_s + 5e-4 * rng.normal(size=rate.shape)
    return replace(track, mag_b_gauss=mag, gyro_b_rad_s=gyro, accel_b_m_s2=None)


@pytest.mark.slow
def test_magnet_brought_by_hand_on_a_straight_course_is_a_hard_iron_step() -> None:
    """As plain steps a field step was more probable; with the forms of the hand's motion it is
    not.
    """
    track, step = _straight(2, 52.0, 2.0), np.array([-0.026, 0.129, 0.054])
    there = np.clip((track.time_s - 60.0) / 2.0, 0.0, 1.0)
    there = there**2 * (3.0 - 2.0 * there)
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + there[:, None] * step))
    (one,) = found.findings
    assert one.effect == "hard_iron_step"
    assert one.confidence > 0.9
    for value, truth in zip(one.parameters, step, strict=True):
        assert value.value == pytest.approx(truth, abs=max(3.0 * value.std, 2e-3))
