"""The Gram of a course without its columns is that of the columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.innovation_filter.context import Given, build_context
from ahrsd.diagnosis.innovation_filter.gram import Gram
from ahrsd.diagnosis.innovation_filter.innovation import bearings, run_filter
from ahrsd.diagnosis.rules.coloured import coloured
from ahrsd.diagnosis.rules.course_gram import course_gram
from ahrsd.diagnosis.rules.directions import weighed
from ahrsd.diagnosis.rules.locate import group_name
from ahrsd.diagnosis.rules.regression import Base, base, based, group_gram
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import Columns
from ahrsd.diagnosis.where_and_when.locate import FRAMES, Frame, frame_columns, segments_between


def basis_with_a_gap() -> Base:
    """Two runs, the gyro's bias free to walk, a named term, readings missing."""
    made = experiment(samples=1500)
    track = track_of(made)
    keep = np.r_[0:500, 600:1500]
    mag, dt_s = track.mag_b_gauss[keep].copy(), track.dt_s[keep].copy()
    mag[700:720], dt_s[500] = np.nan, np.nan
    runs = (slice(0, 500), slice(500, 1400))
    track = Track(track.time_s[keep], dt_s, mag, track.gyro_b_rad_s[keep], None, {}, runs)
    model = replace(true_model(made), gyro_walk_rad_s_sqrt_s=1e-5)
    context = build_context(track, Given(bearings(track, model)))
    step = Columns(mag=np.where(np.arange(1400) > 900, 1.0, 0.0)[:, None, None] * np.eye(3))
    return base(context, run_filter(track, model), [("hard_iron_step", step)], 25.0)


def both(basis: Base, frame: Frame) -> tuple[Gram, Gram]:
    """By the columns and without them; rows before and behind in no stretch, one without rows."""
    cut = segments_between(basis.context.track.time_s, np.array([1.0, 4.0, 22.5, 23.0, 41.0, 58.0]))
    columns = {group_name(frame): frame_columns(basis.context, frame, cut)}
    return group_gram(basis, columns), course_gram(basis, frame, cut)


def assert_same(wanted: Gram, found: Gram) -> None:
    assert found.groups == wanted.groups
    size = np.sqrt(wanted.information)
    scale = np.append(np.where(size > 0, size, 1.0), np.sqrt(wanted.total[-1, -1]))
    assert np.abs(found.total - wanted.total).max(initial=0.0) > 0.0  # another way to the numbers
    np.testing.assert_allclose(
        found.total / np.outer(scale, scale), wanted.total / np.outer(scale, scale), atol=1e-9
    )
    np.testing.assert_allclose(found.information, wanted.information, rtol=1e-10)
    np.testing.assert_allclose(found.counts, wanted.counts)
    np.testing.assert_allclose(found.spans_s, wanted.spans_s)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_course_has_the_gram_of_its_columns(frame: Frame) -> None:
    assert_same(*both(basis_with_a_gap(), frame))


@pytest.mark.parametrize("frame", FRAMES)
def test_so_it_has_where_rows_are_weighed_by_direction(frame: Frame) -> None:
    basis = basis_with_a_gap()
    rng = np.random.default_rng(2)
    weight = np.eye(3) + 0.3 * rng.normal(size=(len(basis.innovation), 3, 3))
    assert_same(*both(weighed(basis, weight), frame))


def test_noise_of_its_own_law_is_whitened_by_the_columns() -> None:
    basis = basis_with_a_gap()
    unit = basis.context.field_b / np.linalg.norm(basis.context.field_b, axis=1, keepdims=True)
    noise = coloured(basis.innovation, unit, 25.0, 0.05)
    known, innovation = noise.whitened(basis.known), noise.whitened(basis.innovation)
    red = replace(based(basis, basis.groups, known, innovation), rest=noise, colour=1.0)
    wanted, found = both(red, "sensor")
    assert np.array_equal(found.total, wanted.total)
