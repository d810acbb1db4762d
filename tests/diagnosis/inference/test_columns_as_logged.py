"""Columns that a logger held or added noise to are reconstructed before the search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.ndimage import gaussian_filter1d
from tracks import experiment, track_of

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.effects.sensor_sources import MotorCurrentField
from ahrsd.diagnosis.inference.diagnose import build_and_fit_null
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.track import Spec

RATE_HZ = 25.0


def held(values, rows):
    return values[(np.arange(len(values)) // rows) * rows]


def notes_at_the_richest_model(track):
    """Notes about the columns before anything is searched."""
    problem, fit = build_and_fit_null(track, Spec())
    return richest_model.fit_richest_model(
        problem, fit.filtered, EFFECTS
    ).base.made.point.problem.notes


@pytest.fixture(scope="module")
def driven():
    """160 s next to a motor, with its current in every row."""
    return made(
        Trial(seed=11, effects=(("motor_current_field", 1.0),), samples=4_000, rate_hz=RATE_HZ)
    )


@pytest.mark.slow
def test_held_current_is_interpolated_if_the_field_follows_it():
    track = track_of(experiment("wam", motion="rov", seed=4, samples=3000, rate_hz=RATE_HZ))
    course = gaussian_filter1d(np.random.default_rng(5).normal(size=3000), 8.0)
    current = 6.0 + 2.0 * course / course.std()
    mag = track.mag_b_gauss + current[:, None] * np.array([3e-3, -2e-3, 2e-3])
    track = replace(track, mag_b_gauss=mag).with_columns({"motor_current_a": held(current, 5)})
    said = "column motor_current_a has a new value every 0.2 s: interpolated linearly"
    assert said in notes_at_the_richest_model(track)


@pytest.mark.slow
def test_current_logged_in_every_row_is_unchanged(driven):
    current = driven.track.covariates["motor_current_a"]
    track = driven.track.with_columns({"motor_current_a": current})
    assert not any("motor_current_a" in said for said in notes_at_the_richest_model(track))


@pytest.mark.slow
def test_held_column_is_unchanged_if_the_field_does_not_follow_it(driven):
    """The speed of another trip."""
    speed = 1.2 + 0.25 * gaussian_filter1d(np.random.default_rng(3).normal(size=4_000), 40.0)
    track = driven.track.with_columns({"speed_m_s": held(speed, 5)})
    assert not any("speed_m_s" in said for said in notes_at_the_richest_model(track))


class CountedMotorCurrentField(MotorCurrentField):
    """Counts how often its settings are looked up: once per fit of a model, at least."""

    looked_up = 0

    def settings(self, context):
        self.looked_up += 1
        return super().settings(context)


def lookups_with_columns(count):
    track = track_of(experiment("wam", motion="rov", seed=4, samples=300, rate_hz=RATE_HZ))
    rng = np.random.default_rng(5)
    columns = {f"motor_{k:02d}_current_a": held(rng.normal(size=300), 5) for k in range(count)}
    problem, fit = build_and_fit_null(track.with_columns(columns), Spec())
    effect = CountedMotorCurrentField()
    richest_model.fit_richest_model(problem, fit.filtered, {effect.identifier: effect})
    return effect.looked_up


def test_number_of_fits_does_not_grow_with_the_number_of_held_columns():
    assert lookups_with_columns(6) == lookups_with_columns(2)
