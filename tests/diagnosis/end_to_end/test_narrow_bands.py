"""Narrow bands above the noise: sources that turn or sway at a varying rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.signal import lfilter

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.where_and_when.narrow_band import loudest_band


def turning(time_s: np.ndarray, rate_hz: float, spread_hz: float) -> np.ndarray:
    """(N,) phase of a source that turns at a wandering rate."""
    rng = np.random.default_rng(7)
    step_s = float(np.median(np.diff(time_s)))
    slow = np.convolve(rng.standard_normal(len(time_s)), np.ones(200) / 200**0.5, mode="same")
    return 2 * np.pi * np.cumsum(rate_hz + spread_hz * slow) * step_s


def test_narrow_band_is_found_and_coloured_noise_is_not() -> None:
    rng = np.random.default_rng(3)
    white = rng.standard_normal((10_000, 3))
    assert loudest_band(white, 25.0, 12.5) is None
    assert loudest_band(rng.standard_t(3, (10_000, 3)), 25.0, 12.5) is None
    for taps in ([1, -0.9], [1, -0.5, 0.2], [1, 0.6]):
        assert loudest_band(lfilter([1], taps, white, axis=0), 25.0, 12.5) is None
    phase = turning(np.arange(10_000) / 25.0, 5.0, 0.15)
    seen = white + np.outer(np.cos(phase), [1.5, 0.5, 0.0])
    low, high, nats = loudest_band(seen, 25.0, 12.5)
    assert 4.0 < low < 5.0 < high < 6.0
    assert nats > 100.0


def test_alias_of_slow_noise_at_the_rate_of_new_readings_is_ignored() -> None:
    """Every third row has a new reading: red noise then seemed to ring at 16.7 Hz (one case of
    126).
    """
    rng = np.random.default_rng(4)
    red = lfilter([1], [1, -0.98], rng.standard_normal((12_000, 3)), axis=0)
    seen = np.where(np.arange(12_000)[:, None] % 3 == 0, rng.standard_normal((12_000, 3)) + red, 0)
    low, high, _ = loudest_band(seen, 50.0, 25.0)
    assert low < 50.0 / 3 < high
    assert loudest_band(seen, 50.0, 25.0 / 3) is None


@pytest.mark.slow
def test_unlogged_propeller_is_an_unknown_cause_with_its_frequency_band() -> None:
    """It was once absorbed by the coloured noise, so that recording and model agreed."""
    quiet = replace(made(Trial(seed=8, samples=6000)).track, covariates={})
    phase = turning(quiet.time_s, 3.0, 0.25)
    field = np.outer(np.cos(phase), [1.2e-3, -0.8e-3, 0.0])
    field += np.outer(np.sin(phase), [0.0, 0.8e-3, 1.0e-3])
    assert diagnose(quiet).mismatch is False
    answer = diagnose(replace(quiet, mag_b_gauss=quiet.mag_b_gauss + field))
    assert answer.findings == ()
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
    assert where.band_hz is not None
    assert where.band_hz[0] < 3.0 < where.band_hz[1]
    assert answer.p_value < 1e-6
