"""The norm-preserving methods of [L] among themselves and against a general solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from simulation import FIELD, HARD_IRON, UNIT_SOFT_IRON, simulate

from ahrsd.baselines import MethodSettings, attitude_independent, run
from ahrsd.baselines.attitude_independent import (
    linear_centre,
    solve_np,
    solve_np_uncertain_field,
    tls_rows,
)

SIZE = float(np.linalg.norm(FIELD))


def noisy_sphere(n, noise=5e-3, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    norms = SIZE * (1 + 0.1 * rng.uniform(-1, 1, n))
    return norms[:, None] * u + HARD_IRON + noise * rng.normal(size=(n, 3)), norms


@pytest.mark.parametrize("kind", ["wam", "mam", "lam"])
@pytest.mark.parametrize("soft_iron", [np.eye(3), UNIT_SOFT_IRON])
def test_the_closed_form_gives_the_constrained_answer(kind, soft_iron):
    data = simulate(kind, 3, n=3000, soft_iron=soft_iron).data
    a, b = run("np", data), run("fnp", data)
    assert a.converged
    assert b.converged
    assert np.allclose(a.hard_iron_gauss, b.hard_iron_gauss, atol=1e-9)


@pytest.mark.parametrize("wrong", [0.7, 1.3])
def test_methods_agree_when_the_given_magnitude_is_far_off(wrong):
    data = replace(
        simulate("wam", 2, n=3000).data, field_n_gauss=None, field_norm_gauss=wrong * SIZE
    )
    a, b = run("np", data), run("fnp", data)
    assert a.converged
    assert a.iterations < 30
    assert np.allclose(a.hard_iron_gauss, b.hard_iron_gauss, atol=1e-8)


def test_the_readings_that_preserve_the_norm_are_the_same():
    field, norms = noisy_sphere(200)
    b, B, _ = solve_np(field, norms, linear_centre(field))
    assert np.allclose(np.linalg.norm(B - b, axis=1), norms, atol=1e-12)
    away = field - b
    nearest = b + away * (norms / np.linalg.norm(away, axis=1))[:, None]
    assert np.allclose(B, nearest, atol=1e-9)


def test_a_general_solver_agrees_on_the_constrained_problem():
    field, norms = noisy_sphere(10)

    def objective(x):
        rest = x[3:].reshape(-1, 3) - field
        return 0.5 * np.sum(rest**2), np.concatenate([np.zeros(3), rest.ravel()])

    def constraint(x):
        return np.sum((x[3:].reshape(-1, 3) - x[:3]) ** 2, axis=1) - norms**2

    start = np.concatenate([linear_centre(field), field.ravel()])
    found = minimize(
        objective, start, jac=True, method="SLSQP",
        constraints={"type": "eq", "fun": constraint}, options={"ftol": 1e-15, "maxiter": 500},
    )  # fmt: skip
    assert found.success
    b, _, _ = solve_np(field, norms, linear_centre(field))
    assert np.allclose(b, found.x[:3], atol=2e-6)


def test_alternating_ends_at_the_minimum_of_its_own_cost():
    field, norms = noisy_sphere(60, noise=0.02)
    s2, h2 = 0.02**2, 0.03**2 * np.linspace(0.2, 3, 60)
    b, _ = solve_np_uncertain_field(field, norms, s2 / (s2 + h2), linear_centre(field))

    def cost(b):
        """Both terms of the cost with B' at its best, found by brute force along the direction."""
        rho = np.linalg.norm(field - b, axis=1)
        lengths = np.linspace(rho - 0.3, rho + 0.3, 6001)
        return np.sum(np.min((rho - lengths) ** 2 / s2 + (norms - lengths) ** 2 / h2, axis=0))

    best = cost(b)
    for direction in np.eye(3):
        assert best < cost(b + 1e-3 * direction)
        assert best < cost(b - 1e-3 * direction)


def test_alternating_in_full_ends_at_the_same_place():
    """The turns as published, without lengthening them."""
    field, norms = noisy_sphere(300, noise=0.01)
    share = 0.6
    b = linear_centre(field)
    for _ in range(300):
        d = field - b
        rho = np.linalg.norm(d, axis=1)
        B = (share * rho + (1 - share) * norms)[:, None] * d / rho[:, None]
        b = np.mean(field - B, axis=0)
    quick, turns = solve_np_uncertain_field(field, norms, np.full(300, 1 - share), b * 0)
    assert np.allclose(quick, b, atol=1e-9)
    assert turns < 80


def test_readings_with_an_uncertain_field_have_less_weight():
    data = simulate("wam", 1, n=4000, soft_iron=np.eye(3)).data
    norms = np.full(4000, SIZE)
    norms[:1000] *= 1.05
    sigma = np.where(np.arange(4000) < 1000, 0.05 * SIZE, 1e-4)
    known = replace(data, field_norm_gauss=norms)
    aware = run("np-uncertain-field", known, MethodSettings(sigma_field_gauss=sigma))
    unaware = run("np-uncertain-field", known)
    assert 1e3 * np.linalg.norm(aware.hard_iron_gauss - HARD_IRON) < 0.2
    assert 1e3 * np.linalg.norm(unaware.hard_iron_gauss - HARD_IRON) > 2
    short = run("np-uncertain-field", known, MethodSettings(sigma_field_gauss=sigma[:-1]))
    assert "one number or 4000" in short.reason


def test_the_same_uncertainty_everywhere_changes_nothing():
    data = simulate("wam", 1, n=2000, soft_iron=np.eye(3)).data
    settings = MethodSettings(sigma_mag_gauss=1e-3, sigma_field_gauss=2e-3)
    sure = run("np-uncertain-field", data, settings)
    assert np.allclose(sure.hard_iron_gauss, run("fnp", data).hard_iron_gauss, atol=1e-8)


def test_total_least_squares_differs_from_norm_preservation_in_second_order_only():
    field, norms = noisy_sphere(400, noise=1e-3)
    data = replace(
        simulate("wam", n=400).data, raw_b_gauss=field, field_norm_gauss=norms, field_n_gauss=None
    )
    settings = MethodSettings(sigma_mag_gauss=1e-3)  # in no order, so that differences say nothing
    a = run("tls", data, settings).hard_iron_gauss
    b = run("fnp", data, settings).hard_iron_gauss
    difference = np.linalg.norm(a - b)
    assert 0 < difference < 1e-6
    assert np.linalg.norm(a - HARD_IRON) < 3e-4
    assert tls_rows(a, field, norms)[0].shape == (400,)


def test_iterations_without_convergence_are_reported(monkeypatch):
    data = simulate("lam", 0, n=3000).data
    monkeypatch.setattr(attitude_independent, "_NP_MAX_ITERATIONS", 2)
    monkeypatch.setattr(attitude_independent, "_MAX_TURNS", 2)
    for method, words in (("np", "no end after 2 iterations"), ("np-uncertain-field", "2 turns")):
        result = run(method, data)
        assert not result.converged
        assert words in result.reason
