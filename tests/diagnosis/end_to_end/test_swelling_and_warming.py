"""What swells, steps and warms without a logged cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


def with_field(course) -> Track:
    """A field of 1 mG, fixed to the vehicle, whose course (N,) nobody logged."""
    track = made(Trial(4)).track
    field = 1e-3 * np.outer(course(track.time_s), [0.48, -0.6, 0.64])
    return replace(track, mag_b_gauss=track.mag_b_gauss + field)


def swelling(time_s):
    """What swells and fades, as a speed does: three times, never alike."""
    swells = ((70.0, 14.0, 1.0), (170.0, 25.0, 0.7), (300.0, 9.0, 0.5))
    return sum(size * np.exp(-0.5 * ((time_s - at) / width) ** 2) for at, width, size in swells)


def stepping(time_s):
    return (time_s > 150.0).astype(float)


def warming(time_s):
    """A sensor that takes its time, as its temperature does."""
    return 1.0 - np.exp(-time_s / 250.0)


LIBRARY = {
    name: EFFECTS[name]
    for name in ("hard_iron_step", "soft_iron_step", "field_anomaly", "field_step")
}


@pytest.mark.slow  # a quick one that is unknown on the sensor: test_bursts_located
def test_a_source_that_swells_is_unknown() -> None:
    swelled = diagnose(with_field(swelling), library=LIBRARY)
    assert [one.effect for one in swelled.findings] == []
    assert swelled.unexplained.detected and swelled.unexplained.where.frame == "sensor"


@pytest.mark.slow
def test_a_step_is_a_step() -> None:
    stepped = diagnose(with_field(stepping), library=LIBRARY)
    assert [one.effect for one in stepped.findings] == ["hard_iron_step"]
    assert not stepped.unexplained.detected


FADING = {
    name: EFFECTS[name] for name in ("viscous_magnetisation", "hard_iron_step", "hard_iron_drift")
}


@pytest.mark.slow
def test_a_sensor_that_warms_drifts() -> None:
    """What iron had not settled of when the recording began fades alike; a drift is likelier."""
    (warm,) = diagnose(with_field(warming), library=FADING).findings
    assert (warm.effect, warm.setting["shape"]) == ("hard_iron_drift", "settling")
    assert warm.setting["time_constant_s"] == pytest.approx(250.0, rel=0.2)


@pytest.mark.slow
def test_iron_that_remembers_does_not() -> None:
    iron = diagnose(made(Trial(4, (("viscous_magnetisation", 1.0),))).track, library=FADING)
    assert [one.effect for one in iron.findings] == ["viscous_magnetisation"]
    assert not iron.unexplained.detected


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="of a library that has nothing nearer, it is taken for that")
def test_a_sensor_that_warms_is_no_iron_that_remembers() -> None:
    """328 nats as that; a smooth course has hardly less, and nobody logged a temperature."""
    library = {name: EFFECTS[name] for name in ("viscous_magnetisation", "hard_iron_step")}
    warm = diagnose(with_field(warming), library=library)
    assert [one.effect for one in warm.findings] == []
    assert warm.unexplained.detected and warm.unexplained.where.frame == "sensor"
