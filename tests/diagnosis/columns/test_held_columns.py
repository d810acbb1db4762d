"""Columns that were logged more seldom than the sensor and held in between."""

from __future__ import annotations

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.columns.held_and_noisy import drawn_between, held_columns


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
    (one,) = held_columns(track)
    assert one.period_s == pytest.approx(rows / 12.5)
    drawn = drawn_between(track, (one,)).covariates["motor_current_a"]
    known = np.arange(0, len(values), rows)
    np.testing.assert_allclose(drawn, np.interp(np.arange(len(values)), known, values[known]))


def test_a_value_that_came_again_holds_until_one_period_before_the_next(plain):
    values = wandering(len(plain))
    values[1000:1200] = 7.0
    track = with_column(plain, held(values, 5))
    drawn = drawn_between(track, held_columns(track)).covariates["motor_current_a"]
    np.testing.assert_array_equal(drawn[1000:1196], 7.0)
    assert drawn[1198] != 7.0  # on the way to the next value


@pytest.mark.parametrize("name", ["pump_on", "vn_yaw_deg", "nobody_knows"])
def test_switches_and_what_has_no_role_stay(plain, name):
    values = held(np.sign(wandering(len(plain))) > 0, 5)
    assert held_columns(with_column(plain, values, name)) == ()


def test_levels_that_last_as_long_as_they_like_and_quick_columns_stay(plain):
    rng = np.random.default_rng(2)
    edges = np.cumsum(rng.exponential(3.0, 200))
    t = plain.time_s - plain.time_s[0]
    assert held_columns(with_column(plain, rng.uniform(0, 9, 201)[np.searchsorted(edges, t)])) == ()
    assert held_columns(with_column(plain, wandering(len(plain)))) == ()
    assert held_columns(with_column(plain, held(wandering(len(plain)), 80))) == ()  # 6.4 s
