"""Deviations of random effects: slope against differences, maximum against a general method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from ahrsd.diagnosis.rules import variances

LOW, HIGH = -6.0, 8.0
GROUPS = np.repeat([0, 1, 2], [12, 20, 5]).astype(np.intp)


def problem(seed: int, deviations: tuple[float, float, float]):
    """Products of 37 columns that overlap with 90 readings, (G, s)."""
    rng = np.random.default_rng(seed)
    Z = rng.normal(size=(90, 37)) @ (np.eye(37) + 0.3 * rng.normal(size=(37, 37)) / 6.0)
    y = Z @ (np.array(deviations)[GROUPS] * rng.normal(size=37)) + rng.normal(size=90)
    return Z.T @ Z, Z.T @ y, Z, y


def likelihood(Z: np.ndarray, y: np.ndarray, sizes: np.ndarray) -> float:
    """Of the readings by their own covariance, over that of noise alone."""
    V = np.eye(len(y)) + (Z * np.exp(2 * sizes)[GROUPS]) @ Z.T
    return float(0.5 * y @ y - 0.5 * y @ np.linalg.solve(V, y) - 0.5 * np.linalg.slogdet(V)[1])


def test_likelihood_and_slope_are_those_of_the_readings():
    G, s, Z, y = problem(1, (0.5, 0.1, 2.0))
    sizes = np.array([-1.0, -2.0, 0.4])
    at = variances._at(G, s, GROUPS, sizes)
    assert at.nats == pytest.approx(likelihood(Z, y, sizes), abs=1e-8)
    for k in range(3):
        change = 1e-5 * np.eye(3)[k]
        slope = (likelihood(Z, y, sizes + change) - likelihood(Z, y, sizes - change)) / 2e-5
        assert at.slope[k] == pytest.approx(slope, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("start", [-3.0, 0.0, 5.0])
@pytest.mark.parametrize("deviations", [(0.5, 0.1, 2.0), (0.0, 0.3, 0.0), (3.0, 0.01, 1.0)])
def test_no_general_method_finds_what_is_likelier(deviations, start):
    G, s, Z, y = problem(2, deviations)
    nats, sizes = variances.fitted(
        G, s, GROUPS, np.full(3, start), np.full(3, LOW), np.full(3, HIGH)
    )
    assert nats == pytest.approx(likelihood(Z, y, sizes), abs=1e-8)
    others = [
        minimize(lambda t: -likelihood(Z, y, t), begin, method="Nelder-Mead").fun
        for begin in (np.zeros(3), sizes)
    ]
    assert nats > -min(others) - 5e-3


def test_what_is_not_there_is_as_small_as_allowed():
    G, s, _, _ = problem(5, (1.0, 0.0, 1.0))
    _, sizes = variances.fitted(G, s, GROUPS, np.zeros(3), np.full(3, LOW), np.full(3, HIGH))
    assert sizes[1] < -2.5  # a twelfth of the noise of one coefficient
    assert np.exp(sizes[0]) == pytest.approx(1.0, rel=0.6)


def test_bounds_hold():
    G, s, _, _ = problem(6, (5.0, 5.0, 5.0))
    high = np.array([HIGH, 0.3, HIGH])
    _, sizes = variances.fitted(G, s, GROUPS, np.zeros(3), np.full(3, LOW), high)
    assert sizes[1] == pytest.approx(0.3)
