"""The picture: position of a direction, and the kinds of its dots."""

import re

import numpy as np
import pytest
from shown_status import cell_of, cells, level_ring, motion

from ahrsd.evidence.coverage import CELLS, cell_centres
from ahrsd.page.view import MIDDLES, RADIUS, Fresh, dots, marker, project
from ahrsd.telemetry.driving import shown_of

UPRIGHT = np.eye(3)
BELOW, ABOVE = np.array(MIDDLES)
NOTHING = np.zeros(CELLS, dtype=bool)


def places(path):
    return [(float(x), float(y)) for x, y in re.findall(r"M(\S+) (\S+)h0", path)]


def test_projection_of_the_main_directions():
    drawn = project(np.array([[0, 0, 1], [0, 0, -1], [1, 0, 1], [0, 1, 1], [1, 0, -1]]), UPRIGHT)
    half = RADIUS * np.sqrt(1 - np.cos(np.pi / 4))
    assert drawn[0] == pytest.approx(BELOW)
    assert drawn[1] == pytest.approx(ABOVE)
    assert drawn[2] == pytest.approx(np.add(BELOW, [0, -half]))
    assert drawn[3] == pytest.approx(np.add(BELOW, [half, 0]))
    assert drawn[4] == pytest.approx(np.add(ABOVE, [0, -half]))


def test_projection_preserves_area():
    points = np.random.default_rng(3).normal(size=(100_000, 3))
    drawn = project(points, UPRIGHT)
    radius = np.hypot(*(drawn - np.where(drawn[:, :1] < 180, BELOW, ABOVE)).T)
    assert radius.max() <= RADIUS + 1e-9
    assert np.mean(radius < RADIUS / np.sqrt(2)) == pytest.approx(0.5, abs=0.01)


def test_inverted_sensor_is_drawn_in_the_vehicle_frame():
    hanging = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])  # ahead, right, down in its axes
    assert project(np.array([[0, 0, -1.0]]), hanging)[0] == pytest.approx(BELOW)
    assert project(np.array([[0, -1.0, -1.0]]), hanging)[0][0] > BELOW[0]


def test_every_cell_is_one_dot_of_one_kind():
    shown = shown_of({"motion": motion(cells(level_ring))})
    drawn = dots(shown, NOTHING, circle=True, tilts=True)
    assert len(places(drawn.shown)) == np.count_nonzero(shown.seen)
    assert len(places(drawn.wanted)) == np.count_nonzero(shown.tilted)
    assert places(drawn.fresh) == []
    kinds = (drawn.shown, drawn.fresh, drawn.wanted, drawn.other)
    assert sum(len(places(one)) for one in kinds) == CELLS
    calm = dots(shown, NOTHING, circle=True, tilts=False)
    assert places(calm.wanted) == []


def test_missing_part_of_the_circle_is_marked_while_required():
    half = shown_of({"motion": motion(cells(lambda f, a: level_ring(f, a) and a < 180))})
    wanted = places(dots(half, NOTHING, circle=True, tilts=False).wanted)
    assert len(wanted) == np.count_nonzero(half.level & ~half.seen) > 5
    assert all(x < BELOW[0] + 5 for x, _ in wanted)  # azimuth over 180 deg: to the left
    assert places(dots(half, NOTHING, circle=False, tilts=False).wanted) == []


def test_recent_directions_are_marked_until_counted():
    fresh = Fresh(keep_s=60.0)
    direction = cell_centres()[cell_of(120.0)].tolist()
    fresh.take(direction, 10.0)
    nothing = shown_of({"motion": motion("0" * CELLS)})
    assert len(places(dots(nothing, fresh.cells(30.0), circle=True, tilts=True).fresh)) == 1
    assert not fresh.cells(71.0).any()
    all_seen = shown_of({"motion": motion("1" * CELLS)})
    assert places(dots(all_seen, fresh.cells(30.0), circle=True, tilts=True).fresh) == []
    fresh.take(direction, 5.0)  # the device restarted
    assert np.flatnonzero(fresh.cells(5.0)).tolist() == [cell_of(120.0)]
    fresh.take([None, None, None], 6.0)
    assert np.count_nonzero(fresh.cells(6.0)) == 1


def test_marker_is_at_the_present_field_direction():
    assert marker([0.0, 0.0, 0.4], UPRIGHT) == tuple(BELOW)
    assert marker([None, None, None], UPRIGHT) is None
