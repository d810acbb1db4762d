"""Thinning keeps rotations and the field to second order in the error of the calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.resampling import (
    average_groups,
    decimate,
    thin_factor,
    working_factor,
)
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Track

FIELD = np.array([0.3, 0.1, 0.4])


def turning(count: int = 450, dt: float = 0.02) -> tuple[Track, np.ndarray]:
    """A noise-free track in brisk motion and its R_nb."""
    t = np.arange(count) * dt
    rate = np.column_stack([2 * np.sin(3 * t), 1.5 * np.cos(2 * t), 0.8 + 0 * t])
    R_nb = np.empty((count, 3, 3))
    R_nb[0] = np.eye(3)
    turn = so3.exp(rate * dt)
    for k in range(1, count):
        R_nb[k] = R_nb[k - 1] @ turn[k]
    A = np.diag([1.1, 0.9, 1.0])
    mag = np.einsum("nji,j->ni", R_nb, [0.2, 0.1, 0.4]) @ A + [0.05, -0.02, 0.1]
    step = np.full(count, dt)
    step[0] = np.nan
    logged = {"a": t.copy()}
    track = Track(t, step, mag, rate, np.outer(t, [0.0, 1.0, -2.0]), logged, (slice(0, count),))
    return track, R_nb


def model(hard_iron: list[float]) -> NullModel:
    return NullModel(np.diag([1.1, 0.9, 1.0]), np.array(hard_iron), np.zeros(3), 1e-3, 1e-3)


@pytest.mark.parametrize("m", [2, 3, 4, 5, 6, 7])
def test_averaged_groups_have_the_turn_and_reading_of_their_middle_sample(m):
    track, R_nb = turning()
    thin = average_groups(track, m, model([0.05, -0.02, 0.1]))
    middle = np.arange(len(thin)) * m + m // 2
    np.testing.assert_allclose(thin.time_s, track.time_s[middle], atol=1e-12)
    centre = track.time_s[middle] - (0.0 if m % 2 else track.time_s[1] / 2)
    np.testing.assert_allclose(thin.covariates["a"], centre, atol=1e-12)
    np.testing.assert_allclose(thin.accel_b_m_s2[:, 1], track.time_s[middle], atol=1e-12)
    np.testing.assert_allclose(thin.mag_b_gauss, track.mag_b_gauss[middle], atol=1e-12)
    turn = so3.exp(thin.gyro_b_rad_s[1:] * thin.dt_s[1:, None])
    expected = np.swapaxes(R_nb[middle[:-1]], 1, 2) @ R_nb[middle[1:]]
    np.testing.assert_allclose(turn, expected, atol=1e-12)


def test_averaging_is_insensitive_to_a_wrong_hard_iron():
    track, _ = turning()
    right, wrong = (
        average_groups(track, 3, model(b)) for b in ([0.05, -0.02, 0.1], [0.06, -0.02, 0.1])
    )
    error = np.abs(wrong.mag_b_gauss - right.mag_b_gauss).max()
    assert 0 < error < 0.01 * 0.01  # below a hundredth of the error in hard iron


def test_thinned_rate_stays_above_the_wanted_rate():
    track, _ = turning()
    assert [thin_factor(track, hz) for hz in (60.0, 30.0, 16.0, 12.0, 10.0, 7.0)] == [
        1,
        1,
        3,
        4,
        5,
        7,
    ]


def test_thinning_factor_below_one_is_refused():
    with pytest.raises(ValueError, match="cannot keep one sample in 0"):
        average_groups(turning()[0], 0, model([0.0, 0.0, 0.0]))


def test_disturbance_and_its_column_are_averaged_alike():
    """An offset of half a sample would make a varying current look delayed."""
    track, _ = turning()
    current = np.sin(2 * track.time_s)
    still = replace(
        track,
        gyro_b_rad_s=np.zeros_like(track.gyro_b_rad_s),
        mag_b_gauss=np.outer(current, [0.01, 0.02, -0.01]) + FIELD,
        covariates={"current_a": current},
    )
    for m in (3, 4):
        thin = average_groups(still, m, model([0.05, -0.02, 0.1]))
        expected = np.outer(thin.covariates["current_a"], [0.01, 0.02, -0.01]) + FIELD
        np.testing.assert_allclose(thin.mag_b_gauss, expected, atol=1e-12)


def test_lost_turns_are_summed_and_their_step_share_is_divided_when_averaging():
    track, _ = turning()
    lost = np.linspace(0.0, 0.02, len(track))
    thin = average_groups(replace(track, lost_turns=lost), 3, model([0.05, -0.02, 0.1]))
    assert thin.step_share == pytest.approx(1 / 3)
    middle = np.arange(1, len(thin)) * 3 + 1
    np.testing.assert_allclose(thin.lost_turns[1:], 3 * (lost[middle] - lost[1]), atol=1e-12)
    assert average_groups(track, 3, model([0.05, -0.02, 0.1])).lost_turns is None


@pytest.mark.parametrize(("sigma_gyro", "samples"), [(5e-3, 3), (8e-3, 2), (5e-2, 1)])
def test_working_factor_keeps_the_noise_of_rows_white(sigma_gyro: float, samples: int) -> None:
    """Three samples at 25 Hz, fewer if the gyro adds more than half of a reading's noise within
    them.

    With a gyro noise of 0.05 rad/s and 1 mG, rows of three would share a tenth of their noise with
    the next row.
    """
    made = experiment("mam", motion="slow", samples=3000, sigma_gyro=sigma_gyro)
    assert working_factor(track_of(made), true_model(made)) == samples


def test_decimation_composes_rotations_exactly() -> None:
    track = track_of(experiment("wam", samples=400))
    coarse = decimate(track, 5)
    assert len(coarse) == 80
    by_one = np.eye(3)
    for k in range(5, 10):
        by_one = by_one @ so3.exp(track.gyro_b_rad_s[k] * track.dt_s[k])
    assert np.abs(so3.exp(coarse.gyro_b_rad_s[1] * coarse.dt_s[1]) - by_one).max() < 1e-12
    assert np.array_equal(coarse.mag_b_gauss[1], track.mag_b_gauss[9])
    assert np.isnan(coarse.dt_s[0])


def test_decimation_selects_rows_with_readings_and_keeps_the_whole_turn() -> None:
    track = track_of(experiment("wam", samples=400))
    mag = track.mag_b_gauss.copy()
    mag[np.arange(400) % 4 != 1] = np.nan
    coarse = decimate(replace(track, mag_b_gauss=mag), 5)
    assert np.isfinite(coarse.mag_b_gauss).all()
    # the total rotation is kept for any grouping
    whole, composed = np.eye(3), np.eye(3)
    last = round(float(coarse.time_s[-1] / 0.04)) - 1
    for k in range(1, last + 1):
        whole = whole @ so3.exp(track.gyro_b_rad_s[k] * 0.04)
    first = round(float(coarse.time_s[0] / 0.04)) - 1
    for k in range(1, first + 1):
        composed = composed @ so3.exp(track.gyro_b_rad_s[k] * 0.04)
    for rate, length in zip(coarse.gyro_b_rad_s[1:], coarse.dt_s[1:], strict=True):
        composed = composed @ so3.exp(rate * length)
    assert np.abs(whole - composed).max() < 1e-9
