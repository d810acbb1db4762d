"""Blocks of rows that advance together, and the 3x3 inverse of their gains."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.innovation_filter.parallel_scan import inverse_3x3, layout_of


def test_layout_covers_every_row_once() -> None:
    layout = layout_of((slice(0, 7), slice(7, 8), slice(8, 500)))
    rows = layout.rows[layout.rows < 500]
    assert np.array_equal(np.sort(rows), np.arange(500))
    assert layout.starts[layout.opens].tolist() == [0, 7, 8]


def test_inverse_3x3_equals_the_general_inverse() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(200, 3, 3)) + 3.0 * np.eye(3)
    S = root @ np.swapaxes(root, 1, 2)
    found = np.moveaxis(inverse_3x3(np.moveaxis(S, 0, 2)), 2, 0)
    np.testing.assert_allclose(found, np.linalg.inv(S), rtol=1e-9, atol=1e-9)
