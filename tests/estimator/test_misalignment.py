"""A magnetometer that is turned against the gyro is found, and none where there is none."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator.online import Estimator


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module("bench_estimator")


def found(bench, run):
    estimator = Estimator()
    bench.feed(estimator, run.block, 500)
    estimator.finish()
    return estimator.misalignment()


@pytest.mark.parametrize("kind", ["wam", "mam"])
def test_a_turned_magnetometer_is_found(bench, kind):
    theta = np.array([0.012, -0.02, 0.009])
    run = bench.simulate(kind, "rov", 7)
    R = so3.exp(theta[None])[0]  # from the gyro's axes to the magnetometer's
    rate = run.block.gyro_b_rad_s - bench.GYRO_BIAS_RAD_S
    turned = replace(run.block, gyro_b_rad_s=rate @ R + bench.GYRO_BIAS_RAD_S)
    answer = found(bench, replace(run, block=turned))
    assert answer.significant
    sigma = np.sqrt(np.diag(answer.covariance))
    np.testing.assert_array_less(np.abs(answer.rotation_rad - theta), 5 * sigma + 5e-4)
    full = R.T @ np.linalg.inv(run.soft_iron)
    np.testing.assert_allclose(answer.correction.matrix, full, atol=3e-3)
    np.testing.assert_allclose(answer.correction.offset, run.hard_iron_gauss, atol=1.5e-3)


def test_no_misalignment_is_no_evidence(bench):
    answers = [found(bench, bench.simulate("mam", "rov", seed, samples=5000)) for seed in range(5)]
    assert not any(answer.significant for answer in answers)
    assert 0.2 < np.mean([answer.chi2 for answer in answers]) / 3 < 3.0


def test_nothing_is_said_before_there_is_an_answer(bench):
    assert Estimator().misalignment() is None
