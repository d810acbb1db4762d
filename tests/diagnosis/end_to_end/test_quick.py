"""Disturbances above the working rate: lines, rotors and pulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null_fit import cold_start, fit_null
from ahrsd.diagnosis.calibration_fit.resampling import working_factor
from ahrsd.diagnosis.effects.effect import readings_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.effects.sensor_sources import find_pulse_trains, pulse_train
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Spec, Track

RATE_HZ = 40.0


@pytest.fixture(scope="module")
def undisturbed() -> Track:
    return made(Trial(seed=5, samples=7000, rate_hz=RATE_HZ)).track


def test_recording_of_these_tests_is_averaged(undisturbed: Track) -> None:
    assert working_factor(undisturbed, cold_start(undisturbed, Spec())) in (3, 4, 5)


def test_pulse_train_is_found_with_period_phase_and_width() -> None:
    rng = np.random.default_rng(1)
    time_s = 1e6 + np.arange(8000) / RATE_HZ
    truth = {"start_s": 1e6, "period_s": 1.7313, "phase_s": 0.62, "width_s": 0.07}
    noise = 1e-3 * rng.standard_normal((8000, 3))
    pulses = pulse_train(time_s, truth)[:, None] * 1.5e-3 * np.array([0.6, -0.48, 0.64])
    (found,) = find_pulse_trains(noise + pulses, time_s, 1 / RATE_HZ)
    assert abs(found["period_s"] - 1.7313) < 2e-4
    assert np.mean(pulse_train(time_s, found) != pulse_train(time_s, truth)) < 0.02
    assert found["searched"] > 1000


def test_edges_of_strong_pulses_are_modelled_exactly() -> None:
    """A relative error of the period of 5e-5 would miss a sample at each end of 300 s."""
    rng = np.random.default_rng(2)
    time_s = np.arange(15_000) / 50.0
    truth = {"start_s": 0.0, "period_s": 1.40335, "phase_s": 1.241, "width_s": 0.06}
    pulses = pulse_train(time_s, truth)[:, None] * 9e-3 * np.array([0.1, 0.6, 0.79])
    (found,) = find_pulse_trains(1e-3 * rng.standard_normal((15_000, 3)) + pulses, time_s, 0.02)
    assert abs(found["period_s"] - 1.40335) < 1e-5
    assert np.count_nonzero(pulse_train(time_s, found) != pulse_train(time_s, truth)) <= 2


@pytest.mark.parametrize("seed", [3, 4])
def test_pulse_lasts_at_least_one_sample_and_its_search_is_penalised(seed: int) -> None:
    """Narrower pulses would only fit the outliers of a heavy tail."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(8000) / RATE_HZ
    (found,) = find_pulse_trains(1e-3 * rng.standard_t(3, (8000, 3)), time_s, 1 / RATE_HZ)
    assert found["width_s"] >= 0.99 / RATE_HZ
    assert found["searched"] > 1000 * found["period_s"] * RATE_HZ * 16


def test_no_pulse_train_in_a_short_recording() -> None:
    assert find_pulse_trains(np.zeros((200, 3)), np.arange(200) / RATE_HZ, 1 / RATE_HZ) == ()


@pytest.mark.slow
def test_line_above_the_working_rate_is_found_at_its_frequency(undisturbed: Track) -> None:
    phase = 2 * np.pi * 13.217 * undisturbed.time_s[:, None]
    added = 0.8e-3 * np.cos(phase) * np.array([0.48, 0.6, -0.64])
    answer = diagnose(replace(undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + added))
    assert [one.effect for one in answer.findings] == ["ac_interference"]
    assert abs(answer.findings[0].setting["frequency_hz"] - 13.217) < 1e-3
    size = np.linalg.norm([one.value for one in answer.findings[0].parameters])
    assert abs(size / 0.8e-3 - 1) < 0.15
    check = answer.posterior_predictive["line"]
    assert not check.inside_before
    assert check.inside_after


def test_rotor_is_found_with_a_rounded_tachometer(undisturbed: Track) -> None:
    turns_hz = 31.2718
    rpm = np.full(len(undisturbed), round(60 * turns_hz, 0))
    phase = 2 * np.pi * turns_hz * undisturbed.time_s[:, None]
    field = np.cos(phase) * np.array([1.0, 0, 0]) + np.sin(phase) * np.array([0, 0.8, 0.6])
    turning = replace(
        undisturbed,
        mag_b_gauss=undisturbed.mag_b_gauss + 1e-3 * field,
        covariates={"pump_rpm": rpm},
    )
    effect = EFFECTS["rotor_field"]
    context = fit_null(turning, walk=False).context()
    best = effect.settings(context)[0]
    assert abs(best["off_hz"] - (turns_hz - rpm[0] / 60)) < 2e-3
    columns = effect.columns(context, best).mag
    assert columns is not None
    left = turning.mag_b_gauss - readings_of(context).mag_b_gauss
    value = np.linalg.lstsq(columns.reshape(-1, 6), left.ravel(), rcond=None)[0]
    assert abs(np.linalg.norm(value) / (1e-3 * np.sqrt(2)) - 1) < 0.1
