"""Columns that pass the filter together, and the small inverse of its gains."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.innovation_filter.innovation import batches, joined
from ahrsd.diagnosis.innovation_filter.parallel_scan import inverse
from ahrsd.diagnosis.model import Columns


def of(mag: int = 0, gyro: int = 0) -> Columns:
    rng = np.random.default_rng(mag + 10 * gyro)
    sides = [rng.normal(size=(5, 3, width)) if width else None for width in (mag, gyro)]
    return Columns(*sides)


def test_batches_are_of_one_side_and_no_wider_than_wanted() -> None:
    columns = [
        of(mag=3),
        of(gyro=2),
        of(mag=4),
        of(mag=2, gyro=2),
        of(mag=9),
        of(gyro=5),
        of(mag=1),
    ]
    found = batches(columns, 7)
    assert found == [[0, 2], [4], [6], [1, 5], [3]]
    for batch in found:
        together = joined([columns[k] for k in batch])
        for part, k in ((together.mag, "mag"), (together.gyro, "gyro")):
            own = [getattr(columns[number], k) for number in batch]
            if part is None:
                assert own == [None] * len(batch)
            else:
                np.testing.assert_array_equal(part, np.concatenate(own, axis=2))


def test_the_inverse_is_one() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(200, 3, 3)) + 3.0 * np.eye(3)
    S = root @ np.swapaxes(root, 1, 2)
    found = np.moveaxis(inverse(np.moveaxis(S, 0, 2)), 2, 0)
    np.testing.assert_allclose(found, np.linalg.inv(S), rtol=1e-9, atol=1e-9)
