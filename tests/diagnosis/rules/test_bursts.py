"""Bursts of a second that come and go, and what is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.rules.bursts import closest, loud_rows
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.track import Track


def test_a_mean_is_loud_and_noise_that_is_louder_is_not() -> None:
    left = np.random.default_rng(2).standard_normal((4000, 3))
    assert not loud_rows(left, 10.0, 1.0).any()
    noisy = left.copy()
    noisy[1000:1100] *= 8.0
    assert not loud_rows(noisy, 10.0, 1.0).any()
    pushed = left.copy()
    pushed[1000:1012] += [4.0, -3.0, 0.0]
    rows = np.flatnonzero(loud_rows(pushed, 10.0, 1.0))
    assert 990 <= rows.min() <= 1002
    assert 1008 <= rows.max() <= 1022


@pytest.mark.parametrize("shape", [np.ones(15), np.sin(np.pi * (np.arange(15) + 0.5) / 15)])
def test_a_burst_is_told_from_its_beginning_to_its_end(shape: np.ndarray) -> None:
    left = np.random.default_rng(3).standard_normal((400, 3))
    left[200:215] += np.outer(shape, [6.0, -5.0, 0.0])
    start, end = closest(left, 188, 226)
    assert abs(start - 200) <= 1
    assert abs(end - 215) <= 1


@pytest.fixture(scope="module")
def quiet() -> Track:
    return replace(made(Trial(seed=8, samples=6000)).track, covariates={})


def test_nothing_is_said_of_a_quiet_recording_but_what_it_would_have_shown(quiet: Track) -> None:
    answer = diagnose(quiet)
    assert not answer.mismatch
    assert any("stuck" in note for note in answer.notes)
    assert all(test.p_after > 1e-6 for test in answer.omnibus.values())
