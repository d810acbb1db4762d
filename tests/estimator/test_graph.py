"""Factors and graph compared with dense algebra, values that GTSAM must never see, and finite
steps.
"""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.graph import (
    NODE,
    SIZE,
    C,
    Factor,
    Graph,
    LinearisationPoint,
    Moments,
    Node,
    SingularError,
    Stack,
    bias_prior,
    chain_step,
    curvature_covariance,
    epoch_factor,
    gap_factor,
    retract,
    valley_step,
)

SIGMA = np.r_[np.full(6, 0.3), np.full(3, 0.5)]


def random_graph(nodes=6, seed=0, *, rank=12):
    """A linear graph: its factors are linearised at the present values, so that nothing is
    approximate.
    """
    rng = np.random.default_rng(seed)
    c = rng.normal(size=9)
    directions = rng.normal(size=(nodes, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = [Node.at(rng.normal(size=3) * 0.01, d) for d in directions]
    graph = Graph(c, np.diag(SIGMA**2), places[0], bias_prior(0, c, places[0], 0.05))
    for j in range(nodes - 1):
        graph.nodes[j + 1] = places[j + 1]
        J = rng.normal(size=(rank, SIZE)) * 10.0
        point = LinearisationPoint(c.copy(), places[j], places[j + 1])
        walk = 0.0 if j == 2 else 1e6
        graph.factors.append(Factor(j, j + 1, J.T @ J, J.T @ rng.normal(size=rank), point, walk))
    return graph


def dense(graph):
    """H and g of all factors and the anchor over [c, y_first ... y_last]."""
    first, size = graph.first, 9 + NODE * len(graph.nodes)
    H, g = np.zeros((size, size)), np.zeros(size)
    own = zip(*Stack([graph.prior, *graph.factors], graph.c, graph.nodes).quadratics(), strict=True)
    for factor, (own_H, own_g) in zip((graph.prior, *graph.factors), own, strict=True):
        rows = np.r_[0:9, 9 + NODE * (factor.a - first) : 14 + NODE * (factor.a - first)]
        if factor.b != factor.a:
            rows = np.r_[rows, 9 + NODE * (factor.b - first) : 14 + NODE * (factor.b - first)]
        H[np.ix_(rows, rows)] += own_H[: len(rows), : len(rows)]
        g[rows] += own_g[: len(rows)]
    belief = graph.temper * np.diag(1 / SIGMA**2)
    H[C, C] += belief
    g[C] += belief @ (graph.c - graph.anchor[0])
    return H, g


def test_step_and_covariance_equal_dense_algebra():
    graph = random_graph()
    H, g = dense(graph)
    expected = -np.linalg.solve(H, g)
    dc, dy = graph.step()
    np.testing.assert_allclose(dc, expected[:9], rtol=1e-7)
    for j in graph.nodes:
        np.testing.assert_allclose(dy[j], expected[9 + 5 * j : 14 + 5 * j], rtol=1e-6, atol=1e-12)
    inverse = np.linalg.inv(H)
    keep = np.r_[0:9, 9 + 5 * 5 : 12 + 5 * 5]
    np.testing.assert_allclose(graph.covariance(), inverse[np.ix_(keep, keep)], rtol=1e-6)


@pytest.mark.parametrize("folds", [1, 3, 4])
def test_folding_does_not_change_the_posterior(folds):
    whole, folded = random_graph(), random_graph()
    for _ in range(folds):
        folded.fold_oldest()
    assert len(folded.nodes) == 6 - folds
    np.testing.assert_allclose(folded.step()[0], whole.step()[0], rtol=1e-6)
    np.testing.assert_allclose(folded.covariance(), whole.covariance(), rtol=1e-6)


def test_order_of_folding_and_moving_does_not_matter():
    """A folded epoch keeps its information when the values change."""
    early, late = random_graph(), random_graph()
    early.fold_oldest()
    step = np.linspace(-0.2, 0.2, 9)
    for graph in (early, late):
        graph.c = graph.c + step
    late.fold_oldest()
    np.testing.assert_allclose(early.step()[0], late.step()[0], rtol=1e-6)


def test_second_step_after_moving_to_the_solution_is_of_second_order():
    """Tangents change with the nodes. A second step must find the same minimum to second order."""
    graph = random_graph()
    for factor in graph.factors:
        factor.g[:] *= 1e-4
    first = graph.step()
    graph.move(*first)
    second = graph.step()
    sizes = [max(np.abs(v).max() for v in dy.values()) for _, dy in (first, second)]
    assert 1e-4 < sizes[0] < 0.1
    assert sizes[1] < sizes[0] ** 2
    assert np.abs(second[0]).max() < np.abs(first[0]).max() * sizes[0]


def test_chart_change_of_a_node_and_its_derivative():
    """z and its derivative are the old coordinates of the present direction and tangents."""
    u = np.array([0.6, 0.0, 0.8])
    old = Node.at(np.zeros(3), u)
    new = old.moved_by(np.array([0.1, 0.2, 0.3, 1e-3, -2e-3]))
    weights = np.random.default_rng(0).normal(size=SIZE)
    factor = Factor(
        0, 1, np.zeros((SIZE, SIZE)), weights, LinearisationPoint(np.zeros(9), old, old)
    )
    stack = Stack([factor], np.ones(9), {0: new, 1: old})
    z, g = stack.z[0], stack.quadratics()[1][0]
    np.testing.assert_allclose(z[:9], 1.0)
    np.testing.assert_allclose(z[9:14], [0.1, 0.2, 0.3, 1e-3, -2e-3], atol=1e-8)
    h = np.array([3e-7, -5e-7])
    further = new.moved_by(np.r_[np.zeros(3), h])
    z2 = Stack([factor], np.ones(9), {0: further, 1: old}).z[0]
    assert weights @ (z2 - z) == pytest.approx(g[12:14] @ h, abs=1e-11)
    np.testing.assert_allclose(z[14:], 0.0)


def test_rise_integrates_the_gradient():
    graph = random_graph()
    factor = graph.factors[0]
    a, b = graph.nodes[0], graph.nodes[1]

    def rise(c, a, b):
        return Stack([factor], c, {0: a, 1: b}).cost_increases()[0]

    assert rise(graph.c, a, b) == pytest.approx(0.5e6 * np.sum((b.bias - a.bias) ** 2))
    g = Stack([factor], graph.c, graph.nodes).quadratics()[1][0]
    h = np.random.default_rng(1).normal(size=SIZE) * 1e-6
    sides = [
        rise(graph.c + s * h[:9], a.moved_by(s * h[9:14]), b.moved_by(s * h[14:]))
        for s in (1.0, -1.0)
    ]
    assert sides[0] - sides[1] == pytest.approx(2 * g @ h, rel=1e-5)


def test_epoch_that_does_not_calibrate_informs_only_the_bias():
    """Its marginal over the borders at the present c, across the field. A token weight on the
    borders moves those that nothing else determines to the epoch's own solution.
    """
    rng = np.random.default_rng(0)
    J = rng.normal(size=(40, 16)) * 100

    class Quadratic:
        H = J.T @ J
        g = J.T @ rng.normal(size=40)

    node = Node.at(np.zeros(3), np.array([0.0, 0.6, 0.8]))
    factor = epoch_factor(
        Quadratic, 0, LinearisationPoint(np.zeros(9), node, node), 0.0, rest=node.direction
    )
    own = Quadratic.H[9:, 9:]
    expected = np.zeros((SIZE, SIZE))
    across = np.eye(3) - np.outer([0.0, 0.6, 0.8], [0.0, 0.6, 0.8])
    marginal = np.linalg.inv(np.linalg.inv(own)[:3, :3])
    expected[9:12, 9:12] = across @ marginal @ across
    expected[[12, 13, 17, 18], [12, 13, 17, 18]] = 1.0
    np.testing.assert_allclose(factor.H, expected, atol=1e-6)
    gradient = across @ marginal @ np.linalg.solve(own, Quadratic.g[9:])[:3]
    np.testing.assert_allclose(factor.g[9:12], gradient, rtol=1e-6)
    assert not np.delete(factor.g, [9, 10, 11]).any()
    point = LinearisationPoint(np.zeros(9), node, node)
    drawn = epoch_factor(Quadratic, 0, point, 0.0, rest=node.direction, drawn=(False, True))
    wanted = -np.linalg.solve(Quadratic.H[12:, 12:] + np.eye(4), Quadratic.g[12:])
    np.testing.assert_allclose(drawn.g[17:19], -wanted[2:])
    assert not drawn.g[12:14].any()
    np.testing.assert_array_equal(drawn.H, factor.H)


def test_chain_step_selects_the_variables_of_an_epoch():
    z = np.arange(19.0)
    np.testing.assert_array_equal(chain_step(z), np.r_[0:12, 12:14, 17:19])
    bias_only = np.r_[np.zeros(9), 9.0, 10.0, 11.0, np.zeros(4)]
    np.testing.assert_array_equal(chain_step(z, calibrates=False), bias_only)


def test_gap_links_only_the_bias():
    node = Node.at(np.zeros(3), np.array([0.0, 0.6, 0.8]))
    other = Node.at(np.array([1e-3, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    gap = gap_factor(0, np.zeros(9), node, other, 4.0)
    (H,), (g,) = Stack([gap], np.zeros(9), {0: node, 1: other}).quadratics()
    expected = np.zeros((SIZE, SIZE))
    for k in range(3):
        expected[np.ix_([9 + k, 14 + k], [9 + k, 14 + k])] = [[4.0, -4.0], [-4.0, 4.0]]
    np.testing.assert_allclose(H, expected)
    np.testing.assert_allclose(g[[9, 14]], [-4e-3, 4e-3])


def test_held_directions_stay_at_the_prior_and_do_not_change_others():
    """Directions that the data do not determine go to the mean of the prior; the others are as
    without holding.
    """
    graph = random_graph(
        nodes=2, rank=10
    )  # 10 rows for c (9) and two nodes: half of c is undetermined
    free_dc, _ = graph.step()
    covariance = graph.covariance()[:9, :9]
    graph.hold_undetermined(0.5, covariance)
    dc, _ = graph.step()
    whitened = covariance / np.outer(SIGMA, SIGMA)
    values, vectors = np.linalg.eigh(whitened)
    blind = values > 0.25
    assert 0 < blind.sum() < 9
    moved = vectors.T @ (dc / SIGMA)
    np.testing.assert_allclose(moved[blind], 0.0, atol=3e-4)
    np.testing.assert_allclose(moved[~blind], (vectors.T @ (free_dc / SIGMA))[~blind], rtol=1e-6)


def test_tempering_scales_only_the_prior():
    graph = random_graph()
    graph.temper = 50.0
    H, g = dense(graph)
    np.testing.assert_allclose(graph.step()[0], -np.linalg.solve(H, g)[:9], rtol=1e-7)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_values_never_reach_gtsam(bad):
    graph = random_graph()
    graph.factors[1].H[3, 3] = bad
    for call in (graph.step, graph.covariance):
        with pytest.raises(SingularError, match="not finite"), np.errstate(invalid="ignore"):
            call()
    graph = random_graph()
    graph.c = np.full(9, bad)
    with pytest.raises(SingularError, match="not finite"), np.errstate(invalid="ignore"):
        graph.step()


def test_undetermined_direction_raises_a_typed_error():
    """The border direction has no prior: without field and gyro it is free."""
    graph = random_graph(nodes=3)
    graph.factors[1].H[:] = 0.0
    with pytest.raises(SingularError, match="determin"):
        graph.step()


@pytest.mark.parametrize("strong", [1e4, 1e8, 1e11])
def test_weakly_determined_directions_are_not_singular(strong):
    """GTSAM calls pivots with a ratio of 2^12 rank deficient. Here they are those of an ordinary
    planar turn.
    """
    graph = random_graph(nodes=3, rank=30)
    for factor in graph.factors:
        factor.H[:9, :] = factor.H[:, :9] = 0.0
        factor.H[7, 7], factor.H[3, 3] = strong, 1e-3
    sigma = np.sqrt(np.diag(graph.covariance())[:9]) / SIGMA
    np.testing.assert_allclose(sigma[[0, 3]], 1.0, rtol=1e-3)
    assert sigma[7] == pytest.approx(1 / np.sqrt(1 + 0.5 * strong), rel=1e-3)
    graph.step()


def test_node_moves_on_the_sphere():
    node = Node.at(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    moved = node.moved_by(np.r_[1.0, 2.0, 3.0, 0.75, 0.0])
    assert np.linalg.norm(moved.direction) == pytest.approx(1.0)
    np.testing.assert_allclose(moved.bias, [1.0, 2.0, 3.0])
    assert node.direction @ moved.direction == pytest.approx(0.8)
    np.testing.assert_allclose(moved.tangent, so3.tangent_basis(moved.direction[None])[0])


def test_distance_from_prior_counts_only_weakly_determined_directions():
    """In standard deviations of the prior, over the directions on which the data have nearly no
    information.
    """
    graph = random_graph(nodes=2, rank=10)
    variances, directions = np.full(9, 1e-3), np.linalg.qr(np.arange(81).reshape(9, 9) ** 0.5)[0]
    variances[:2] = 0.5
    covariance = np.outer(SIGMA, SIGMA) * ((directions * variances) @ directions.T)
    graph.c = graph.anchor[0] + SIGMA * (directions @ np.r_[3.0, -4.0, np.full(7, 20.0)])
    assert graph.distance_from_prior(covariance) == pytest.approx(12.5)
    assert graph.distance_from_prior(1e-2 * covariance) == 0.0


M = np.array([[0.55, 0.03, -0.02], [0.03, 0.45, 0.01], [-0.02, 0.01, 0.5]])
B = np.array([0.1, -0.2, 0.05])
C9 = np.r_[chain.upper_triangle(M), B]


def planar(height, count=40):
    """Directions on the circle of the sphere at this height, and their moments under (M, B)."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    level = np.sqrt(1 - height**2)
    u = np.column_stack([level * np.cos(angle), level * np.sin(angle), np.full(count, height)])
    moments = Moments()
    moments.add(u @ M + B)
    return u, moments


def test_small_steps_are_additive():
    _, moments = planar(0.6)
    dc = np.random.default_rng(0).normal(size=9)
    for h in (1e-4, 1e-5):
        error = retract(C9, h * dc, moments) - (C9 + h * dc)
        assert np.linalg.norm(error) < 60 * h**2


@pytest.mark.parametrize("shift", [-0.3, 0.2, 0.9])
def test_valley_of_a_planar_turn_is_followed_to_any_distance(shift):
    """The tangent of the valley is u -> u + shift z, without its radial part. Everywhere on this
    path the field is explained: the corrected field stays on the unit sphere, at another
    height.
    """
    u, moments = planar(0.3)
    field = u @ M + B
    dc = np.r_[chain.upper_triangle(0.3 * shift * M), -shift * M[:, 2]]
    new = retract(C9, dc, moments)
    found = np.linalg.solve(chain.symmetric(new[:6]), (field - new[6:]).T).T
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    tangential = shift * (1 - 0.3**2)
    height = (0.3 + tangential) / np.sqrt(1 + tangential**2 + shift**2 * 0.3**2 * (1 - 0.3**2))
    np.testing.assert_allclose(found[:, 2], height, atol=1e-12)
    straight = np.linalg.solve(chain.symmetric((C9 + dc)[:6]), (field - (C9 + dc)[6:]).T)
    assert abs(np.linalg.norm(straight, axis=0).mean() - 1) > 0.1 * shift**2


def test_valley_step_is_plain_when_the_matrix_would_not_stay_positive():
    _, moments = planar(0.6)
    dc = np.r_[chain.upper_triangle(1.5 * M), np.zeros(3)]
    np.testing.assert_array_equal(retract(C9, dc, moments), C9 + dc)


def test_scale_is_unchanged_without_data():
    dc = np.r_[np.zeros(6), 0.01, 0.0, 0.0]
    np.testing.assert_allclose(retract(C9, dc, Moments()), C9 + dc, atol=1e-12)


def test_curvature_equals_the_error_of_the_linear_covariance():
    """Along the valley of a planar turn, compared with moves of standard normal size."""
    _, moments = planar(0.3)
    step = 0.05 * np.r_[chain.upper_triangle(0.3 * M), -M[:, 2]]
    t = np.random.default_rng(0).normal(size=4000)
    beside = np.array([retract(C9, k * step, moments) - C9 - k * step for k in t])
    expected = beside.T @ beside / len(t)
    added = curvature_covariance(C9, np.outer(step, step) + 1e-16 * np.eye(9), moments)
    assert np.trace(expected) > 0
    np.testing.assert_allclose(added, expected, atol=0.12 * np.abs(expected).max())


@pytest.mark.parametrize("height", [0.0, 0.3, 0.8])
def test_valley_step_is_inverted_by_its_path(height):
    _, moments = planar(height)
    rng = np.random.default_rng(4)
    for size in (1e-3, 0.05, 0.15):
        dc = size * rng.normal(size=9)
        there = retract(C9, dc, moments)
        assert np.allclose(valley_step(C9, there, moments), dc, atol=1e-10)


def test_calibrations_along_the_valley_are_near_in_the_metric_of_the_data():
    """Two calibrations that explain a planar turn equally well: their plain difference is far
    across the valley.
    """
    u, moments = planar(0.3)
    dc = np.r_[chain.upper_triangle(0.3 * 0.9 * M), -0.9 * M[:, 2]]
    there = retract(C9, dc, moments)
    columns = np.concatenate([chain.symmetric_columns(u), np.tile(np.eye(3), (len(u), 1, 1))], 2)
    along = np.linalg.norm(columns @ valley_step(C9, there, moments) - columns @ dc)
    straight = np.linalg.norm(columns @ (there - C9) - columns @ dc)
    assert along < 1e-9
    assert straight > 0.1


def test_no_path_leads_to_the_other_side():
    _, moments = planar(0.3)
    beyond = np.r_[-C9[:6], C9[6:]]
    np.testing.assert_array_equal(valley_step(C9, beyond, moments), beyond - C9)
