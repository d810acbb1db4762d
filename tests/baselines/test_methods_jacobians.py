"""Every analytic derivative against central differences, the graphs' ones through GTSAM itself."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from ahrsd.baselines import attitude_independent, graph_methods
from ahrsd.baselines.attitude_independent import fnp_rows, tls_rows
from ahrsd.baselines.data import MethodError
from ahrsd.baselines.graph_methods import (
    SIGMA,
    Kinematics,
    cholesky,
    custom_factor,
    factors,
    residual,
    triangle,
    unit_volume,
    values_of,
    variable,
)

RNG = np.random.default_rng(7)
KIN = Kinematics(*(RNG.normal(size=(6, 3)) for _ in range(3)))
MODELS = {
    "magical-nls": graph_methods.unit_volume_model(),
    "magical-bfg": graph_methods.triangle_model(),
    "magyc-bfg": graph_methods.cholesky_model(),
}


def numeric(function, x, step=1e-6):
    columns = []
    for i in range(len(x)):
        d = np.zeros(len(x))
        d[i] = step
        columns.append(
            (np.atleast_1d(function(x + d)) - np.atleast_1d(function(x - d))) / (2 * step)
        )
    return np.stack(columns, axis=-1)


def near_start(model, scale=0.1):
    return model.start + scale * RNG.normal(size=len(model.start))


@pytest.mark.parametrize(
    ("shape", "x"),
    [
        (unit_volume, np.array([1.3, 0.1, -0.2, 0.8, 0.05, 1.1])),
        (triangle, np.array([1.3, 0.1, -0.2, 0.8, 0.05, 1.1])),
        (cholesky, np.array([0.2, -0.3, 0.1, 0.4, -0.1])),
    ],
)
def test_soft_iron_parametrisations(shape, x):
    _, J = shape(x)
    assert np.allclose(J, numeric(lambda v: shape(v)[0], x), atol=1e-8)


def test_kinematic_residual():
    x = RNG.normal(size=12)
    _, J = residual(KIN, x[:6], x[6:9], x[9:])
    assert np.allclose(J, numeric(lambda v: residual(KIN, v[:6], v[6:9], v[9:])[0], x), atol=1e-7)


@pytest.mark.parametrize("name", MODELS)
def test_models(name):
    model = MODELS[name]
    x = near_start(model)
    J = numeric(lambda v: model.residual(KIN, v)[0], x)
    assert np.allclose(model.residual(KIN, x)[1], J, atol=1e-7)
    J = numeric(lambda v: model.norm_residual(v)[0], x)
    assert np.allclose(model.norm_residual(x)[1], J, atol=1e-7)


@pytest.mark.parametrize("name", ["magical-bfg", "magyc-bfg"])
def test_factors_in_gtsam(name):
    model = MODELS[name]
    x = near_start(model)
    made = factors(model, KIN)
    assert len(made) == (2 if name == "magical-bfg" else 1)
    weights = [1 / SIGMA, np.sqrt(len(KIN)) / SIGMA]  # n equal norm factors weigh n times one
    for factor, weight in zip(made, weights, strict=False):
        A, b = factor.linearize(values_of(x, model.nodes)).jacobian()

        def error(v, factor=factor):
            return factor.unwhitenedError(values_of(v, model.nodes))

        assert np.allclose(A / weight, numeric(error, x), atol=1e-7)
        assert np.allclose(-b / weight, error(x), atol=1e-9)


def test_magfactor3():
    body, raw = RNG.normal(size=(5, 3)), RNG.normal(size=(5, 3))
    x = RNG.normal(size=4)
    _, J = graph_methods.magfactor3_residual(x, body, raw)
    assert np.allclose(
        J, numeric(lambda v: graph_methods.magfactor3_residual(v, body, raw)[0], x), atol=1e-8
    )


@pytest.mark.parametrize("rows", [tls_rows, fnp_rows])
def test_norm_methods(rows):
    field, norms, b = RNG.normal(size=(6, 3)), RNG.uniform(0.5, 1, 6), np.array([3.0, -1.0, 0.5])
    assert np.allclose(
        rows(b, field, norms)[1], numeric(lambda v: rows(v, field, norms)[0], b), atol=1e-8
    )


def test_twostep_size_of_the_bias():
    theta = 0.1 * RNG.normal(size=9)
    assert np.allclose(
        attitude_independent.bias_size(theta)[1],
        numeric(lambda v: attitude_independent.bias_size(v)[0], theta)[0],
        atol=1e-8,
    )


@pytest.mark.parametrize(
    ("r", "J", "words"),
    [
        (np.zeros(3), np.zeros((3, 2)), "returned"),
        (np.zeros(3), np.zeros(12), "returned"),
        (np.zeros(2), np.zeros((3, 4)), "returned"),
        (np.array([0.0, np.nan, 0.0]), np.zeros((3, 4)), "not finite"),
        (np.zeros(3), np.full((3, 4), np.inf), "not finite"),
    ],
)
def test_the_wrapper_stops_what_would_crash_gtsam(r, J, words):
    graph = gtsam.NonlinearFactorGraph()
    graph.add(custom_factor(lambda _: (r, J), 3, (1, 3), 1.0))
    with pytest.raises(MethodError, match=words):
        gtsam.LevenbergMarquardtOptimizer(graph, values_of(np.zeros(4), (1, 3))).optimize()


def test_one_vectorised_factor_is_the_sum_of_one_per_window():
    model = MODELS["magical-bfg"]
    values = values_of(near_start(model), model.nodes)
    together = sum(factor.error(values) for factor in factors(model, KIN))
    apart = sum(
        factor.error(values) for k in range(len(KIN)) for factor in factors(model, KIN[k : k + 1])
    )
    assert together == pytest.approx(apart, rel=1e-12)
    assert gtsam.Symbol(variable(1)).index() == 1
