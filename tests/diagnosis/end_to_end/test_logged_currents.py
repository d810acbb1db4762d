"""Currents of many shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.one_model.diagnose import diagnose
from ahrsd.diagnosis.repaired_model.forward import simulated
from ahrsd.diagnosis.repaired_model.injection import readings_of
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import Noise, Term
from ahrsd.samples import Array

#: gauss per ampere
K = np.array([2e-3, -1e-3, 1.5e-3])

#: amperes at the times (N,)
SHAPES = {
    "square": lambda t: 5 + 4 * np.sign(np.sin(t / 3)) + np.sin(0.7 * t),
    "quick square": lambda t: 5 + 5 * np.sign(np.sin(1.5 * t)),
    "ramps": lambda t: 10 * np.abs((t / 12) % 2 - 1),
    "pulses": lambda t: 8.0 * (t % 9 < 0.7),
    "levels": lambda t: np.random.default_rng(7).uniform(0, 10, 100)[(t / 8).astype(int)],
}

#: those that a test takes which is not slow
QUICK = ("square", "pulses")


def _disturbed(track: Track, current: Array, *, logged: bool) -> Track:
    covariates = {"motor_current_a": current} if logged else {}
    return replace(
        track, mag_b_gauss=track.mag_b_gauss + np.outer(current, K), covariates=covariates
    )


@pytest.mark.parametrize(
    "shape",
    [pytest.param(one, marks=() if one in QUICK else pytest.mark.slow) for one in SHAPES],
)
@pytest.mark.parametrize("seed", [6, pytest.param(11, marks=pytest.mark.slow)])
def test_a_logged_current_alone_is_named(shape: str, seed: int) -> None:
    track = track_of(experiment("wam", seed=seed, samples=2500))
    found = diagnose(_disturbed(track, SHAPES[shape](track.time_s), logged=True))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    assert not found.unexplained.detected
    for parameter, truth in zip(found.findings[0].parameters, K, strict=True):
        assert parameter.value == pytest.approx(truth, abs=4 * parameter.std + 2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_the_steps_of_an_unlogged_current_are_no_lost_samples(seed: int) -> None:
    track = track_of(experiment("wam", seed=seed, samples=3000))
    found = diagnose(_disturbed(track, SHAPES["square"](track.time_s), logged=False))
    assert "dropped_samples" not in [one.effect for one in found.findings]
    assert found.unexplained.detected


def _at_the_instant(track: Track) -> Track:
    """A gyro that is read at the sample, not averaged over the step before it: half a step late."""
    rate = track.gyro_b_rad_s.copy()
    rate[:-1] = (rate[:-1] + rate[1:]) / 2
    return replace(track, gyro_b_rad_s=rate)


@pytest.mark.slow
def test_a_strong_current_is_not_turned_with_the_field_and_no_eddy_is_named_for_that() -> None:
    """0.3 G of a rover's motor, averaged in pairs at 20 Hz: nothing but the current, and a lag."""
    track = _at_the_instant(track_of(experiment("mam", seed=3, samples=3000, rate_hz=20.0)))
    k = np.array([7.5e-3, -3.75e-3, 7.5e-3])
    current = 4.0 * SHAPES["square"](track.time_s)
    field = np.outer(current, k)
    mag = track.mag_b_gauss + field
    found = diagnose(replace(track, mag_b_gauss=mag, covariates={"motor_current_a": current}))
    names = [one.effect for one in found.findings]
    assert names[0] == "motor_current_field"
    assert set(names[1:]) <= {"gyro_integration", "mag_time_lag"}
    values = [one.value for one in found.findings[0].parameters]
    np.testing.assert_allclose(values, k, atol=5e-5)


def _late(seed: int, shape: str, lag_s: float) -> Track:
    """A magnetometer that is late with all that it measures, the field of a current as well."""
    made = experiment("mam", seed=seed, samples=5000)
    current = SHAPES[shape](made.samples.time_s)
    truth = readings_of(made, {})
    lag = Term("mag_time_lag", np.array([lag_s]), np.zeros(1), {})
    late = SHAPES[shape](made.samples.time_s - lag_s)
    mag = simulated(truth, [lag], Noise(1e-3, 5e-4), seed).mag_b_gauss + np.outer(late, K)
    return replace(track_of(made), mag_b_gauss=mag, covariates={"motor_current_a": current})


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "shape"), [(11, "square")])
def test_a_late_magnetometer_reads_a_current_late_and_no_change_of_it_is_named(seed, shape):
    found = diagnose(_late(seed, shape, 0.07))
    assert {one.effect for one in found.findings} == {"motor_current_field", "mag_time_lag"}
    assert not found.unexplained.detected
    (current,) = (one for one in found.findings if one.effect == "motor_current_field")
    for parameter, truth in zip(current.parameters, K, strict=True):
        assert parameter.value == pytest.approx(truth, rel=0.02)
