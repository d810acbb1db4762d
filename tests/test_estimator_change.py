"""Iron that changes before the answer is sure: no mixture, but the calibration of what is now."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ahrsd.batch import calibrate
from ahrsd.config import Config
from ahrsd.estimator.online import Estimator

BROAD = Path(__file__).parents[2] / "shared" / "recordings" / "broad"
STEP_GAUSS = np.array([0.05, -0.04, 0.08])


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "benchmarks"))
    return importlib.import_module("bench_estimator")


def answer(bench, run):
    estimator = Estimator()
    bench.feed(estimator, run.block, 500)
    return estimator, estimator.finish()


@pytest.mark.parametrize(("kind", "seed"), [("mam", 3), ("lam", 4)])
def test_a_magnet_put_on_early(bench, kind, seed):
    run = bench.simulate(kind, "rov", seed, samples=5000)
    field = run.block.raw_b_gauss + STEP_GAUSS * (run.block.time_s > 50.0)[:, None]
    estimator, found = answer(bench, replace(run, block=replace(run.block, raw_b_gauss=field)))
    assert 35.0 < estimator.restarted_s < 75.0
    assert any("the iron changed" in text for text in found.warnings)
    error = found.hard_iron_gauss - run.hard_iron_gauss - STEP_GAUSS
    assert np.max(np.abs(error) / found.sigma[6:9]) < 4.5
    assert np.linalg.norm(error) < 0.01


@pytest.mark.parametrize("kind", ["wam", "mam", "lam"])
def test_iron_that_stays_is_not_divided(bench, kind):
    for seed in range(3):
        run = bench.simulate(kind, "slow", seed, samples=4000)
        assert answer(bench, run)[0].restarted_s is None


@pytest.mark.skipif(not BROAD.exists(), reason="the real recordings are not here")
@pytest.mark.parametrize(
    "name",
    ["32_disturbed_attached_magnet_1cm", "34_disturbed_attached_magnet_3cm",
     "36_disturbed_attached_magnet_5cm"],
)  # fmt: skip
def test_a_magnet_that_was_taken_off_again(name):
    found = calibrate(BROAD / f"{name}.csv.gz", Config()).estimate
    # 0.58, 0.135 and 0.06 G from about 40 to 97 s; without it the sensor has next to none
    assert found.converged
    assert np.linalg.norm(found.hard_iron_gauss) < 0.02
