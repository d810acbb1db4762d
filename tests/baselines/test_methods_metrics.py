"""The figures by which methods are compared."""

from __future__ import annotations

import numpy as np
from simulation import HARD_IRON, UNIT_SOFT_IRON, clean

from ahrsd.baselines.data import corrected, field_spread


def test_the_right_calibration_has_no_spread():
    run = clean(n=3000)
    raw = run.data.raw_b_gauss
    right = corrected(raw, UNIT_SOFT_IRON, HARD_IRON)
    assert np.allclose(right, run.field_b, atol=1e-14)
    assert field_spread(right) < 1e-14
    assert field_spread(raw) > 0.1


def test_spread_of_two_sizes():
    assert field_spread(np.array([[1.0, 0, 0], [0, 3.0, 0]])) == 0.5


def test_without_a_soft_iron_only_the_hard_iron_is_taken_away():
    raw = np.array([[1.0, 2.0, 3.0]])
    assert corrected(raw, None, np.array([1.0, 1.0, 1.0])).tolist() == [[0.0, 1.0, 2.0]]
