"""Columns in parts."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.innovation_filter.side_by_side import joined
from ahrsd.diagnosis.rules.together import pieces
from ahrsd.diagnosis.values import Columns


def test_pieces_are_the_columns_in_order() -> None:
    rng = np.random.default_rng(2)
    whole = Columns(mag=rng.normal(size=(5, 3, 8)))
    parts = pieces(whole, 3)
    assert [part.width for part in parts] == [3, 3, 2]
    np.testing.assert_array_equal(joined(parts).mag, whole.mag)
    assert pieces(whole, 8) == [whole]
