"""A gyro that is louder for a while, and what is no such noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.answer.diagnosis import Unexplained, Where
from ahrsd.diagnosis.rules.gyro_noise import loud_gyro
from ahrsd.diagnosis.track import Track

BURST_S = (100.0, 118.0)


@pytest.fixture(scope="module")
def loud() -> Track:
    track = made(Trial(seed=8, samples=6000)).track
    inside = (track.time_s > BURST_S[0]) & (track.time_s < BURST_S[1])
    noise = 3e-3 * np.random.default_rng(1).standard_normal((len(track), 3))
    return replace(track, gyro_b_rad_s=track.gyro_b_rad_s + inside[:, None] * noise)


def unknown(*spans_s: tuple[float, float]) -> Unexplained:
    return Unexplained(True, Where(spans_s, ("x",), "world"))


def test_an_unknown_while_the_gyro_is_loud_is_its_noise(loud: Track) -> None:
    fact = loud_gyro(unknown((103.0, 114.0)), loud)
    assert fact is not None
    assert fact.effect == "noise_burst"
    assert fact.parameters[0].value == pytest.approx(3e-3, rel=0.1)
    ends = np.array(fact.where.intervals_s)
    assert np.abs(ends - BURST_S).max() < 1.5


def test_an_unknown_at_another_time_or_a_gyro_that_is_shaken_is_not(loud: Track) -> None:
    assert loud_gyro(unknown((10.0, 40.0), (103.0, 114.0)), loud) is None
    assert loud_gyro(Unexplained(False), loud) is None
    quiet = made(Trial(seed=8, samples=6000)).track
    assert loud_gyro(unknown((103.0, 114.0)), quiet) is None
    inside = (quiet.time_s > BURST_S[0]) & (quiet.time_s < BURST_S[1])
    shaken = np.outer(inside * np.sin(2 * np.pi * 4.0 * quiet.time_s), [0.02, 0.03, -0.02])
    moved = replace(quiet, gyro_b_rad_s=quiet.gyro_b_rad_s + shaken)
    assert loud_gyro(unknown((103.0, 114.0)), moved) is None
