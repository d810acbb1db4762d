"""What a regression says of a group of columns: what it shows, what it is worth, what not."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter.evidence import posterior
from ahrsd.diagnosis.innovation_filter.score import solve, total_score


def test_a_direction_counts_where_a_coefficient_at_its_bound_would_show():
    effect = EFFECTS["mag_bias_temperature"]
    assert effect.least_information == pytest.approx((3 / 50) ** 2)
    scale = np.array([one.scale for one in effect.parameters])
    G = np.diag([0.1, 0.1, 1e-4]) / np.outer(scale, scale)
    s = np.array([3.0, 0.0, 0.0]) / scale
    assert total_score(G, s, np.diag(G), scale).rank == 0
    what = total_score(G, s, np.diag(G), scale, effect.least_information)
    assert what.rank == 2
    np.testing.assert_allclose(what.value, [30 * scale[0], 0.0, 0.0], atol=1e-12)


def test_posterior_sums_to_one_and_follows_the_odds():
    found = posterior({"a": 3.0, "b": 0.0, "c": 0.0}, {"c": -1.0})
    assert sum(found.values()) == pytest.approx(1.0, abs=1e-12)
    assert found["a"] / found["b"] == pytest.approx(np.exp(3.0))
    assert found["b"] / found["c"] == pytest.approx(np.e)


def test_a_direction_without_information_is_left_at_zero():
    G = np.diag([4.0, 1.0, 0.0]) + 0.0
    np.testing.assert_allclose(solve(G, np.array([[8.0], [3.0], [0.0]]))[:, 0], [2.0, 3.0, 0.0])
