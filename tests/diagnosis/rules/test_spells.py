"""When a source is away from its usual level: states, boxes and waves, and none in noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.spells import away_from_usual, best_box, best_wave, turned_over
from ahrsd.diagnosis.track import Track

COUNT = 60
RIDGE = np.eye(3) * 1e-4


def measured(truth: np.ndarray, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Information and score of a course (60, 3) whose stretches remember their neighbours."""
    rng = np.random.default_rng(seed)
    memory = 0.4 ** np.abs(np.subtract.outer(np.arange(COUNT), np.arange(COUNT)))
    root = np.kron(memory, np.eye(3))
    information = root.T @ root
    return information, information @ truth.ravel() + root.T @ rng.standard_normal(3 * COUNT)


def test_a_box_is_found_to_the_stretch() -> None:
    truth = np.zeros((COUNT, 3))
    truth[20:33] = [3.0, -2.0, 1.0]
    assert best_box(*measured(truth), RIDGE) == (20, 33)


@pytest.mark.parametrize("power", [1, 2])
def test_a_wave_is_found_from_its_beginning_to_its_end(power: int) -> None:
    truth = np.zeros((COUNT, 3))
    shape = np.sin(np.pi * (np.arange(24) + 0.5) / 24) ** power
    truth[15:39] = np.outer(shape, [5.0, 0.0, -4.0])
    told = np.flatnonzero(best_wave(*measured(truth), RIDGE))
    assert abs(int(told[0]) - 15) <= 2
    assert abs(int(told[-1]) - 38) <= 2


def test_a_switch_is_found_however_often_it_goes_on_and_noise_has_none() -> None:
    vector = np.array([1.5, -1.0, 0.5])
    on = np.zeros(COUNT)
    for first, last in ((5, 12), (18, 22), (30, 41), (50, 56)):
        on[first:last] = 1.0
    along = np.kron(np.eye(COUNT), vector[:, None])
    G, s = measured(np.outer(on, vector))
    start = np.zeros(COUNT)
    start[30:41] = 1.0
    told = turned_over(along.T @ G @ along, along.T @ s, start, 4.0)
    assert np.count_nonzero(told != on) <= 1
    G, s = measured(np.zeros((COUNT, 3)))
    assert not turned_over(along.T @ G @ along, along.T @ s, start, 4.0).any()


def test_the_usual_level_is_the_one_that_holds_longest() -> None:
    level = np.zeros((10, 3))
    level[:6] = [2.0, 0.0, 0.0]
    assert away_from_usual(level).tolist() == [False] * 6 + [True] * 4


@pytest.fixture(scope="module")
def quiet() -> Track:
    return replace(made(Trial(seed=8, samples=6000)).track, covariates={})


@pytest.mark.slow
def test_what_comes_and_goes_is_told_from_beginning_to_end(quiet: Track) -> None:
    spans_s = [(40.0, 71.0), (95.0, 128.0), (171.0, 190.0)]
    on = np.any([(quiet.time_s >= a) & (quiet.time_s < b) for a, b in spans_s], axis=0)
    field = on[:, None] * np.array([2e-3, 1e-3, -2e-3])
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + field))
    assert answer.findings == ()
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
    assert np.abs(np.array(where.intervals_s) - spans_s).max() < 2.0


@pytest.mark.slow
def test_a_bump_of_the_gyro_is_told_where_it_is(quiet: Track) -> None:
    part = np.clip((quiet.time_s - 100.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * part)[:, None] ** 2 * np.array([1e-3, -2e-3, 2e-3])
    answer = diagnose(replace(quiet, gyro_b_rad_s=quiet.gyro_b_rad_s + bump))
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "gyro"
    (begin, end) = where.intervals_s[0]
    assert begin == pytest.approx(100.0, abs=8.0)
    assert end == pytest.approx(140.0, abs=8.0)
