"""Effects of a logger on a column: values held between updates, and added noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from tracks import experiment, track_of

from ahrsd.diagnosis.columns.held_and_noisy import (
    denoise_columns,
    denoised_column,
    find_held_column,
    find_logging_pattern,
    interpolate_held_column,
)

ROWS = 12_000


@pytest.fixture(scope="module")
def plain():
    """300 s at 12.5 Hz without a further column."""
    return track_of(experiment("wam", motion="rov", seed=4, samples=3750, rate_hz=12.5))


CURRENT = "motor_current_a"


def with_column(track, values, name=CURRENT):
    return track.with_columns({name: np.asarray(values, float)})


def held(values, rows):
    return values[(np.arange(len(values)) // rows) * rows]


def wandering(count, seed=1):
    return np.cumsum(np.random.default_rng(seed).standard_normal(count))


@pytest.mark.parametrize("rows", [2, 5, 13])
def test_held_column_is_interpolated_linearly_between_its_values(plain, rows):
    values = wandering(len(plain))
    track = with_column(plain, held(values, rows))
    one = find_held_column(track, CURRENT)
    assert one.period_s == pytest.approx(rows / 12.5)
    logged_values = interpolate_held_column(track, one).covariates[CURRENT]
    known = np.arange(0, len(values), rows)
    np.testing.assert_allclose(
        logged_values, np.interp(np.arange(len(values)), known, values[known])
    )


def test_repeated_value_is_kept_until_one_period_before_the_next(plain):
    values = wandering(len(plain))
    values[1000:1200] = 7.0
    track = with_column(plain, held(values, 5))
    found = find_held_column(track, CURRENT)
    logged_values = interpolate_held_column(track, found).covariates[CURRENT]
    np.testing.assert_array_equal(logged_values[1000:1196], 7.0)
    assert logged_values[1198] != 7.0  # on the way to the next value


@pytest.mark.parametrize("name", ["pump_on", "vn_yaw_deg", "nobody_knows"])
def test_switches_and_columns_without_a_role_are_not_interpolated(plain, name):
    values = held(np.sign(wandering(len(plain))) > 0, 5)
    assert find_held_column(with_column(plain, values, name), name) is None


def test_levels_of_irregular_length_and_fast_columns_are_not_interpolated(plain):
    rng = np.random.default_rng(2)
    edges = np.cumsum(rng.exponential(3.0, 200))
    t = plain.time_s - plain.time_s[0]
    irregular = rng.uniform(0, 9, 201)[np.searchsorted(edges, t)]
    too_long = held(wandering(len(plain)), 80)  # 6.4 s
    for values in (irregular, wandering(len(plain)), too_long):
        assert find_held_column(with_column(plain, values), CURRENT) is None


def smooth_values(seed: int, rows: int = ROWS, width: float = 120.0) -> np.ndarray:
    """Smooth values with unit standard deviation."""
    values = gaussian_filter1d(np.random.default_rng(seed).normal(size=rows), width)
    return values / values.std()


def logged_values(values: np.ndarray, rows: int) -> np.ndarray:
    """One value every `rows` rows, linear interpolation between, four decimals as in a file."""
    at = np.arange(0, len(values), rows)
    return np.round(np.interp(np.arange(len(values)), at, values[at]), 4)


@pytest.mark.parametrize("rows", [4, 5, 20])
def test_logging_pattern_of_interpolated_and_held_columns_is_found(rows: int) -> None:
    values = smooth_values(1) + np.random.default_rng(2).normal(0.0, 0.05, ROWS)
    line = find_logging_pattern(logged_values(values, rows))
    assert (line.rows, line.first, line.held) == (rows, 0, False)
    held = find_logging_pattern(np.repeat(values[::rows], rows)[3:])
    assert (held.rows, held.first, held.held) == (rows, (rows - 3) % rows, True)
    assert find_logging_pattern(values).rows == 1


@pytest.mark.parametrize("rows", [1, 4, 10])
def test_denoised_column_has_less_noise_and_the_same_signal(rows: int) -> None:
    true = smooth_values(3)
    values = logged_values(true + np.random.default_rng(4).normal(0.0, 0.1, ROWS), rows)
    found = denoised_column(values)
    assert found is not None
    before, after = (np.std(v - logged_values(true, rows)) for v in (values, found))
    assert after < 0.5 * before
    # the signal itself is hardly reduced
    assert found @ true / (true @ true) == pytest.approx(1.0, abs=0.01)


def test_steps_coloured_noise_and_pure_noise_are_not_denoised() -> None:
    rng = np.random.default_rng(5)
    steps = np.repeat(rng.uniform(0.0, 10.0, ROWS // 200), 200)
    assert denoised_column(steps) is None
    assert denoised_column(steps + rng.normal(0.0, 0.03, ROWS)) is None
    assert denoised_column(smooth_values(6) + 0.05 * smooth_values(7, width=1.0)) is None
    assert denoised_column(rng.normal(size=ROWS)) is None
    assert denoised_column(np.zeros(ROWS)) is None


def test_columns_are_not_denoised_when_the_track_has_pauses() -> None:
    track = track_of(experiment("wam", motion="rov", seed=4, samples=2000, rate_hz=12.5))
    noisy = smooth_values(8, 2000) + np.random.default_rng(9).normal(0.0, 0.1, 2000)
    track = track.with_columns({"speed_m_s": noisy})
    clean = denoise_columns(track, ("speed_m_s",))
    assert clean is not None
    assert np.std(clean.covariates["speed_m_s"] - smooth_values(8, 2000)) < 0.05
    parts = replace(track, runs=(slice(0, 900), slice(900, 2000)))
    assert denoise_columns(parts, ("speed_m_s",)) is None
