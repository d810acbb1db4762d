"""One epoch: derivatives compared with differences, elimination with dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.estimator import chain

NOISE = chain.Noise(2e-3, 5e-3)
DT = 0.04


def epoch(n=12, seed=0, *, measures_first=True):
    """Data, directions off the optimum, x and bias of a short epoch with a lot of rotation."""
    rng = np.random.default_rng(seed)
    u = np.empty((n, 3))
    u[0] = [0.36, -0.48, 0.8]
    angle = rng.normal(size=(n, 3)) * 0.1
    for k in range(1, n):
        u[k] = so3.exp(-angle[k]) @ u[k - 1]
    M = np.array([[0.55, 0.03, -0.02], [0.03, 0.45, 0.01], [-0.02, 0.01, 0.5]])
    b = np.array([0.1, -0.2, 0.05])
    field = u @ M + b + rng.normal(size=(n, 3)) * 2e-3
    bias = np.array([0.01, -0.02, 0.03])
    data = chain.EpochData(
        field,
        angle + bias * DT + rng.normal(size=(n, 3)) * 2e-4,
        np.full(n, DT),
        np.full((n, 3), np.nan),
        np.arange(n) * DT,
        measures_first,
    )
    off = u + rng.normal(size=(n, 3)) * 3e-3
    off /= np.linalg.norm(off, axis=1, keepdims=True)
    x = np.r_[chain.upper_triangle(M), b] + rng.normal(size=9) * 1e-3
    return data, off, x, bias + rng.normal(size=3) * 1e-3


def residuals(data, u, T, x, bias, d, z, weights=None):
    """All whitened residuals after moves d (n, 2) and z = [x (9), bias (3)], as in the docstring.

    The motion residual is taken in the tangent planes of the linearisation point, as Gauss-Newton
    on the sphere does: to first order the same.
    """
    moved = u + np.einsum("nij,nj->ni", T, d)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    x, bias = x + z[:9], bias + z[9:12]
    w = np.ones(len(u)) if weights is None else weights.copy()
    if not data.measures_first:
        w[0] = 0.0
    r = (data.field_b_gauss - moved @ chain.symmetric(x[:6]) - x[6:]) / NOISE.mag_gauss
    R = so3.exp(-(data.angle_b_rad[1:] - bias * DT))
    turned = np.einsum("nij,nj->ni", R, moved[:-1])
    linked = np.ones(len(u)) if data.linked is None else data.linked
    scale = linked[1:, None] / (NOISE.gyro_rad_s * DT)
    q = np.einsum("nij,ni->nj", T[1:], turned - moved[1:]) * scale
    return np.concatenate([(r * np.sqrt(w)[:, None]).ravel(), q.ravel()])


def dense(data, u, x, bias, weights=None):
    """Residuals and numeric Jacobian over [z (12), d (2 n)]."""
    n, T = len(u), so3.tangent_basis(u)

    def at(v):
        return residuals(data, u, T, x, bias, v[12:].reshape(n, 2), v[:12], weights)

    J = np.empty((len(at(np.zeros(12 + 2 * n))), 12 + 2 * n))
    for j in range(J.shape[1]):
        h = np.zeros(J.shape[1])
        h[j] = 1e-6
        J[:, j] = (at(h) - at(-h)) / 2e-6
    return at(np.zeros(J.shape[1])), J


def reduced(r, J, n):
    """Dense elimination of the interior: H, g of [z, d_0, d_last], and the response."""
    keep = np.r_[0:12, 12:14, 12 + 2 * n - 2 : 12 + 2 * n]
    inner = np.arange(14, 12 + 2 * n - 2)
    H, g = J.T @ J, J.T @ r
    solve = np.linalg.solve(H[np.ix_(inner, inner)], np.c_[H[np.ix_(inner, keep)], g[inner]])
    cross = H[np.ix_(keep, inner)]
    return (
        H[np.ix_(keep, keep)] - cross @ solve[:, :-1],
        g[keep] - cross @ solve[:, -1],
        -solve,
    )


CASES = {
    "fresh": {},
    "border": {"measures_first": False},
    "cut": {"linked": np.r_[0.0, np.ones(4), 0.0, np.ones(6)]},
}


@pytest.fixture(params=CASES)
def case(request):
    data, u, x, bias = epoch()
    return replace(data, **CASES[request.param]), u, x, bias


def test_derivatives_of_the_residuals_agree_with_differences(case):
    data, u, x, bias = case
    rows = chain.Rows.of([chain.Chain(data, u, bias, NOISE)])
    field, motion = chain.field_and_motion(rows, x)
    n = len(u)
    J = np.zeros((5 * n - 2, 12 + 2 * n))
    r = np.concatenate([field.r.T.ravel(), motion.q[:, 1:].T.ravel()])
    for k in range(n):
        own = slice(12 + 2 * k, 14 + 2 * k)
        at = slice(3 * k, 3 * k + 3)
        J[at, :9], J[at, own] = field.by_x[:, :, k], field.by_direction[:, :, k]
    for k in range(1, n):
        at = slice(3 * n + 2 * k - 2, 3 * n + 2 * k)
        J[at, 9:12] = motion.by_bias[:, :, k]
        J[at, 10 + 2 * k : 12 + 2 * k] = motion.by_previous[:, :, k]
        J[at, 12 + 2 * k : 14 + 2 * k] = -motion.scale[k] * np.eye(2)
    r_numeric, J_numeric = dense(data, u, x, bias)
    np.testing.assert_allclose(r, r_numeric, atol=1e-9)
    np.testing.assert_allclose(J, J_numeric, atol=1e-6 * np.abs(J_numeric).max())


def test_elimination_equals_dense_algebra(case):
    data, u, x, bias = case
    q = chain.linearise(data, u, x, bias, NOISE)
    H, g, _ = reduced(*dense(data, u, x, bias), len(u))
    np.testing.assert_allclose(q.H, H, atol=2e-7 * np.abs(H).max())
    np.testing.assert_allclose(q.g, g, atol=2e-7 * np.abs(g).max())


def test_move_equals_dense_back_substitution(case):
    data, u, x, bias = case
    q = chain.linearise(data, u, x, bias, NOISE)
    _, _, response = reduced(*dense(data, u, x, bias), len(u))
    z = np.random.default_rng(3).normal(size=16) * 1e-3
    inner = (response[:, :-1] @ z + response[:, -1]).reshape(-1, 2)
    step = np.vstack([z[12:14], inner, z[14:16]])
    expected = u + np.einsum("nij,nj->ni", so3.tangent_basis(u), step)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(chain.move_directions(u, q, z), expected, atol=1e-8)


def test_weights_scale_the_field_residuals():
    data, u, x, bias = epoch()
    weights = np.linspace(0.1, 1.0, len(u))
    q = chain.linearise(data, u, x, bias, NOISE, weights=weights)
    H, g, _ = reduced(*dense(data, u, x, bias, weights), len(u))
    np.testing.assert_allclose(q.H, H, atol=2e-7 * np.abs(H).max())
    np.testing.assert_allclose(q.g, g, atol=2e-7 * np.abs(g).max())


def test_cost_is_that_of_the_optimal_interior():
    """To first order, half the sum of squares after the interior's step with fixed borders."""
    data, u, x, bias = epoch()
    q = chain.linearise(data, u, x, bias, NOISE)
    r, J = dense(data, u, x, bias)
    inner = slice(14, 12 + 2 * len(u) - 2)
    best = r - J[:, inner] @ np.linalg.lstsq(J[:, inner], r, rcond=None)[0]
    assert q.cost == pytest.approx(0.5 * best @ best, rel=1e-6)
    assert q.cost == pytest.approx((q.sum_mag + q.sum_gyro) / 2)


def test_gauss_newton_finds_the_minimum():
    """Iterating over a whole epoch ends at zero gradient and recovers the truth."""
    data, u, x, bias = epoch(200, seed=4)
    for _ in range(8):
        q = chain.linearise(data, u, x, bias, NOISE)
        z = -np.linalg.solve(q.H, q.g)
        u, x, bias = chain.move_directions(u, q, z), x + z[:9], bias + z[9:12]
    q = chain.linearise(data, u, x, bias, NOISE)
    covariance = np.linalg.inv(q.H)
    error = np.r_[x[6:] - [0.1, -0.2, 0.05], bias - [0.01, -0.02, 0.03]]
    assert np.abs(np.linalg.solve(q.H, q.g)).max() < 1e-8
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diag(covariance)[6:12]))


def test_several_epochs_at_once_equal_each_by_itself():
    """Epochs of different length, bias, noise and weights, grouped and with a cut."""
    chains = []
    for seed, count in enumerate((12, 40, 7)):
        data, u, x, bias = epoch(count, seed, measures_first=seed != 1)
        weights = np.linspace(0.2, 1.0, count) if seed else None
        chains.append(chain.Chain(data, u, bias, chain.Noise(2e-3 + 1e-3 * seed, 5e-3), weights))
    P = np.tile(0.99 * np.eye(3), (40, 1, 1))
    own = chain.Averaging(np.full(40, 3.0), P, np.full(40, 0.1), np.zeros((40, 3)))
    chains[1] = replace(chains[1], data=replace(chains[1].data, averaging=own))
    linked = np.r_[0.0, 1.0, 1.0, 0.0, np.ones(3)]
    chains[2] = replace(chains[2], data=replace(chains[2].data, linked=linked))
    z = np.random.default_rng(3).normal(size=16) * 1e-3
    for at, q in zip(chains, chain.linearise_all(chains, x), strict=True):
        alone = chain.linearise(at.data, at.u, x, at.bias, at.noise, weights=at.weights)
        np.testing.assert_allclose(q.H, alone.H, rtol=1e-9, atol=1e-9 * np.abs(alone.H).max())
        np.testing.assert_allclose(q.g, alone.g, rtol=1e-9, atol=1e-9 * np.abs(alone.g).max())
        np.testing.assert_allclose(
            chain.move_directions(at.u, q, z), chain.move_directions(at.u, alone, z), atol=1e-12
        )
        for name in ("cost", "sum_mag", "sum_gyro", "count_mag", "count_gyro"):
            assert getattr(q, name) == pytest.approx(getattr(alone, name), rel=1e-9)


def test_outlier_weights_follow_from_their_residuals():
    data, u, x, bias = epoch()
    data.field_b_gauss[5] += 0.1
    q = chain.linearise_all([chain.Chain(data, u, bias, NOISE)], x, outlier_sigma=4.6)[0]
    expected = chain.robust_weights(data.field_error(u, x).T, 4.6 * NOISE.mag_gauss)
    np.testing.assert_allclose(q.weights, expected)
    assert expected[5] < 0.02
    given = chain.linearise(data, u, x, bias, NOISE, weights=expected)
    np.testing.assert_allclose(q.H, given.H, rtol=1e-12)


def test_symmetric_matrix_and_its_columns():
    m6 = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    M = chain.symmetric(m6)
    np.testing.assert_array_equal(M, [[1, 2, 3], [2, 4, 5], [3, 5, 6]])
    np.testing.assert_array_equal(chain.upper_triangle(M), m6)
    u = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(chain.symmetric_columns(u) @ m6, u @ M)


def test_robust_weights_have_their_closed_form():
    residual = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 20.0, 0.0]])
    np.testing.assert_allclose(chain.robust_weights(residual.T, 10.0), [1.0, 1.0, 0.25])


def test_undetermined_directions_raise_an_error():
    data, u, x, bias = epoch()
    data = replace(data, linked=np.zeros(len(u)))
    with pytest.raises(np.linalg.LinAlgError, match="not determined"):
        chain.linearise(data, u, x, bias, NOISE, weights=np.zeros(len(u)))
