"""What is too quick for the working rate: lines, rotors, pulses."""

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
def quiet() -> Track:
    return made(Trial(seed=5, samples=7000, rate_hz=RATE_HZ)).track


def test_this_recording_is_averaged(quiet: Track) -> None:
    assert working_factor(quiet, cold_start(quiet, Spec())) in (3, 4, 5)


def test_a_train_of_pulses_is_found_with_period_phase_and_width() -> None:
    rng = np.random.default_rng(1)
    time_s = 1e6 + np.arange(8000) / RATE_HZ
    truth = {"start_s": 1e6, "period_s": 1.7313, "phase_s": 0.62, "width_s": 0.07}
    noise = 1e-3 * rng.standard_normal((8000, 3))
    pulses = pulse_train(time_s, truth)[:, None] * 1.5e-3 * np.array([0.6, -0.48, 0.64])
    (found,) = find_pulse_trains(noise + pulses, time_s, 1 / RATE_HZ)
    assert abs(found["period_s"] - 1.7313) < 2e-4
    assert np.mean(pulse_train(time_s, found) != pulse_train(time_s, truth)) < 0.02
    assert found["searched"] > 1000


def test_strong_pulses_leave_no_edge_of_theirs_behind() -> None:
    """A period that is off by half a ten-thousandth misses a sample at either end of 300 s."""
    rng = np.random.default_rng(2)
    time_s = np.arange(15_000) / 50.0
    truth = {"start_s": 0.0, "period_s": 1.40335, "phase_s": 1.241, "width_s": 0.06}
    pulses = pulse_train(time_s, truth)[:, None] * 9e-3 * np.array([0.1, 0.6, 0.79])
    (found,) = find_pulse_trains(1e-3 * rng.standard_normal((15_000, 3)) + pulses, time_s, 0.02)
    assert abs(found["period_s"] - 1.40335) < 1e-5
    assert np.count_nonzero(pulse_train(time_s, found) != pulse_train(time_s, truth)) <= 2


@pytest.mark.parametrize("seed", [3, 4])
def test_a_pulse_lasts_a_sample_at_least_and_its_search_is_paid(seed: int) -> None:
    """Narrower ones would hit nothing but the outliers of a heavy tail."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(8000) / RATE_HZ
    (found,) = find_pulse_trains(1e-3 * rng.standard_t(3, (8000, 3)), time_s, 1 / RATE_HZ)
    assert found["width_s"] >= 0.99 / RATE_HZ
    assert found["searched"] > 1000 * found["period_s"] * RATE_HZ * 16


def test_a_short_recording_holds_no_train() -> None:
    assert find_pulse_trains(np.zeros((200, 3)), np.arange(200) / RATE_HZ, 1 / RATE_HZ) == ()


@pytest.mark.slow
def test_a_line_above_the_working_rate_is_named_at_its_frequency(quiet: Track) -> None:
    phase = 2 * np.pi * 13.217 * quiet.time_s[:, None]
    added = 0.8e-3 * np.cos(phase) * np.array([0.48, 0.6, -0.64])
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + added))
    assert [one.effect for one in answer.findings] == ["ac_interference"]
    assert abs(answer.findings[0].setting["frequency_hz"] - 13.217) < 1e-3
    size = np.linalg.norm([one.value for one in answer.findings[0].parameters])
    assert abs(size / 0.8e-3 - 1) < 0.15
    check = answer.posterior_predictive["line"]
    assert not check.inside_before
    assert check.inside_after


def test_a_rotor_is_found_though_its_tachometer_is_rounded(quiet: Track) -> None:
    turns_hz = 31.2718
    rpm = np.full(len(quiet), round(60 * turns_hz, 0))
    phase = 2 * np.pi * turns_hz * quiet.time_s[:, None]
    field = np.cos(phase) * np.array([1.0, 0, 0]) + np.sin(phase) * np.array([0, 0.8, 0.6])
    turning = replace(
        quiet, mag_b_gauss=quiet.mag_b_gauss + 1e-3 * field, covariates={"pump_rpm": rpm}
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
