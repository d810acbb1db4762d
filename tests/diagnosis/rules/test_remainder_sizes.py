"""How large what is left is: against fields that were added with a known size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.answer.added_field import (
    calibration_of,
    deviation,
    heading_off_deg,
    less_calibration,
)
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.ordinary import beyond_ordinary, held_against
from ahrsd.diagnosis.rules.remainder_sizes import Left, Size, sizes_left
from ahrsd.diagnosis.rules.search import State
from ahrsd.diagnosis.track import Spec, Track

SAMPLES = 3000  # two minutes


@pytest.fixture(scope="module")
def made():
    return experiment("wam", seed=8, samples=SAMPLES)


def fitted(track: Track) -> State:
    """The calibration that fits best, no effect named."""
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return State(problem, fit_null(problem.track, problem.spec, cold))


def world_course(made, size_gauss: float) -> np.ndarray:
    """(N, 3) in sensor axes: a field that differs from place to place, passed in a minute or so."""
    t = made.samples.time_s[:, None] / np.array([41.0, 53.0, 67.0]) + np.array([0.0, 0.3, 0.7])
    outside = size_gauss * np.sqrt(2.0 / 3.0) * np.sin(2 * np.pi * t)
    return np.einsum("nji,nj->ni", made.R_nb, outside)


def by_direction(made, size_gauss: float) -> np.ndarray:
    """(N, 3): what a sensor reads too much where its axes share the field."""
    x, y, z = (made.field_b / np.linalg.norm(made.field_b, axis=1, keepdims=True)).T
    shape = np.column_stack([y * z, x * z, x * y])
    return size_gauss * shape / deviation(shape)


def with_field(track: Track, added: np.ndarray) -> Track:
    return replace(track, mag_b_gauss=track.mag_b_gauss + added)


def size_of(left: Left, component: str) -> Size:
    return next(one for one in left.sizes if one.component == component)


def test_nothing_is_left_of_a_clean_world(made):
    left = sizes_left(fitted(track_of(made)))
    assert left.field_gauss < 0.3e-3
    assert left.heading_deg < 0.1
    assert all(one.evidence_nats < LIMITS.unknown_nats for one in left.sizes)


def test_a_field_of_places_is_as_large_as_it_is(made):
    added = world_course(made, 10e-3)
    left = sizes_left(fitted(with_field(track_of(made), added)))
    one = size_of(left, "world")
    # calibration and the other components can take some of it
    assert 0.4 * deviation(added) < one.size < 1.1 * deviation(added)
    assert one.evidence_nats > LIMITS.unknown_nats
    assert one.size == max(part.size for part in left.sizes if part.heading_deg is not None)


def test_a_field_by_direction_is_as_large_as_it_is(made):
    left = sizes_left(fitted(with_field(track_of(made), by_direction(made, 8e-3))))
    one = size_of(left, "by_attitude")
    assert 0.4 * 8e-3 < one.size < 1.1 * 8e-3
    assert one.evidence_nats > LIMITS.unknown_nats
    assert one.size == max(part.size for part in left.sizes if part.heading_deg is not None)


def test_iron_is_calibration_and_no_remainder(made):
    context = fitted(track_of(made)).fit.context()
    take = calibration_of(context)
    iron = context.field_b @ np.array([[0.1, 0.02, 0], [0.02, -0.1, 0.03], [0, 0.03, 0]]) + 0.05
    assert deviation(iron) > 0.01
    assert deviation(less_calibration(iron, take)) < 1e-12


def test_a_heading_is_off_by_the_field_across(made):
    context = fitted(track_of(made)).fit.context()
    field = context.field_b @ context.model.soft_iron.T
    read = np.einsum("nij,nj->ni", context.R_nb, field).mean(axis=0)
    level = float(np.hypot(*read[:2]))
    across = np.array([-read[1], read[0], 0.0]) / level
    sign = np.where(np.arange(len(context.track)) % 2, 1.0, -1.0)[:, None]
    added = np.einsum("nji,j->ni", context.R_nb, 5e-3 * across) * sign
    assert heading_off_deg(added, context) == pytest.approx(np.degrees(5e-3 / level), rel=0.02)
    along = np.einsum("nji,j->ni", context.R_nb, 5e-3 * read / np.linalg.norm(read)) * sign
    assert heading_off_deg(along, context) < 0.05 * heading_off_deg(added, context)


def test_a_crooked_sensor_is_ordinary_and_one_four_times_as_crooked_is_not(made):
    """As of a recording that leaves what real ones do beside its largest part."""

    def told(strength: float):
        left = sizes_left(fitted(with_field(track_of(made), by_direction(made, strength))))
        return held_against(replace(left, beside_gauss=5e-3))

    assert told(24e-3).within
    four = told(96e-3)
    assert not four.within
    assert four.why.startswith("beyond the ordinary: a field by attitude, ")


@pytest.mark.slow
def test_a_current_that_nobody_logged_is_unknown_in_a_simulation(made):
    track = track_of(made)
    current = np.repeat(np.random.default_rng(3).uniform(0.0, 1.0, 30), SAMPLES // 30)
    added = current[:, None] * np.array([4e-3, -8e-3, 5e-3])
    found = beyond_ordinary(diagnose(with_field(track, added)))
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "sensor"
    assert not found.unexplained.ordinary.within


@pytest.mark.slow
@pytest.mark.recordings
def test_a_rotated_board_is_ordinary_and_a_watch_beside_a_sensor_is_not():
    board = beyond_ordinary(diagnose(recorded("broad/02_undisturbed_slow_rotation_B")))
    assert not board.unexplained.detected
    assert board.unexplained.ordinary.field_gauss == pytest.approx(5.0e-3, rel=0.3)
    watch = beyond_ordinary(diagnose(recorded("vn100_distorters/vn7Hard")))
    assert watch.unexplained.detected
    assert "a course in time on the sensor" in watch.unexplained.ordinary.why
