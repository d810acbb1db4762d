"""Sigmas over changes of the motion: the final sigmas are those that all data determine.

The long form is tests/benchmarks/estimator/bench_regimes.py.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import crooked
import numpy as np
import pieces
import pytest

from ahrsd.estimator.graph import Moments
from ahrsd.estimator.online import Estimator
from ahrsd.estimator.parameters import ASSEMBLED, EstimatorParameters
from ahrsd.estimator.window import path_curvatures
from ahrsd.samples import SampleBlock

REGIMES = {
    "circles-roll": (("circles", 100.0), ("roll", 60.0)),
    "roll-circles": (("roll", 60.0), ("circles", 100.0)),
    "eight-roll": (("eight", 80.0), ("roll", 40.0)),
    "rest-circles-pitch": (("rest", 60.0), ("circles", 60.0), ("pitch", 40.0)),
}
LAG_S = 0.025
LONG = (("eight-roll", 40.0), ("roll-circles", 40.0), ("rest-circles-pitch", 40.0))


def part(block: SampleBlock, a: int, b: int) -> SampleBlock:
    rows = slice(a, b)
    return SampleBlock(
        block.time_s[rows], block.dt_s[rows], block.host_s[rows], block.raw_b_gauss[rows],
        block.gyro_b_rad_s[rows], block.accel_b_m_s2[rows], gap_before=a == 0,
    )  # fmt: skip


@pytest.mark.parametrize("seeds", [2, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("name", "rate_hz"),
    [
        pytest.param(name, rate_hz, marks=pytest.mark.slow if (name, rate_hz) in LONG else ())
        for name in REGIMES
        for rate_hz in (10.0, 40.0)
    ],
)
def test_sigmas_stay_at_the_bound_after_a_change_of_motion(name, rate_hz, seeds):
    """Several noise levels, half of the runs with a delayed field.

    A minute or two at 10 Hz determine the gyro's noise so poorly that the sigmas follow its chance
    error.
    """
    least = 0.8 if rate_hz > 10 else 0.6
    for seed in range(seeds):
        made = pieces.drive(REGIMES[name], seed, rate_hz=rate_hz, lag_s=LAG_S * (seed % 2))
        found = pieces.answer(made)
        assert found.converged
        iron = pieces.ratios(made, found)[:9]
        assert least < iron.min() and iron.max() < 1.5, (seed, iron)
        assert pieces.nees_of(made, found) < 4.5
        error = found.hard_iron_gauss - pieces.HARD_IRON_GAUSS
        assert np.all(np.abs(error) < 4 * found.sigma[6:9])


@pytest.mark.parametrize("hold", [1, 10])
@pytest.mark.parametrize(
    "name", ["circles-roll", pytest.param("rest-circles-pitch", marks=pytest.mark.slow)]
)
def test_sigmas_stay_at_the_bound_with_fast_rows_and_held_readings(name, hold):
    made = pieces.drive(REGIMES[name], 1, rate_hz=100.0, lag_s=LAG_S, hold=hold)
    found = pieces.answer(made)
    assert found.converged
    ratio = pieces.ratios(made, found, hold)[:9]
    assert ratio.min() > 0.8 and ratio.max() < 1.5


@pytest.mark.parametrize("count", [20, pytest.param(30, marks=pytest.mark.slow)])
def test_sigmas_of_random_motions_are_near_the_bound(monkeypatch, count):
    """Sigmas of the iron: hardly any below 0.9 of its bound, and few above 1.5."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks" / "estimator"))
    bench = importlib.import_module("bench_regimes")
    runs = [bench.run(seed, at_once=32) for seed in range(200, 200 + count)]
    sure = [r for r in runs if r.converged and r.told]
    assert len(sure) >= 2 / 3 * count
    ratio = np.concatenate([r.iron for r in sure])
    assert np.mean(ratio < 0.9) < 0.04 and ratio.min() > 0.7
    assert np.mean(ratio > 1.5) < 0.04 and ratio.max() < 3.0
    assert 0.6 < np.mean([r.nees for r in sure]) < 1.5


@pytest.mark.slow  # a shorter form: test_imperfections
def test_sigmas_with_an_imperfect_instrument_are_near_its_bound(monkeypatch):
    """Misalignment, delay, scale errors and bias drift, compared with a bound that has them too.

    The long form is `bench_regimes.py --instrument iron-still`. The target is none below 0.9 and
    one in twenty above 1.5 (docs/design/estimator.md). A misalignment of some degrees may have a
    larger effect on the heading than counts as converged; the iron is tested all the same.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks" / "estimator"))
    bench = importlib.import_module("bench_regimes")
    kind = bench.INSTRUMENTS["iron-still"]
    runs = [bench.run(seed, 32, kind) for seed in range(5000, 5016)]
    assert sum(r.converged for r in runs) >= 10
    sure = [r for r in runs if r.told]
    assert len(sure) >= 13
    ratio = np.concatenate([r.iron for r in sure])
    assert 0.95 < np.median(ratio) < 1.2
    assert np.mean(ratio < 0.9) < 0.05 and ratio.min() > 0.6
    assert np.mean(ratio > 1.5) < 0.08
    assert max(r.worst for r in sure) < 4.0
    assert np.mean([r.nees for r in sure]) < 1.2


def test_rest_determines_the_gyro_bias_and_not_the_scales():
    """The gyro's matrix acts on the rate and not on the bias, which is in the readings as well.
    Otherwise a bias known to one percent would determine the scales, and the vertical hard
    iron of level circles would be left open by their prior only.
    """
    kind = replace(ASSEMBLED, iron_gauss=1e-9)
    for seed in (1, 2, 3):
        made = pieces.drive((("rest", 70.0), ("circles", 90.0), ("rest", 70.0)), seed, rate_hz=20.0)
        made = crooked.imperfect(made, kind, np.random.default_rng([seed, 11]))
        found = pieces.answer(made, at_once=32, parameters=EstimatorParameters())
        ratio = found.sigma[:9] / pieces.bound_sigmas(made, kind=kind)[:9]
        assert ratio.min() > 0.9 and ratio.max() < 1.5, (seed, ratio)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_effect_of_a_delay_on_sigma_follows_the_data(seed):
    """In level circles the delay is found but leaves the vertical hard iron open; a roll
    determines it.
    """
    made = pieces.drive((("circles", 100.0), ("roll", 60.0)), seed, rate_hz=20.0, lag_s=LAG_S)
    estimator = Estimator(pieces.IDEAL)
    estimator.add(part(made.block, 0, 2000))
    level = estimator.estimate()
    estimator.add(part(made.block, 2000, len(made.block)))
    rolled = estimator.estimate()
    assert level.mag_lag_s == pytest.approx(LAG_S, abs=5e-3)
    assert level.sigma[8] > 2e-3 > 1e-3 > rolled.sigma[8]


@pytest.mark.parametrize("motion", [
    (("rest", 62.0), ("circles", 73.0)), (("circles", 40.0), ("straight", 40.0)),
])  # fmt: skip
def test_removing_a_delay_does_not_raise_the_noise(motion):
    """The directions are delayed as well, so that the fields fit as before."""
    for seed in (1, 2):
        made = pieces.drive(motion, seed, lag_s=LAG_S)
        found = pieces.answer(made, at_once=32)
        assert found.mag_lag_s == pytest.approx(LAG_S, abs=4e-3)
        assert found.noise_mag_gauss == pytest.approx(pieces.MAG_GAUSS, rel=0.08)
        assert pieces.ratios(made, found)[:9].max() < 1.8


def test_folded_epochs_still_determine_the_delay():
    """A roll that is kept only as a Gaussian summary, followed by long circles."""
    made = pieces.drive((("roll", 80.0), ("circles", 1100.0)), 4, rate_hz=20.0, lag_s=LAG_S)
    estimator = Estimator(pieces.IDEAL)
    for a in range(0, len(made.block), 400):
        estimator.add(part(made.block, a, min(a + 400, len(made.block))))
    found = estimator.estimate()
    assert estimator._window.folded
    assert found.mag_lag_s == pytest.approx(LAG_S, abs=1e-3)
    ratio = pieces.ratios(made, found)[:9]
    assert (
        ratio.min() > 0.8 and ratio.max() < 2.0
    )  # the bias walks, which the bound does not include
    assert pieces.nees_of(made, found) < 4.0


def test_rest_before_the_bias_is_known_does_not_raise_the_noise():
    """Predicted fields at rest drift while the bias is unknown, which is no error of the model."""
    made = pieces.drive((("rest", 60.0), ("circles", 60.0), ("roll", 40.0)), 0)
    found = pieces.answer(made)
    assert found.noise_mag_gauss == pytest.approx(pieces.MAG_GAUSS, rel=0.05)
    assert pieces.ratios(made, found)[:9].max() < 1.5


def level(seed, seconds=240.0, mag_gauss=2e-3):
    """Turns about one axis, nearly level, with a noisy magnetometer: (n,) heading and the drive."""
    made = pieces.drive((("circles", seconds),), seed, rate_hz=20.0)
    louder = mag_gauss * np.random.default_rng(seed).normal(size=made.field_b_gauss.shape)
    return replace(made, block=replace(made.block, raw_b_gauss=made.block.raw_b_gauss + louder))


def test_level_turns_converge_to_one_estimate():
    """The likelihood has a long valley there and its mirror image. All starts are followed until
    two agree, so that the misfit is not due to their disagreement.
    """
    for seed in range(8):
        made = level(seed)
        found = pieces.answer(made, at_once=32)
        assert found.converged
        assert found.misfit < 1.5
        off = np.abs(made.errors(found))[6:9] / found.sigma[6:9]
        assert off.max() < 3.5
        assert found.sigma[8] < 0.15


def test_path_is_infinite_when_the_matrix_would_not_stay_positive():
    at = np.r_[np.array([0.4, 0.0, 0.0, 0.4, 0.0, 0.03]), np.zeros(3)]
    there = at.copy()
    there[5] += 0.2  # C zz would decrease from 33 by more than that
    factor = SimpleNamespace(point=SimpleNamespace(c=at))
    epoch, resting = (SimpleNamespace(has_motion=t, factor=factor) for t in (True, False))
    found = path_curvatures([epoch, resting], there, Moments(), np.eye(9))
    assert np.isinf(found[0])
    assert found[1] == 0.0


def test_two_rests_determine_the_bias_drift():
    """Two rolls between rests: the gyro bias is known at both rests, and it has changed."""
    made = pieces.drive((("rest", 50.0), ("roll", 60.0), ("roll", 60.0), ("rest", 50.0)), 3)
    time_s = made.block.time_s
    drift = (time_s / time_s[-1] - 1.0)[:, None] * np.array([2e-3, -1e-3, 2e-3])
    gyro = made.block.gyro_b_rad_s + drift
    made = replace(made, block=replace(made.block, gyro_b_rad_s=gyro))
    found = pieces.answer(made, at_once=32, parameters=EstimatorParameters())
    assert found.misfit < 2.0
    sigmas = np.abs(made.errors(found)) / found.sigma
    assert sigmas.max() < 3.5
    assert np.all(found.sigma[6:9] < 3.0 * pieces.bound_sigmas(made, kind=ASSEMBLED)[6:9])
