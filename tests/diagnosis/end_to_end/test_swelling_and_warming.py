"""Sources that rise and fall, step, or warm up without a logged cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


def with_field(course) -> Track:
    """A field of 1 mG, fixed to the vehicle, with an unlogged time course (N,)."""
    track = made(Trial(4)).track
    field = 1e-3 * np.outer(course(track.time_s), [0.48, -0.6, 0.64])
    return replace(track, mag_b_gauss=track.mag_b_gauss + field)


def swelling(time_s):
    """A source that rises and falls as a speed does: three times, always differently."""
    swells = ((70.0, 14.0, 1.0), (170.0, 25.0, 0.7), (300.0, 9.0, 0.5))
    return sum(size * np.exp(-0.5 * ((time_s - at) / width) ** 2) for at, width, size in swells)


def stepping(time_s):
    return (time_s > 150.0).astype(float)


def warming(time_s):
    """A slow approach to a final value, as of a temperature."""
    return 1.0 - np.exp(-time_s / 250.0)


LIBRARY = {
    name: EFFECTS[name]
    for name in ("hard_iron_step", "soft_iron_step", "field_anomaly", "field_step")
}


@pytest.mark.slow  # a short one that is unknown on the sensor: test_bursts_located
def test_source_that_rises_and_falls_is_unknown() -> None:
    swelled = diagnose(with_field(swelling), library=LIBRARY)
    assert [one.effect for one in swelled.findings] == []
    assert swelled.unexplained.detected and swelled.unexplained.where.frame == "sensor"


@pytest.mark.slow
def test_step_is_found_as_a_hard_iron_step() -> None:
    stepped = diagnose(with_field(stepping), library=LIBRARY)
    assert [one.effect for one in stepped.findings] == ["hard_iron_step"]
    assert not stepped.unexplained.detected


FADING = {
    name: EFFECTS[name] for name in ("viscous_magnetisation", "hard_iron_step", "hard_iron_drift")
}


@pytest.mark.slow
def test_warming_sensor_is_a_settling_hard_iron_drift() -> None:
    """The unsettled part of viscous magnetisation decays alike; a drift is more probable."""
    (warm,) = diagnose(with_field(warming), library=FADING).findings
    assert (warm.effect, warm.setting["shape"]) == ("hard_iron_drift", "settling")
    assert warm.setting["time_constant_s"] == pytest.approx(250.0, rel=0.2)


@pytest.mark.slow
def test_viscous_magnetisation_is_not_a_drift() -> None:
    iron = diagnose(made(Trial(4, (("viscous_magnetisation", 1.0),))).track, library=FADING)
    assert [one.effect for one in iron.findings] == ["viscous_magnetisation"]
    assert not iron.unexplained.detected


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="in a library without a nearer effect it is taken for that")
def test_warming_sensor_is_not_viscous_magnetisation() -> None:
    """It has 328 nats as that effect; a smooth free process has hardly less, and no temperature
    is logged.
    """
    library = {name: EFFECTS[name] for name in ("viscous_magnetisation", "hard_iron_step")}
    warm = diagnose(with_field(warming), library=library)
    assert [one.effect for one in warm.findings] == []
    assert warm.unexplained.detected and warm.unexplained.where.frame == "sensor"
