"""The misfit: its value for a correct model, and its spread by chance."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd.estimator.epoch import Misfit, misfit_scores
from ahrsd.estimator.graph import SIZE, Factor, LinearisationPoint, Node

EPOCHS = 20


def _misfit(rng, louder=1.0):
    """Misfit of epochs whose gradients have `louder` times the sigma of their information."""
    node = Node.at(np.zeros(3), np.array([0.0, 0.6, 0.8]))
    point, factors = LinearisationPoint(np.zeros(9), node, node), []
    for k in range(EPOCHS):
        J = rng.normal(size=(40, SIZE))
        g = louder * J.T @ rng.normal(size=40)
        factors.append(Factor(k, k + 1, J.T @ J, g, point))
    nodes = dict.fromkeys(range(EPOCHS + 1), node)
    graph = SimpleNamespace(c=np.zeros(9), nodes=nodes)
    still = np.zeros(9), dict.fromkeys(nodes, np.zeros(5))
    return Misfit().value(factors, misfit_scores(factors), graph, still)


def test_misfit_of_a_correct_model_has_the_predicted_mean_and_spread():
    rng = np.random.default_rng(0)
    found = np.array([_misfit(rng) for _ in range(150)])
    freedom = 12 * EPOCHS
    assert found[:, 0].mean() == pytest.approx(freedom / (freedom - 12), rel=0.02)
    assert found[:, 0].std() == pytest.approx(found[0, 1], rel=0.2)


def test_misfit_shows_epochs_that_disagree():
    figure, chance = _misfit(np.random.default_rng(1), louder=2.0)
    assert figure == pytest.approx(4.2, rel=0.3)
    assert figure > 1.0 + 10 * chance
