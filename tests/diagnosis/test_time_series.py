"""Filters by banded systems compared with scipy, and the play operator with a plain loop."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from effect_motion import moving
from scipy import ndimage, signal

from ahrsd import so3
from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.time_series import play_operator

VALUES = np.random.default_rng(0).standard_normal((500, 3))


def test_recursion_with_one_constant_equals_lfilter():
    found = time_series.first_order_recursion(VALUES, 0.93)
    np.testing.assert_allclose(found, signal.lfilter([1.0], [1.0, -0.93], VALUES, axis=0))
    assert np.array_equal(time_series.first_order_recursion(VALUES[:1], 0.93), VALUES[:1])


def test_recursion_with_varying_constants_equals_the_loop():
    keep = np.linspace(0.1, 0.99, len(VALUES) - 1)
    expected = VALUES.copy()
    for k in range(1, len(expected)):
        expected[k] += keep[k - 1] * expected[k - 1]
    np.testing.assert_allclose(
        time_series.first_order_recursion(VALUES, keep), expected, rtol=1e-12
    )


def test_autoregression_equals_lfilter():
    taps = np.array([0.5, -0.2, 0.3])
    found = time_series.autoregression(VALUES, taps[:, None])
    np.testing.assert_allclose(found, signal.lfilter([1.0], [1.0, *-taps], VALUES, axis=0))


def test_two_sided_sums_weight_by_distance():
    keep = 0.8
    weight = keep ** np.abs(np.subtract.outer(np.arange(500), np.arange(500)))
    np.testing.assert_allclose(time_series.two_sided_sums(VALUES, keep), weight @ VALUES, rtol=1e-9)


@pytest.mark.parametrize("width", [0.4, 3.0, 200.0])
def test_gaussian_smoothing_is_mirrored_at_the_ends(width):
    expected = ndimage.gaussian_filter1d(VALUES, width, axis=0, mode="reflect")
    np.testing.assert_allclose(time_series.gaussian_smooth(VALUES, width), expected, atol=1e-12)


def test_diagnosis_imports_neither_the_daemon_nor_plotting_libraries():
    heavy = ("gtsam", "rerun", "matplotlib", "pydantic", "scipy.stats", "scipy.signal", "serial")
    script = f"import sys, ahrsd.offline.diagnose; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("memory", [None, (0.3, -1.0, 0.9)])
def test_play_operator_equals_the_loop_over_rows(memory):
    values = np.cumsum(np.random.default_rng(3).standard_normal((777, 3)), axis=0)
    for radius in (0.01, 2.0, 40.0):
        last = values[0] + radius * np.asarray(memory or (0.0, 0.0, 0.0))
        for row, found in zip(values, play_operator(values, radius, memory), strict=True):
            last = np.clip(last, row - radius, row + radius)
            np.testing.assert_array_equal(found, last)


def test_play_operator_follows_at_its_radius_and_rests_after_a_reversal():
    values = np.array([0.0, 1.0, 2.0, 1.5, 0.5, -1.0])[:, None]
    assert time_series.play_operator(values, 0.5)[:, 0].tolist() == [0.0, 0.5, 1.5, 1.5, 1.0, -0.5]


def test_low_pass_lags_a_ramp_by_its_time_constant():
    dt_s = np.full(400, 0.05)
    dt_s[0] = np.nan
    ramp = 0.05 * np.arange(400)[:, None]
    out = time_series.low_pass(ramp, dt_s, 0.8)
    assert out[-1] == pytest.approx(ramp[-1] - 0.8, abs=1e-8)
    response = 0.05 * np.arange(400) - 0.8 * (1 - np.exp(-0.05 * np.arange(400) / 0.8))
    assert out[:, 0] == pytest.approx(response, abs=1e-12)


def test_low_pass_is_exact_for_irregular_steps():
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.02, 0.08, 500))
    dt_s = np.concatenate([[np.nan], np.diff(time_s)])
    out = time_series.low_pass(time_s[:, None] - time_s[0], dt_s, 0.8)[:, 0]
    passed = time_s - time_s[0]
    assert out == pytest.approx(passed - 0.8 * (1 - np.exp(-passed / 0.8)), abs=1e-12)


@pytest.mark.parametrize("tau_s", [0.013, 0.1])
def test_cubic_low_pass_is_exact_on_a_curve_when_faster_than_the_samples(tau_s):
    """Linear interpolation between samples would add the curvature of half a step."""
    time_s = 0.04 * np.arange(1000)
    dt_s = np.diff(time_s, prepend=np.nan)
    wave = np.sin(3.0 * time_s)[:, None]
    expected = np.imag(np.exp(3j * time_s) / (1 + 3j * tau_s))
    out = time_series.low_pass_cubic(wave, time_s, dt_s, tau_s)[:, 0]
    straight = time_series.low_pass(wave, dt_s, tau_s)[:, 0]
    inner = slice(50, -1)
    assert np.abs(out - expected)[inner].max() < 2e-5
    assert np.abs(straight - expected)[inner].max() > 1e-3
    jittered = np.sort(time_s + np.random.default_rng(0).uniform(-0.01, 0.01, 1000))
    uneven = np.sin(3.0 * jittered)[:, None]
    steps = np.diff(jittered, prepend=np.nan)
    out = time_series.low_pass_cubic(uneven, jittered, steps, tau_s)[:, 0]
    expected = np.imag(np.exp(3j * jittered) / (1 + 3j * tau_s))
    assert np.abs(out - expected)[inner].max() < 1e-3


def test_delayed_field_of_whole_steps_is_an_earlier_row():
    _, readings = moving(1, rows=200)
    back = time_series.delayed_field(readings, np.full(200, 0.15))
    assert back[3:] == pytest.approx(readings.field_b[:-3], abs=1e-12)
    half = time_series.delayed_field(readings, np.full(200, 0.075))
    between = so3.exp(readings.rate_b_rad_s[5] * 0.025) @ readings.field_b[5]
    assert half[6] == pytest.approx(between, abs=1e-12)
