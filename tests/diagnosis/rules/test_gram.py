"""Gram algebra is regression: projection, blocks, merging, what is not observable."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.rules.gram import block_edges, gram


def made(seed: int = 0, count: int = 400):
    rng = np.random.default_rng(seed)
    Z, X = rng.standard_normal((count, 3, 4)), rng.standard_normal((count, 3, 2))
    X = X + Z[:, :, :2]  # what is projected out is shared
    e = rng.standard_normal((count, 3)) + X @ [0.3, -0.2]
    time_s = np.arange(count) * 0.1
    return Z, X, e, time_s


def test_projection_is_the_regression_on_the_others():
    Z, X, e, time_s = made()
    whole = gram({"z": Z, "x": X}, e, time_s, block_edges(time_s, 5.0))
    left = whole.project(["z"])
    total = left.total
    theta = np.linalg.solve(total[:-1, :-1], total[:-1, -1])
    both = np.concatenate([Z, X], axis=2).reshape(-1, 6)
    expected = np.linalg.lstsq(both, e.ravel(), rcond=None)[0]
    np.testing.assert_allclose(theta, expected[4:], atol=1e-12)
    rss = total[-1, -1] - theta @ total[:-1, -1]
    np.testing.assert_allclose(rss, np.sum((e.ravel() - both @ expected) ** 2), rtol=1e-12)


def test_blocks_of_the_projection_sum_to_the_schur_complement_and_are_the_blocks_residuals():
    Z, X, e, time_s = made(1)
    whole = gram({"z": Z, "x": X}, e, time_s, block_edges(time_s, 5.0))
    left = whole.project(["z"])
    flat = Z.reshape(-1, 4)
    both = np.concatenate([X, e[:, :, None]], axis=2).reshape(len(flat), 3)
    rest = (both - flat @ np.linalg.lstsq(flat, both, rcond=None)[0]).reshape(len(e), 3, 3)
    edges = block_edges(time_s, 5.0)
    assert len(left) == len(edges) - 1 == 8
    for k in range(8):
        part = rest[edges[k] : edges[k + 1]].reshape(-1, 3)
        np.testing.assert_allclose(left.blocks[k], part.T @ part, atol=1e-9)


def test_the_order_of_the_groups_does_not_matter():
    Z, X, e, time_s = made(3)
    edges = block_edges(time_s, 5.0)
    one = gram({"z": Z, "x": X}, e, time_s, edges).project(["z"])
    two = gram({"x": X, "z": Z}, e, time_s, edges).project(["z"])
    np.testing.assert_allclose(one.total, two.total, rtol=1e-9)
