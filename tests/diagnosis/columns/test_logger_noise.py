"""What a logger adds to a column is told from the column's course, or left as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from tracks import experiment, track_of

from ahrsd.diagnosis.columns.held_and_noisy import cleaned, logged, without_noise

ROWS = 12_000


def course(seed: int, rows: int = ROWS, width: float = 120.0) -> np.ndarray:
    """A smooth course of deviation 1."""
    values = gaussian_filter1d(np.random.default_rng(seed).normal(size=rows), width)
    return values / values.std()


def drawn(values: np.ndarray, rows: int) -> np.ndarray:
    """Every so many rows a value, straight lines between, with four decimals as a file has them."""
    at = np.arange(0, len(values), rows)
    return np.round(np.interp(np.arange(len(values)), at, values[at]), 4)


@pytest.mark.parametrize("rows", [4, 5, 20])
def test_how_a_column_was_logged(rows: int) -> None:
    values = course(1) + np.random.default_rng(2).normal(0.0, 0.05, ROWS)
    line = logged(drawn(values, rows))
    assert (line.rows, line.first, line.held) == (rows, 0, False)
    held = logged(np.repeat(values[::rows], rows)[3:])
    assert (held.rows, held.first, held.held) == (rows, (rows - 3) % rows, True)
    assert logged(values).rows == 1


@pytest.mark.parametrize("rows", [1, 4, 10])
def test_the_noise_goes_and_the_course_stays(rows: int) -> None:
    true = course(3)
    values = drawn(true + np.random.default_rng(4).normal(0.0, 0.1, ROWS), rows)
    found = without_noise(values)
    assert found is not None
    before, after = (np.std(v - drawn(true, rows)) for v in (values, found))
    assert after < 0.5 * before
    # of the course next to nothing is taken with it
    assert found @ true / (true @ true) == pytest.approx(1.0, abs=0.01)


def test_steps_coloured_noise_and_what_is_all_noise_are_left_alone() -> None:
    rng = np.random.default_rng(5)
    steps = np.repeat(rng.uniform(0.0, 10.0, ROWS // 200), 200)
    assert without_noise(steps) is None
    assert without_noise(steps + rng.normal(0.0, 0.03, ROWS)) is None
    assert without_noise(course(6) + 0.05 * course(7, width=1.0)) is None
    assert without_noise(rng.normal(size=ROWS)) is None
    assert without_noise(np.zeros(ROWS)) is None


def test_a_track_with_pauses_is_left_alone() -> None:
    track = track_of(experiment("wam", motion="rov", seed=4, samples=2000, rate_hz=12.5))
    noisy = course(8, 2000) + np.random.default_rng(9).normal(0.0, 0.1, 2000)
    track = track.with_columns({"speed_m_s": noisy})
    clean = cleaned(track, ("speed_m_s",))
    assert clean is not None
    assert np.std(clean.covariates["speed_m_s"] - course(8, 2000)) < 0.05
    parts = replace(track, runs=(slice(0, 900), slice(900, 2000)))
    assert cleaned(parts, ("speed_m_s",)) is None
