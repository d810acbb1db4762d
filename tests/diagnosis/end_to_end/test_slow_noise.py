"""Noise with a correlation time of seconds: no unknown by itself, and other causes are found in
it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.signal import lfilter

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track


def slow(rng: np.random.Generator, count: int, rate_hz: float, time_s: float) -> np.ndarray:
    """First-order noise (count, 3) with unit standard deviation."""
    keep = np.exp(-1.0 / (rate_hz * time_s))
    white = rng.standard_normal((count, 3)) * np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


@pytest.fixture(scope="module")
def undisturbed() -> Track:
    return replace(made(Trial(seed=8)).track, covariates={})


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_noise_with_a_correlation_time_of_two_seconds_is_no_unknown(seed: int) -> None:
    undisturbed = replace(made(Trial(seed=8, samples=6000)).track, covariates={})
    noise = 5e-4 * slow(np.random.default_rng(seed), len(undisturbed), 25.0, 2.0)
    answer = diagnose(replace(undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + noise))
    assert answer.findings == ()
    assert not answer.unexplained.detected


@pytest.mark.slow
def test_gyro_scale_is_found_in_slow_noise() -> None:
    """Modelled as white, such noise would leave a residual that hides an effect of this size."""
    one = made(Trial(12, (("gyro_scale", 1.0),), samples=10_000, rate_hz=40.0, noise="red"))
    answer = diagnose(one.track)
    assert [found.effect for found in answer.findings] == ["gyro_scale"]
    assert not answer.unexplained.detected
    values = answer.findings[0].parameters
    z = [(v.value - t) / v.std for v, t in zip(values, one.truth[0][1], strict=True)]
    assert np.abs(z).max() < 3.0


@pytest.mark.slow
def test_unknown_source_is_found_in_slow_noise(undisturbed: Track) -> None:
    noise = 5e-4 * slow(np.random.default_rng(1), len(undisturbed), 25.0, 2.0)
    on = (undisturbed.time_s % 97.0) < 41.0
    field = on[:, None] * np.array([1.5e-3, 1e-3, -1.5e-3])
    answer = diagnose(replace(undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + noise + field))
    assert answer.findings == ()
    where = answer.unexplained.where
    assert where is not None
    assert where.frame == "sensor"
