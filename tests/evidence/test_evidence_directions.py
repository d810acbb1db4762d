"""Cells of the sphere of directions: of nearly equal area, and each vector in its cell."""

import numpy as np
import pytest

from ahrsd.evidence.coverage import CELLS, cell_centres, cells_of, visited_cells


def test_centre_of_each_cell_is_in_it():
    assert cells_of(cell_centres()).tolist() == list(range(CELLS))
    assert np.linalg.norm(cell_centres(), axis=1) == pytest.approx(np.ones(CELLS))


def test_cells_have_nearly_equal_area():
    points = np.random.default_rng(1).normal(size=(400_000, 3))
    counts = np.bincount(cells_of(points), minlength=CELLS)
    assert counts.min() > 0.75 * 400_000 / CELLS
    assert counts.max() < 1.15 * 400_000 / CELLS


def test_cell_does_not_depend_on_length_and_zero_has_none():
    assert cells_of(np.array([[0.0, 0.0, 0.2], [0.0, 0.0, -9.0], [0.0, 0.0, 0.0]])).tolist() == [
        0,
        CELLS - 3,
    ]
    assert np.flatnonzero(
        visited_cells(np.array([[1e-3, 1e-3, 1.0], [0.0, 0.0, -1.0]]))
    ).tolist() == [
        0,
        CELLS - 3,
    ]
    assert not visited_cells(np.zeros((2, 3))).any()


def test_level_circles_cover_one_ring_at_the_dip(world) -> None:
    """A dip of 60 degrees: all cells lie at about 30 degrees from down, all around."""
    motion = world.evidence(world.Scene(roll_deg=0.0, pitch_deg=0.0)).motion
    middle = cell_centres()[motion.directions]
    from_down_deg = np.degrees(np.arccos(middle[:, 2]))
    assert (np.abs(from_down_deg - 30.0) <= 5.5).all()
    assert 15 <= len(middle) <= 36
    assert np.abs(middle[:, :2].mean(axis=0)).max() < 0.05
    assert motion.down_b == pytest.approx([0.0, 0.0, 1.0], abs=0.01)
    tumbled = world.evidence(world.Scene()).motion
    assert np.count_nonzero(tumbled.directions) > 2 * len(middle)


def test_directions_are_recorded_without_gravity(world) -> None:
    motion = world.evidence(world.Scene(accel=False)).motion
    assert np.count_nonzero(motion.directions) > 30
    assert np.isnan(motion.down_b).all()
