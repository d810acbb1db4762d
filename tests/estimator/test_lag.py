"""A magnetometer that is delayed relative to the gyro: the delay is found and removed, and none
is found otherwise.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.calibration_json import why_not_converged
from ahrsd.config.config import Config
from ahrsd.estimator import chain
from ahrsd.estimator.epoch_data import row_rates, with_lag
from ahrsd.estimator.online import Estimator
from ahrsd.montecarlo.accuracy import nees
from ahrsd.offline.calibrate import calibrate

BROAD = Path(__file__).parents[3] / "shared" / "recordings" / "broad"
WALK = BROAD.parent / "vn100" / "walk_square_2024_sazgar.vnraw.gz"
UPPER = np.triu_indices(3)


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks" / "estimator"))
    return importlib.import_module("bench_estimator")


def delayed(run, lag_s):
    """The run with its field delayed by `lag_s`, with the same noise."""
    before = np.einsum("kij,kj->ki", so3.exp(lag_s * run.rate_b_rad_s), run.field_b_gauss)
    moved = (before - run.field_b_gauss) @ run.soft_iron
    return replace(run, block=replace(run.block, raw_b_gauss=run.block.raw_b_gauss + moved))


def answer(bench, run):
    estimator = Estimator()
    bench.feed(estimator, run.block, 500)
    return estimator.finish()


@pytest.mark.parametrize(
    ("kind", "lag_s"),
    [("wam", 0.03), pytest.param("mam", 0.012, marks=pytest.mark.slow), ("wam", -0.02)],
)
def test_delay_is_found_and_removed(bench, kind, lag_s):
    run = bench.simulate(kind, "rov", 5, samples=6000)
    found = answer(bench, delayed(run, lag_s))
    assert found.mag_lag_s == pytest.approx(lag_s, abs=4e-3)
    error = np.r_[
        (found.soft_iron - run.soft_iron)[UPPER],
        found.hard_iron_gauss - run.hard_iron_gauss,
        found.gyro_bias_rad_s - run.gyro_bias_rad_s,
    ]
    assert nees(error, found.covariance, run.soft_iron) < 2.5
    assert np.linalg.norm(error[6:9]) < 1e-3


@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_no_delay_is_found_when_there_is_none(bench, seeds):
    lags = [
        answer(bench, bench.simulate(kind, "rov", seed, samples=4000)).mag_lag_s
        for kind in ("wam", "lam")
        for seed in range(seeds)
    ]
    assert lags == [0.0] * 2 * seeds


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.75, 1.1])
def test_wrong_time_or_unit_prevents_convergence(bench, factor):
    run = bench.simulate("mam", "rov", 2, samples=3500)
    gyro = run.block.gyro_b_rad_s * factor
    found = answer(bench, replace(run, block=replace(run.block, gyro_b_rad_s=gyro)))
    assert found.gyro_misscaled == pytest.approx(1 / factor - 1, abs=0.06)
    assert not found.converged
    (reason,) = why_not_converged(found)
    assert f"{abs(found.gyro_misscaled):.0%} {'more' if factor < 1 else 'less'} than" in reason
    right = answer(bench, run)
    assert right.converged and right.gyro_misscaled == 0.0


@pytest.mark.slow
@pytest.mark.recordings
def test_wrong_rate_due_to_lost_messages_prevents_convergence():
    assert calibrate(WALK, Config(), rate_hz=40.0).estimate.gyro_misscaled == 0.0
    found = calibrate(WALK, Config(), rate_hz=30.0).estimate
    assert not found.converged
    assert found.gyro_misscaled == pytest.approx(30 / 40 - 1, abs=0.08)


def test_delay_rotates_the_undistorted_field():
    rate = np.array([0.0, 0.0, 2.0])
    dt = np.full(5, 0.05)
    data = chain.EpochData(
        np.ones((5, 3)), rate * dt[:, None], dt, np.ones((5, 3)), np.cumsum(dt), measures_first=True
    )
    np.testing.assert_allclose(row_rates(data), np.tile(rate, (5, 1)))
    seen = with_lag(data, 0.1).field_directions(np.tile([1.0, 0.0, 0.0], (5, 1)))
    # u turns opposite to the sensor, so 0.1 s earlier it was 0.2 rad ahead
    np.testing.assert_allclose(seen, np.tile([np.cos(0.2), np.sin(0.2), 0.0], (5, 1)))
    back = with_lag(with_lag(data, 0.1), -0.1).field_directions(np.tile([1.0, 0.0, 0.0], (5, 1)))
    np.testing.assert_allclose(back, np.tile([1.0, 0.0, 0.0], (5, 1)), atol=1e-15)


def test_rate_across_a_cut_is_that_of_the_linked_side():
    angle = np.array([[0.0, 0, 0], [0.1, 0, 0], [9.0, 0, 0], [0.3, 0, 0]])
    data = chain.EpochData(
        np.ones((4, 3)), angle, np.full(4, 0.1), np.ones((4, 3)), np.arange(4.0),
        measures_first=True, linked=np.array([0.0, 1.0, 0.0, 1.0]),
    )  # fmt: skip
    np.testing.assert_allclose(row_rates(data)[:, 0], [1.0, 1.0, 3.0, 3.0])


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize(
    "name",
    [
        "02_undisturbed_slow_rotation_B",
        "21_undisturbed_fast_combined",
    ],
)
def test_delay_of_a_real_instrument(name):
    found = calibrate(BROAD / f"{name}.csv.gz", Config()).estimate
    # 11.5 ms by the optical reference, plus half a step at 286 Hz because its rate is sampled
    assert 0.011 < found.mag_lag_s < 0.0155
