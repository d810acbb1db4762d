"""Contradictions of the model: iron that changed, and a misaligned magnetometer."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.calibration_json import why_not_converged
from ahrsd.config.config import Config
from ahrsd.estimator.model_checks import find_iron_change
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.offline.calibrate import calibrate
from ahrsd.recording.table import read_table

BROAD = Path(__file__).parents[3] / "shared" / "recordings" / "broad"
STEP_GAUSS = np.array([0.05, -0.04, 0.08])


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks" / "estimator"))
    return importlib.import_module("bench_estimator")


def answer(bench, run):
    estimator = Estimator()
    bench.feed(estimator, run.block, 500)
    return estimator, estimator.finish()


@pytest.mark.parametrize(
    ("kind", "seed"), [pytest.param("mam", 3, marks=pytest.mark.slow), ("lam", 4)]
)
def test_estimator_restarts_after_a_magnet_was_added_early(bench, kind, seed):
    run = bench.simulate(kind, "rov", seed, samples=5000)
    field = run.block.raw_b_gauss + STEP_GAUSS * (run.block.time_s > 50.0)[:, None]
    estimator, found = answer(bench, replace(run, block=replace(run.block, raw_b_gauss=field)))
    assert 35.0 < estimator.restarted_s < 75.0
    assert any("the iron changed" in text for text in found.warnings)
    error = found.hard_iron_gauss - run.hard_iron_gauss - STEP_GAUSS
    assert np.max(np.abs(error) / found.sigma[6:9]) < 4.5
    assert np.linalg.norm(error) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wam", *(kind for kind in ("mam", "lam"))])
def test_constant_iron_causes_no_restart(bench, kind):
    for seed in range(3):
        run = bench.simulate(kind, "slow", seed, samples=4000)
        assert answer(bench, run)[0].restarted_s is None


@pytest.mark.slow  # a short one of them: the next test
@pytest.mark.recordings
@pytest.mark.parametrize(
    "name",
    [
        "36_disturbed_attached_magnet_5cm",
        "32_disturbed_attached_magnet_1cm",
        "34_disturbed_attached_magnet_3cm",
    ],
)
def test_estimate_after_a_temporary_magnet_is_without_it(name):
    found = calibrate(BROAD / f"{name}.csv.gz", Config()).estimate
    # 0.58, 0.135 and 0.06 G from about 40 to 97 s; without it the hard iron is near zero
    assert found.converged
    assert np.linalg.norm(found.hard_iron_gauss) < 0.02


@pytest.mark.recordings
def test_estimate_after_a_temporary_magnet_is_without_it_in_one_batch():
    """All epochs of the recording at once: convergence shows only at the very end."""
    estimator = Estimator(at_once=WHOLE)
    for block in read_table(BROAD / "34_disturbed_attached_magnet_3cm.csv.gz").blocks():
        estimator.add(block)
    found = estimator.finish()
    assert 90.0 < estimator.restarted_s < 105.0
    assert np.linalg.norm(found.hard_iron_gauss) < 0.02


def _with_magnet(bench, seed, samples, near):
    """A stream with a step of the hard iron where `near` (time in s) is true."""
    run = bench.simulate("mam", "rov", seed, samples=samples)
    field = run.block.raw_b_gauss + STEP_GAUSS * near(run.block.time_s)[:, None]
    return run, replace(run.block, raw_b_gauss=field)


def test_estimate_is_in_doubt_from_a_contradiction_until_agreement(bench):
    """Epochs are 20.48 s long; only the ninth has another field."""
    run, block = _with_magnet(bench, 3, 5800, lambda t: (t > 163.8) & (t < 184.3))
    estimator, seen = Estimator(), []
    for start in range(0, len(block), 500):
        if estimator.add(bench.piece(block, start, start + 500)):
            seen.append(estimator.estimate())
    doubted = [found.contradicted_s for found in seen]
    assert doubted.count(None) == len(seen) - 1
    k = next(k for k, since_s in enumerate(doubted) if since_s is not None)
    assert doubted[k] == pytest.approx(163.88)
    assert [found.converged for found in seen[k - 1 : k + 2]] == [True, False, True]
    assert "contradicts what was before" in why_not_converged(seen[k])[0]
    found = estimator.finish()
    assert found.converged
    assert estimator.restarted_s is None
    error = found.hard_iron_gauss - run.hard_iron_gauss
    assert np.max(np.abs(error) / found.sigma[6:9]) < 4.0


def test_estimate_is_in_doubt_when_the_iron_changes_at_the_end(bench):
    _, block = _with_magnet(bench, 3, 5000, lambda t: t > 184.4)
    estimator = Estimator()
    bench.feed(estimator, block, 500)
    found = estimator.finish()
    assert not found.converged
    assert found.contradicted_s == pytest.approx(184.36)


@pytest.mark.parametrize(("step_sigma", "parted"), [(0.0, 1.0), (20.0, 5.4)])
def test_difference_of_two_parts_widens_the_estimate_amid_other_misfit(step_sigma, parted):
    """24 epochs that disagree by 7 sigma among themselves; the second half differs by more."""
    rng = np.random.default_rng(1)
    graph = SimpleNamespace(
        temper=49.0, hold=0.0, c=np.r_[0.5, 0, 0, 0.5, 0, 0.5, np.zeros(3)],
        anchor=(np.zeros(9), 1e-6 * np.eye(9)),
    )  # fmt: skip
    H = np.tile(np.eye(17), (24, 1, 1))
    away = 7.0 * rng.standard_normal((24, 17))
    away[12:, 6:9] += step_sigma / np.sqrt(3)
    found = find_iron_change((H, -away), graph, 1.0, 1e3)
    assert found.first is None
    assert found.variance_factor == pytest.approx(parted, rel=0.1)


def misalignment_of(bench, run):
    estimator = Estimator()
    bench.feed(estimator, run.block, 500)
    estimator.finish()
    return estimator.misalignment()


@pytest.mark.parametrize("kind", [pytest.param("wam", marks=pytest.mark.slow), "mam"])
def test_misaligned_magnetometer_is_found(bench, kind):
    theta = np.array([0.012, -0.02, 0.009])
    run = bench.simulate(kind, "rov", 7)
    R = so3.exp(theta[None])[0]  # from the gyro's axes to the magnetometer's
    rate = run.block.gyro_b_rad_s - bench.GYRO_BIAS_RAD_S
    turned = replace(run.block, gyro_b_rad_s=rate @ R + bench.GYRO_BIAS_RAD_S)
    answer = misalignment_of(bench, replace(run, block=turned))
    assert answer.significant
    sigma = np.sqrt(np.diag(answer.covariance))
    np.testing.assert_array_less(np.abs(answer.rotation_rad - theta), 5 * sigma + 5e-4)
    full = R.T @ np.linalg.inv(run.soft_iron)
    np.testing.assert_allclose(answer.correction.matrix, full, atol=3e-3)
    np.testing.assert_allclose(answer.correction.offset, run.hard_iron_gauss, atol=1.5e-3)


@pytest.mark.parametrize("seeds", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_no_misalignment_is_found_when_there_is_none(bench, seeds):
    answers = [
        misalignment_of(bench, bench.simulate("mam", "rov", seed, samples=5000))
        for seed in range(seeds)
    ]
    assert not any(answer.significant for answer in answers)
    assert 0.2 < np.mean([answer.chi2 for answer in answers]) / 3 < 3.0


def test_no_misalignment_is_reported_before_an_estimate(bench):
    assert Estimator().misalignment() is None
