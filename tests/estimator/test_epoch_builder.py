"""From samples to steps and epochs, independent of the block size; the direction of gravity in a
turn.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ahrsd import so3
from ahrsd.estimator.epoch_data import (
    EpochBuilder,
    RunningTime,
    StepAverager,
    check_samples,
    join_epochs,
    join_steps,
    samples_per_step,
    split_steps,
    thin_rows,
)
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.samples import SampleBlock

DT = 0.005


def rows(count, seed=0):
    """Samples (count, 11) of fast motion."""
    rng = np.random.default_rng(seed)
    dt = DT * (1 + 0.1 * rng.uniform(-1, 1, count))
    return np.column_stack([np.cumsum(dt), dt, rng.normal(size=(count, 9)) * 2.0])


def block(samples, *, gap):
    dt = samples[:, 1].copy()
    if gap:
        dt[0] = np.nan
    return SampleBlock(
        samples[:, 0], dt, samples[:, 0], samples[:, 2:5], samples[:, 5:8], samples[:, 8:11],
        gap_before=gap,
    )  # fmt: skip


def blocks(samples, cuts):
    edges = [0, *sorted(set(cuts)), len(samples)]
    parts = [samples[a:b] for a, b in pairwise(edges) if b > a]
    return [block(part, gap=i == 0) for i, part in enumerate(parts)]


@pytest.mark.parametrize(
    ("rate", "expected"), [(25.0, 1), (33.0, 1), (98.0, 1), (100.0, 3), (400.0, 11), (800.0, 23)]
)
def test_samples_per_step_is_odd_and_keeps_the_rate(rate, expected):
    assert samples_per_step(rate, 33.0) == expected
    assert expected == 1 or rate / expected >= 33.0


def test_steps_are_exact_compositions_of_rotations():
    samples, n = rows(60), 5
    steps = StepAverager(n).add(samples)
    assert len(steps) == 12
    np.testing.assert_array_equal(steps.time_s, samples[2::5, 0])
    np.testing.assert_allclose(steps.field_b_gauss[3], samples[15:20, 2:5].mean(axis=0))
    assert np.isnan(steps.dt_s[0])
    total = np.eye(3)
    for k in range(13, 18):  # from the middle of step 2 (sample 12) to that of step 3 (sample 17)
        total = total @ so3.exp(samples[k, 5:8] * samples[k, 1])
    np.testing.assert_allclose(so3.exp(steps.angle_b_rad[3]), total, atol=1e-13)
    assert steps.dt_s[3] == pytest.approx(samples[13:18, 1].sum())


@settings(deadline=None)
@given(st.sampled_from([1, 3, 5]), st.lists(st.integers(1, 99), max_size=12))
def test_steps_do_not_depend_on_the_block_size(n, cuts):
    samples = rows(100)
    whole = StepAverager(n).add(samples)
    averager = StepAverager(n)
    edges = [0, *sorted(set(cuts)), 100]
    parts = [averager.add(samples[a:b]) for a, b in pairwise(edges)]
    pieces = join_steps([part for part in parts if len(part)])
    for name in ("time_s", "field_b_gauss", "angle_b_rad", "dt_s", "accel_b_m_s2"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))


def test_join_reverses_split():
    steps = StepAverager(3).add(rows(99))
    front, back = split_steps(steps, 7)
    assert (len(front), len(back)) == (7, 26)
    np.testing.assert_array_equal(join_steps([front, back]).angle_b_rad, steps.angle_b_rad)


@settings(deadline=None)
@given(st.lists(st.integers(1, 999), max_size=20))
def test_epochs_do_not_depend_on_the_block_size(cuts):
    """The rate is measured on the same samples as well, including blocks of one sample."""
    samples = rows(1000)
    parameters = EstimatorParameters(epoch_steps=64)
    epochs = []
    for chosen in ([], cuts):
        gate = EpochBuilder(parameters)
        found = [data for b in blocks(samples, chosen) for data in gate.add(b)]
        epochs.append((found, gate.samples, gate.duration_s, gate.averaged))
    assert epochs[0][1:] == epochs[1][1:]
    assert len(epochs[0][0]) == len(epochs[1][0]) == 3
    for a, b in zip(epochs[0][0], epochs[1][0], strict=True):
        np.testing.assert_array_equal(a.angle_b_rad, b.angle_b_rad)
        np.testing.assert_array_equal(a.field_b_gauss, b.field_b_gauss)
        np.testing.assert_array_equal(a.down_b, b.down_b)


def test_epochs_are_the_same_for_single_samples():
    samples = rows(400)
    gates = [EpochBuilder(EstimatorParameters(epoch_steps=64)) for _ in range(2)]
    (whole,) = gates[0].add(block(samples, gap=True))
    found = [d for b in blocks(samples, range(400)) for d in gates[1].add(b)]
    np.testing.assert_array_equal(found[0].angle_b_rad, whole.angle_b_rad)


def test_gap_ends_the_epoch_and_starts_a_new_one():
    gate = EpochBuilder(EstimatorParameters(epoch_steps=128))
    (first,) = gate.add(block(rows(1000), gap=True))
    assert (first.measures_first, len(first)) == (True, 129)
    rest = gate.interrupt()  # 200 steps of 5 samples: 71 remain
    assert (rest.measures_first, len(rest)) == (False, 71)
    assert gate.interrupt() is None
    assert gate.add(block(rows(1000), gap=True))[0].measures_first


def test_piece_too_short_for_an_epoch_is_dropped():
    gate = EpochBuilder(EstimatorParameters(epoch_steps=128))
    assert gate.add(block(rows(319), gap=True)) == []
    assert gate.interrupt() is None
    assert gate.duration_s == pytest.approx(318 * DT, rel=0.01)


@pytest.fixture
def good():
    return rows(10)


@pytest.mark.parametrize(
    ("column", "value", "text"),
    [
        (0, np.nan, "time_s of row 4 is not finite"),
        (3, np.inf, "raw_b_gauss of row 4 is not finite"),
        (6, -np.inf, "gyro_b_rad_s of row 4 is not finite"),
        (1, np.nan, "dt_s of row 4 is not a positive step: nan"),
        (1, 0.0, "dt_s of row 4 is not a positive step: 0.0"),
        (1, -0.1, "dt_s of row 4"),
        (1, np.inf, "dt_s of row 4"),
    ],
)
def test_error_names_the_bad_sample(good, column, value, text):
    good[4, column] = value
    with pytest.raises(ValueError, match=text):
        check_samples(block(good, gap=True))


def test_unknown_time_step_is_allowed_only_after_a_gap(good):
    check_samples(block(good, gap=True))
    with pytest.raises(ValueError, match="dt_s of row 0"):
        good[0, 1] = np.nan
        check_samples(block(good, gap=False))


def test_missing_specific_force_is_accepted(good):
    good[:, 8:11] = np.nan
    check_samples(block(good, gap=True))


def test_thinning_composes_rotations_and_keeps_fields():
    gate = EpochBuilder(EstimatorParameters(epoch_steps=64))
    samples = rows(330)
    samples[:, 1] = 0.03
    data = gate.add(block(samples, gap=True))[0]
    thin = thin_rows(data, 4)
    np.testing.assert_array_equal(thin.field_b_gauss, data.field_b_gauss[::4][: len(thin)])
    np.testing.assert_allclose(thin.dt_s[1:], 0.12)
    total = np.eye(3)
    for k in range(5, 9):
        total = total @ so3.exp(data.angle_b_rad[k])
    np.testing.assert_allclose(so3.exp(thin.angle_b_rad[2]), total, atol=1e-13)
    both = join_epochs([thin, thin])
    assert len(both) == 2 * len(thin)
    np.testing.assert_array_equal(np.flatnonzero(both.linked == 0), [0, len(thin)])


RATE_HZ, N = 33.0, 600


def circling(rate_rad_s, sideways_m_s2):
    """A level vehicle on a circle: the centripetal force is constant in the vehicle's frame."""
    dt = np.full(N, 1 / RATE_HZ)
    dt[0] = np.nan
    time_s = np.arange(N) / RATE_HZ
    return SampleBlock(
        time_s=time_s,
        dt_s=dt,
        host_s=time_s,
        raw_b_gauss=np.tile([0.2, 0.0, 0.4], (N, 1)),
        gyro_b_rad_s=np.tile([0.0, 0.0, rate_rad_s], (N, 1)),
        accel_b_m_s2=np.tile([0.0, sideways_m_s2, -9.81], (N, 1)),
        gap_before=True,
    )


def tilts_deg(block):
    (data,) = EpochBuilder(EstimatorParameters()).add(block)
    return np.degrees(np.arccos(data.down_b[:, 2]))


def test_centripetal_force_is_not_taken_for_tilt():
    turns_per_epoch = 3
    rate = turns_per_epoch * 2 * np.pi * RATE_HZ / 512
    assert np.max(tilts_deg(circling(rate, 3.0))) < 0.3
    assert tilts_deg(circling(0.0, 3.0)) == pytest.approx(np.degrees(np.arctan2(3.0, 9.81)))


def test_effect_of_gyro_bias_on_tilt_cancels_in_the_middle_of_the_epoch():
    block = circling(0.0, 0.0)
    biased = replace(block, gyro_b_rad_s=np.tile([5e-3, 0.0, 0.0], (N, 1)))
    tilt = tilts_deg(biased)
    assert tilt[len(tilt) // 2] < 0.05
    assert tilt[0] > 1.0


def test_gravity_direction_is_nan_without_an_accelerometer():
    block = circling(0.1, 0.0)
    silent = replace(block, accel_b_m_s2=np.full((N, 3), np.nan))
    (data,) = EpochBuilder(EstimatorParameters()).add(silent)
    assert np.isnan(data.down_b).all()


def test_time_goes_on_where_the_device_restarted():
    """By the host's clock, and what is reported is in the device's own time."""
    running, one = RunningTime(), np.ones((2, 3))

    def at(time_s: float, host_s: float) -> SampleBlock:
        times = np.array([time_s, time_s + 1.0])
        return SampleBlock(times, np.ones(2), host_s + np.arange(2.0), one, one, one)

    before = at(900.0, 50.0)
    assert running.follow(before) is before
    assert running.falls(at(2.0, 58.0))
    assert running.follow(at(2.0, 58.0)).time_s.tolist() == [908.0, 909.0]
    assert running.follow(at(4.0, 60.0)).time_s.tolist() == [910.0, 911.0]
    assert running.follow(at(1.0, 61.0)).time_s.tolist() == [911.1, 912.1]  # no host time
    assert [running.device_s(s) for s in (900.5, 908.0, 911.0)] == [900.5, 2.0, 5.0]
    assert round(running.device_s(912.1), 9) == 2.0
