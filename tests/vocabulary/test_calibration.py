"""Affine: undo, compose, and the register's order of numbers."""

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.samples import Array


def affine(rng: np.random.Generator) -> Affine:
    return Affine(np.eye(3) + 0.2 * rng.normal(size=(3, 3)), 0.3 * rng.normal(size=3))


@pytest.fixture
def vectors() -> Array:
    return np.random.default_rng(0).normal(size=(50, 3))


def test_apply_is_subtract_then_multiply() -> None:
    """vn100-protocol.md 5.2, worked example."""
    register = (1.02, 0.01, 0.0, 0.01, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 0.10)
    out = Affine.from_register(register).apply(np.array([0.25, 0.10, 0.50]))
    assert out == pytest.approx([0.2053, 0.1294, 0.4040])
    assert Affine.from_register(register).to_register() == register


def test_undo_is_the_inverse_of_apply(vectors: Array) -> None:
    one = affine(np.random.default_rng(1))
    assert one.undo(one.apply(vectors)) == pytest.approx(vectors)
    assert one.apply(one.undo(vectors)) == pytest.approx(vectors)


@pytest.mark.parametrize("seed", range(10))
def test_composition_equals_one_after_the_other(seed: int, vectors: Array) -> None:
    rng = np.random.default_rng(seed)
    first, second = affine(rng), affine(rng)
    both = second.after(first)
    assert both.apply(vectors) == pytest.approx(second.apply(first.apply(vectors)))
    assert both.matrix == pytest.approx(second.matrix @ first.matrix)


def test_identity_is_neutral(vectors: Array) -> None:
    one = affine(np.random.default_rng(2))
    for same in (one.after(Affine.identity()), Affine.identity().after(one)):
        assert same.to_register() == pytest.approx(one.to_register())


def test_arrays_are_frozen_and_shapes_checked() -> None:
    one = Affine.identity()
    with pytest.raises(ValueError, match="read-only"):
        one.matrix[0, 0] = 2.0
    with pytest.raises(ValueError, match="expected shape"):
        Affine(np.eye(2), np.zeros(3))
