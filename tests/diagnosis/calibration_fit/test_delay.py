"""Correction of a delayed sensor: the gyro exactly, and the columns logged with a magnetometer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_motion import moving
from tracks import experiment, track_of

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.delay import (
    delayed_gyro,
    is_magnetometer_lag,
    low_pass_beyond_delay,
    regular_step,
    without_early_readings,
    without_lag,
)
from ahrsd.diagnosis.track import Track


def attitude(t: np.ndarray) -> np.ndarray:
    """A smooth attitude, the product of two rotations."""
    first = so3.exp(np.outer(np.sin(1.3 * t), [0.3, -0.8, 0.4]))
    return first @ so3.exp(np.outer(np.cos(0.9 * t), [0.5, 0.2, 0.6]))


def rates(t: np.ndarray) -> np.ndarray:
    R = attitude(t)
    mean = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / np.diff(t)[:, None]
    return np.vstack([mean[:1], mean])


@pytest.mark.parametrize("tau", [0.013, 0.04, -0.027])
def test_delayed_gyro_has_the_rates_of_the_earlier_instants(tau):
    t = np.arange(0.0, 20.0, 0.02)
    dt = np.concatenate([[np.nan], np.diff(t)])
    track = Track(t, dt, np.zeros((len(t), 3)), rates(t), None, {}, (slice(0, len(t)),))
    moved = delayed_gyro(track, tau).gyro_b_rad_s
    expected = rates(t - tau)
    inner = slice(5, -5)
    before = np.abs(track.gyro_b_rad_s - expected)[inner].max()
    after = np.abs(moved - expected)[inner].max()
    assert after < 0.002 * before


def test_zero_delay_returns_the_same_track():
    t = np.arange(10.0)
    track = Track(t, t, np.zeros((10, 3)), np.ones((10, 3)), None, {}, (slice(0, 10),))
    assert delayed_gyro(track, 0.0) is track


def test_irregular_steps_have_no_regular_step():
    """With one sample of seven missing, a delay of half a step is no sampling convention."""
    t = 0.025 * np.arange(4000)
    dt = np.diff(t, prepend=np.nan)
    assert regular_step(dt) == pytest.approx(0.025)
    kept = np.delete(t, np.arange(3, 4000, 7))
    assert regular_step(np.diff(kept, prepend=np.nan)) is None


@pytest.mark.parametrize(
    ("lag_s", "late"),
    [(0.07, True), (0.016, True), (0.0125, False), (0.0122, False), (-0.02, False), (0.0, False)],
)
def test_half_a_step_is_a_gyro_convention_and_does_not_move_the_columns(lag_s, late):
    """Steps are 25 ms. A gyro that reports the rate at the instant is early by half a step."""
    time_s = np.arange(200) * 0.025
    zeros = np.zeros((200, 3))
    track = Track(
        time_s=time_s,
        dt_s=np.r_[np.nan, np.diff(time_s)],
        mag_b_gauss=np.tile([0.2, 0.0, 0.4], (200, 1)),
        gyro_b_rad_s=zeros,
        accel_b_m_s2=None,
        covariates={"motor_current_a": np.sin(time_s)},
    )
    assert is_magnetometer_lag(track, lag_s) is late
    moved = without_lag(track, lag_s).covariates["motor_current_a"]
    wanted = np.sin(time_s - lag_s) if late else np.sin(time_s)
    np.testing.assert_allclose(moved[10:], wanted[10:], atol=2e-3 if late else 0.0)


def test_low_pass_beyond_delay_matches_the_closed_form_for_a_steady_turn():
    """LP(h) - h(t - tau) of a field that turns steadily: the low-pass response is 1 / (1 + i w
    tau).
    """
    tau, rate = 0.05, 1.5
    t = 0.02 * np.arange(2000)
    dt = np.diff(t, prepend=np.nan)
    late = np.exp(1j * rate * (t - tau))
    context, _ = moving(1, rows=len(t))
    turning = np.tile([0.0, 0.0, -rate], (len(t), 1))
    context = replace(
        context,
        track=replace(context.track, time_s=t, dt_s=dt),
        field_b=np.column_stack([late.real, late.imag, np.zeros(len(t))]),
        rate_b_rad_s=turning,
        model=replace(context.model, soft_iron=np.eye(3)),
    )
    expected = np.exp(1j * rate * t) / (1 + 1j * rate * tau) - late
    found = low_pass_beyond_delay(context, tau).mag
    assert found is not None
    inner = slice(5, -5)
    error = np.abs(found[inner, 0, 0] + 1j * found[inner, 1, 0] - expected[inner])
    assert error.max() < 0.05 * np.abs(expected).max()


def logged(t: np.ndarray) -> Track:
    """A current, a lamp and a specific force logged with a gyro, in two runs with a pause."""
    dt = np.diff(t, prepend=np.nan)
    dt[500] = np.nan
    t = np.concatenate([t[:500], t[500:] + 7.0])
    columns = {"motor_current_a": 3 + np.sin(0.8 * t), "lamp_on": (np.sin(0.3 * t) > 0) * 1.0}
    force = np.column_stack([np.sin(t), np.cos(t), t])
    runs = (slice(0, 500), slice(500, len(t)))
    return Track(t, dt, np.zeros((len(t), 3)), rates(t), force, columns, runs)


def test_columns_and_force_are_delayed_with_a_delayed_magnetometer() -> None:
    track = logged(np.arange(0.0, 20.0, 0.02))
    moved = without_lag(track, 0.05)
    t = track.time_s - 0.05
    inner = np.r_[5:500, 505 : len(t)]
    np.testing.assert_array_equal(moved.gyro_b_rad_s, delayed_gyro(track, 0.05).gyro_b_rad_s)
    np.testing.assert_array_equal(moved.mag_b_gauss, track.mag_b_gauss)
    current = moved.covariates["motor_current_a"]
    np.testing.assert_allclose(current[inner], 3 + np.sin(0.8 * t[inner]), atol=1e-4)
    assert moved.accel_b_m_s2 is not None
    np.testing.assert_allclose(moved.accel_b_m_s2[inner, 2], t[inner], atol=1e-9)
    # the first samples of a run have no earlier ones; the previous run is not used
    assert current[500] == track.covariates["motor_current_a"][500]
    lamp, before = moved.covariates["lamp_on"], track.covariates["lamp_on"]
    assert set(lamp) == {0.0, 1.0}
    late = (np.flatnonzero(np.diff(lamp) > 0) - np.flatnonzero(np.diff(before) > 0)) * 0.02
    assert late == pytest.approx(0.05, abs=0.0101)


def test_only_the_gyro_is_moved_when_the_gyro_is_delayed() -> None:
    track = logged(np.arange(0.0, 20.0, 0.02))
    moved = without_lag(track, -0.05)
    np.testing.assert_array_equal(moved.gyro_b_rad_s, delayed_gyro(track, -0.05).gyro_b_rad_s)
    assert moved.covariates is track.covariates
    assert moved.accel_b_m_s2 is track.accel_b_m_s2


@pytest.mark.parametrize("lag_s", [0.05, 0.09, 0.02])
def test_instantaneous_rates_are_interpolated_and_are_half_a_step_early(lag_s):
    """About one axis, where turns add up: the expected rate is the mean of the linear interpolation
    over the earlier step.
    """
    t = 0.1 * np.arange(60)
    values = np.random.default_rng(5).normal(size=60)
    rate = np.outer(values, [0.0, 0.0, 1.0])
    track = Track(t, np.full(60, 0.1), np.zeros((60, 3)), rate, None, {}, (slice(0, 60),))
    fine = np.linspace(0.0, 5.9, 59 * 1000 + 1)
    drawn = np.interp(fine, t, values)
    turn = np.concatenate([[0.0], np.cumsum((drawn[1:] + drawn[:-1]) / 2 * np.diff(fine))])
    earlier_s = t - (lag_s - 0.05)
    expected = np.diff(np.interp(earlier_s, fine, turn)) / 0.1
    moved = without_lag(track, lag_s, instants=True).gyro_b_rad_s[1:, 2]
    np.testing.assert_allclose(moved[2:-2], expected[2:-2], atol=1e-5)


def test_readings_before_the_first_delayed_column_value_are_omitted():
    """At 25 Hz and a delay of up to 100 ms, these are the first three readings of each run."""
    track = track_of(experiment(samples=500))
    dt_s = track.dt_s.copy()
    dt_s[200] = np.nan
    runs = (slice(0, 200), slice(200, 500))
    track = replace(track, dt_s=dt_s, runs=runs)
    for covariates, left_out in (({}, []), ({"lamp_on": np.ones(500)}, [0, 1, 2, 200, 201, 202])):
        begun = without_early_readings(replace(track, covariates=covariates))
        unread = np.flatnonzero(np.isnan(begun.mag_b_gauss).any(axis=1))
        assert unread.tolist() == left_out


def test_readings_of_short_bursts_are_all_kept():
    """Bursts of five readings with steps of 40 ms: the first three would be most of each burst."""
    track = track_of(experiment(samples=500))
    dt_s = track.dt_s.copy()
    dt_s[::5] = np.nan
    runs = tuple(slice(k, k + 5) for k in range(0, 500, 5))
    burst = replace(track, dt_s=dt_s, runs=runs, covariates={"lamp_on": np.ones(500)})
    np.testing.assert_array_equal(without_early_readings(burst).mag_b_gauss, track.mag_b_gauss)
