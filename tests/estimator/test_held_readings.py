"""A magnetometer that is read more slowly than the gyro: each reading counts once."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator.epoch_data import EpochBuilder, HeldReadings, rows_per_reading
from ahrsd.estimator.online import Estimator
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.samples import SampleBlock

SOFT = np.array([[1.05, 0.02, 0.0], [0.02, 0.97, 0.01], [0.0, 0.01, 0.982]])
HARD = np.array([0.12, -0.08, 0.06])
BIAS = np.array([3.5e-3, -4.2e-3, 2.1e-3])


def recorded(rate_hz, hold, seconds=120.0, seed=1, noise=(1e-3, 7e-4)):
    """(N, 11) rows of a tumbling sensor whose magnetometer has a new reading every `hold` rows."""
    draw = np.random.default_rng(seed)
    count = round(seconds * rate_hz)
    time_s = np.arange(count) / rate_hz
    rate = np.column_stack([
        0.5 * np.sin(0.9 * time_s), 0.4 * np.sin(0.61 * time_s + 1.0),
        0.4 + 0.2 * np.sin(0.3 * time_s),
    ])  # fmt: skip
    R = so3.products(so3.exp(rate / rate_hz))
    h = np.einsum("nji,j->ni", R, [0.25, 0.0, 0.43])
    read = h @ SOFT.T + HARD + noise[0] * draw.normal(size=h.shape)
    held = read[np.arange(count) // hold * hold]
    gyro = rate + BIAS + noise[1] * draw.normal(size=rate.shape)
    force = np.einsum("nji,j->ni", R, [0.0, 0.0, -9.81])
    steps = np.full(count, 1 / rate_hz)
    steps[0] = np.nan
    return np.column_stack([time_s, steps, held, gyro, force])


def block(rows, gap_before=True):
    return SampleBlock(
        time_s=rows[:, 0], dt_s=rows[:, 1], host_s=rows[:, 0], raw_b_gauss=rows[:, 2:5],
        gyro_b_rad_s=rows[:, 5:8], accel_b_m_s2=rows[:, 8:11], gap_before=gap_before,
    )  # fmt: skip


def pieces(rows, size):
    for k in range(0, len(rows), size):
        yield block(rows[k : k + size], gap_before=k == 0)


@pytest.mark.parametrize(
    ("rate_hz", "hold"), [(100.0, 10), (100.0, 20), (200.0, 40), (100.0, 2), (50.0, 5), (400.0, 8)]
)
def test_hold_length_is_found_from_the_first_rows(rate_hz, hold):
    rows = recorded(rate_hz, hold, seconds=20.0)
    found = [rows_per_reading(rows[:n], 33) for n in (20, 512, 2000)]
    assert found == [None, hold, hold]


def test_absence_of_held_readings_is_found_after_the_rows_that_the_rate_needs():
    rows = recorded(100.0, 1, seconds=5.0)
    assert [rows_per_reading(rows[:n], 33) for n in (32, 33, 500)] == [None, 1, 1]


def test_coarse_values_at_rest_are_not_held_readings():
    draw = np.random.default_rng(3)
    rows = recorded(40.0, 1, seconds=60.0)
    coarse = np.round(np.array([0.2, 0.0, 0.4]) + 4e-4 * draw.normal(size=(len(rows), 3)), 3)
    rows[:, 2:5] = coarse
    assert rows_per_reading(rows, 33) == 1


def test_stuck_reading_does_not_delay_the_decision_for_ever():
    rows = recorded(100.0, 1, seconds=20.0)
    rows[:, 2:5] = rows[0, 2:5]
    assert rows_per_reading(rows[:511], 33) is None
    assert rows_per_reading(rows[:512], 33) == 1


def test_rotations_are_composed_and_time_adds_up():
    rows = recorded(100.0, 10, seconds=10.0, noise=(1e-3, 0.0))
    thin = HeldReadings(10).merge_rows(rows)
    assert len(thin) == 99
    assert np.isnan(thin[0, 1])
    np.testing.assert_allclose(thin[1:, 1], 0.1)
    np.testing.assert_allclose(thin[:, 0], rows[10::10, 0])
    np.testing.assert_allclose(thin[:, 2:5], rows[10::10, 2:5])
    whole = so3.products(so3.exp(rows[:, 5:8] * 0.01))
    step = np.swapaxes(whole[10:-10:10], 1, 2) @ whole[20::10]
    np.testing.assert_allclose(so3.exp(thin[1:, 5:8] * 0.1), step, atol=1e-12)


@pytest.mark.slow
def test_rows_do_not_depend_on_the_block_size():
    rows = recorded(100.0, 10, seconds=30.0)
    whole = HeldReadings(10).merge_rows(rows)
    for size in (1, 7, 10, 333):
        one = HeldReadings(10)
        parts = [one.merge_rows(rows[k : k + size]) for k in range(0, len(rows), size)]
        np.testing.assert_array_equal(np.vstack(parts), whole)


def test_reading_that_stays_for_long_counts_again():
    rows = recorded(100.0, 10, seconds=30.0)
    rows[1000:2000, 2:5] = rows[1000, 2:5]
    thin = HeldReadings(10).merge_rows(rows)
    assert np.max(thin[1:, 1]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("rate_hz", "hold"),
    [
        (100.0, 10),
        pytest.param(100.0, 20, marks=pytest.mark.slow),
        pytest.param(50.0, 2, marks=pytest.mark.slow),
    ],
)
def test_held_readings_cause_no_warning_and_a_correct_estimate(rate_hz, hold):
    estimator = Estimator()
    for piece in pieces(recorded(rate_hz, hold, seconds=150.0), 500):
        estimator.add(piece)
    found = estimator.finish()
    assert found is not None
    assert found.converged
    assert found.warnings == ()
    np.testing.assert_allclose(found.hard_iron_gauss, HARD, atol=1e-3)
    np.testing.assert_allclose(found.gyro_bias_rad_s, BIAS, atol=6e-4)


def test_held_readings_with_gaps_do_not_depend_on_the_block_size():
    rows = recorded(100.0, 10, seconds=60.0)
    found = []
    for size in (50, 177):
        intake = EpochBuilder(EstimatorParameters(epoch_steps=64))
        closed = []
        for first, last in ((0, 2500), (2700, 4000), (4100, 4130), (4200, 6000)):
            for k in range(first, last, size):
                if k == first and k:
                    closed += intake.gap(float(rows[k, 0]))
                closed += intake.add(block(rows[k : min(k + size, last)], k == first))
        closed.append(intake.interrupt())
        found.append([data for data in closed if data is not None])
    assert sum(map(len, found[0])) > 400
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one.field_b_gauss, other.field_b_gauss)
        np.testing.assert_array_equal(one.angle_b_rad, other.angle_b_rad)
