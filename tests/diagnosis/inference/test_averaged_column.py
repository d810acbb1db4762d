"""A current that its logger averages has its field, and no field of its derivative."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from tracks import experiment, track_of

from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.inference.likelihood.logged_columns import deconvolve_mean

PER_AMPERE = np.array([1.2e-3, -0.7e-3, 0.5e-3])


def driven(seed: int, memory_s: float, mean_s: float):
    """120 s next to a current with correlation time memory_s, logged as a mean over mean_s."""
    track = track_of(experiment("wam", seed=seed, samples=3000))
    kept, count = np.exp(-track.step_s / memory_s), max(1, round(mean_s / track.step_s))
    drawn = np.random.default_rng(seed).normal(0.0, np.sqrt(1 - kept**2), len(track))
    amps = 6.0 + 2.5 * lfilter([1.0], [1.0, -kept], drawn)
    before = np.concatenate([np.full(count - 1, amps[0]), amps])
    logged = np.convolve(before, np.ones(count) / count, "valid")
    mag = track.mag_b_gauss + amps[:, None] * PER_AMPERE
    return replace(track, mag_b_gauss=mag, covariates={"motor_current_a": logged})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("memory_s", "mean_s"),
    [(0.5, 0.4), (6.0, 0.2), (2.0, 0.4)],
)
def test_averaged_current_is_a_single_finding_with_its_averaging_time(
    memory_s: float, mean_s: float
):
    found = diagnose(driven(16, memory_s, mean_s))
    assert [one.effect for one in found.findings] == ["motor_current_field"]
    (said,) = [one for one in found.notes if one.startswith("column motor_current_a is taken as")]
    assert f"the mean of {mean_s:.2g} s" in said
    how = found.findings[0].setting
    assert how["mean_s"] == pytest.approx(mean_s, abs=0.05)
    assert how["late_s"] == pytest.approx(
        (mean_s - 0.04) / 2, abs=0.04
    )  # the mean of the preceding rows
    assert [term.setting for term in found.terms] == [how]
    values = [p.value for p in found.findings[0].parameters]
    np.testing.assert_allclose(values, PER_AMPERE, rtol=0.05)
    assert not found.unexplained.detected


@pytest.mark.slow
def test_true_derivative_field_is_found_next_to_the_current():
    """Its direction differs from the current's, so no time shift of the column explains both."""
    track = driven(17, 0.5, 0.0)
    current = track.covariates["motor_current_a"]
    change = np.gradient(current, track.time_s)[:, None] * np.array([2e-4, 3e-4, -2e-4])
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + change))
    names = sorted(one.effect for one in found.findings)
    assert names == ["current_derivative_field", "motor_current_field"]
    assert not any(" is taken as " in note for note in found.notes)


@pytest.mark.parametrize(("waves", "rel"), [(0.05, 0.005), (0.3, 0.02), (0.6, 0.06), (0.8, 0.35)])
def test_deconvolution_restores_the_amplitude_of_waves_within_the_mean(waves: float, rel: float):
    """Waves shorter than the mean are restored; a wave of exactly its length is lost."""
    time_s = np.arange(4000) * 0.04 + 0.002 * np.sin(np.arange(4000))
    turn = 2 * np.pi * waves / 0.8
    averaged = np.cos(turn * time_s + 0.3) * np.sinc(waves)
    found = deconvolve_mean(time_s, averaged, 0.8)
    inside = (time_s > 8.0) & (time_s < 150.0)
    wave = np.exp(-1j * turn * time_s[inside])
    before = np.abs(np.mean(wave * found[inside])) / np.abs(np.mean(wave * averaged[inside]))
    assert before * np.sinc(waves) == pytest.approx(1.0, rel=rel)


def test_deconvolution_does_not_amplify_noise_without_limit():
    rng = np.random.default_rng(1)
    noise = rng.normal(size=4000)
    found = deconvolve_mean(np.arange(4000) * 0.04, noise, 0.8)
    assert np.std(found) < 4.0 * np.std(noise)
