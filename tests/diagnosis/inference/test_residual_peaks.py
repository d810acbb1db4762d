"""Times at which steps are proposed: the largest residuals, away from the ends."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.inference.search.model_search import residual_peak_times


def test_residual_peaks_are_separated_and_away_from_the_ends():
    time_s = 0.1 * np.arange(2000)
    left = 0.1 * np.random.default_rng(1).standard_normal((2000, 3))
    for row, size in ((3, 9.0), (500, 8.0), (503, 7.0), (1200, 6.0), (1998, 9.0)):
        left[row] += size
    found = residual_peak_times(left, time_s)
    np.testing.assert_allclose(found[:2], [50.0, 120.0], atol=0.11)
    assert min(found) > 2.0
    assert max(found) < time_s[-1] - 2.0
