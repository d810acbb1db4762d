"""Steps of a regular clock in periods: what is missing, and what only looks so."""

import numpy as np
import pytest

from ahrsd.samples import in_periods


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.3, 0.6])
def test_steps_over_missing_samples_are_whole_periods(missing):
    dice = np.random.default_rng(1)
    kept = np.flatnonzero(dice.random(2000) >= missing)
    time_s = 0.025 * kept + dice.normal(0.0, 2e-4, len(kept))
    periods = in_periods(np.diff(time_s))
    assert periods is not None
    np.testing.assert_array_equal(np.rint(periods), np.diff(kept))


def test_a_clock_that_is_rounded_to_ticks_misses_nothing():
    time_s = np.floor(np.arange(2000) * 0.016487 / 0.01) * 0.01
    assert set(np.rint(np.diff(time_s) / 0.01)) == {1.0, 2.0}
    assert in_periods(np.diff(time_s)) is None


def test_steps_that_scatter_are_no_multiples():
    steps_s = 0.02 * np.random.default_rng(1).uniform(0.6, 2.4, 500)
    assert in_periods(steps_s) is None
    assert in_periods(np.zeros(0)) is None
