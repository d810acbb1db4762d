"""The play operator, against one row after the other."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.diagnosis.time_series import play


@pytest.mark.parametrize("memory", [None, (0.3, -1.0, 0.9)])
def test_play_is_that_of_one_row_after_the_other(memory):
    values = np.cumsum(np.random.default_rng(3).standard_normal((777, 3)), axis=0)
    for radius in (0.01, 2.0, 40.0):
        last = values[0] + radius * np.asarray(memory or (0.0, 0.0, 0.0))
        for row, found in zip(values, play(values, radius, memory), strict=True):
            last = np.clip(last, row - radius, row + radius)
            np.testing.assert_array_equal(found, last)
