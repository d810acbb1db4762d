"""What a logger does to a column: it holds values in between, or adds noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from tracks import experiment, track_of

from ahrsd.diagnosis.columns.held_and_noisy import (
    denoise_columns,
    denoised_column,
    find_held_columns,
    find_logging_pattern,
    interpolate_held_columns,
)

ROWS = 12_000


@pytest.fixture(scope="module")
def plain():
    """300 s at 12.5 Hz without a further column."""
    return track_of(experiment("wam", motion="rov", seed=4, samples=3750, rate_hz=12.5))


def with_column(track, values, name="motor_current_a"):
    return track.with_columns({name: np.asarray(values, float)})


def held(values, rows):
    return values[(np.arange(len(values)) // rows) * rows]


def wandering(count, seed=1):
    return np.cumsum(np.random.default_rng(seed).standard_normal(count))


@pytest.mark.parametrize("rows", [2, 5, 13])
def test_what_was_held_is_drawn_straight_between_its_values(plain, rows):
    values = wandering(len(plain))
    track = with_column(plain, held(values, rows))
    (one,) = find_held_columns(track)
    assert one.period_s == pytest.approx(rows / 12.5)
    drawn = interpolate_held_columns(track, (one,)).covariates["motor_current_a"]
    known = np.arange(0, len(values), rows)
    np.testing.assert_allclose(drawn, np.interp(np.arange(len(values)), known, values[known]))


def test_a_value_that_came_again_holds_until_one_period_before_the_next(plain):
    values = wandering(len(plain))
    values[1000:1200] = 7.0
    track = with_column(plain, held(values, 5))
    drawn = interpolate_held_columns(track, find_held_columns(track)).covariates["motor_current_a"]
    np.testing.assert_array_equal(drawn[1000:1196], 7.0)
    assert drawn[1198] != 7.0  # on the way to the next value


@pytest.mark.parametrize("name", ["pump_on", "vn_yaw_deg", "nobody_knows"])
def test_switches_and_what_has_no_role_stay(plain, name):
    values = held(np.sign(wandering(len(plain))) > 0, 5)
    assert find_held_columns(with_column(plain, values, name)) == ()


def test_levels_that_last_as_long_as_they_like_and_quick_columns_stay(plain):
    rng = np.random.default_rng(2)
    edges = np.cumsum(rng.exponential(3.0, 200))
    t = plain.time_s - plain.time_s[0]
    assert (
        find_held_columns(with_column(plain, rng.uniform(0, 9, 201)[np.searchsorted(edges, t)]))
        == ()
    )
    assert find_held_columns(with_column(plain, wandering(len(plain)))) == ()
    assert find_held_columns(with_column(plain, held(wandering(len(plain)), 80))) == ()  # 6.4 s


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
    line = find_logging_pattern(drawn(values, rows))
    assert (line.rows, line.first, line.held) == (rows, 0, False)
    held = find_logging_pattern(np.repeat(values[::rows], rows)[3:])
    assert (held.rows, held.first, held.held) == (rows, (rows - 3) % rows, True)
    assert find_logging_pattern(values).rows == 1


@pytest.mark.parametrize("rows", [1, 4, 10])
def test_the_noise_goes_and_the_course_stays(rows: int) -> None:
    true = course(3)
    values = drawn(true + np.random.default_rng(4).normal(0.0, 0.1, ROWS), rows)
    found = denoised_column(values)
    assert found is not None
    before, after = (np.std(v - drawn(true, rows)) for v in (values, found))
    assert after < 0.5 * before
    # of the course next to nothing is taken with it
    assert found @ true / (true @ true) == pytest.approx(1.0, abs=0.01)


def test_steps_coloured_noise_and_what_is_all_noise_are_left_alone() -> None:
    rng = np.random.default_rng(5)
    steps = np.repeat(rng.uniform(0.0, 10.0, ROWS // 200), 200)
    assert denoised_column(steps) is None
    assert denoised_column(steps + rng.normal(0.0, 0.03, ROWS)) is None
    assert denoised_column(course(6) + 0.05 * course(7, width=1.0)) is None
    assert denoised_column(rng.normal(size=ROWS)) is None
    assert denoised_column(np.zeros(ROWS)) is None


def test_a_track_with_pauses_is_left_alone() -> None:
    track = track_of(experiment("wam", motion="rov", seed=4, samples=2000, rate_hz=12.5))
    noisy = course(8, 2000) + np.random.default_rng(9).normal(0.0, 0.1, 2000)
    track = track.with_columns({"speed_m_s": noisy})
    clean = denoise_columns(track, ("speed_m_s",))
    assert clean is not None
    assert np.std(clean.covariates["speed_m_s"] - course(8, 2000)) < 0.05
    parts = replace(track, runs=(slice(0, 900), slice(900, 2000)))
    assert denoise_columns(parts, ("speed_m_s",)) is None
