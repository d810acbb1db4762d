"""Colour, tails and levels of the innovations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.innovation_filter.noise import (
    Colour,
    block_variances,
    colour_before_filter,
    fit_colour,
    level_facts,
    tail_freedom,
)
from ahrsd.samples import Array


def _filtered(seed: int, extra: Array | None = None, samples: int = 4000) -> Filtered:
    made = experiment("wam", seed=seed, samples=samples)
    track = track_of(made)
    if extra is not None:
        track = replace(track, mag_b_gauss=track.mag_b_gauss + extra)
    return run_filter(track, true_model(made))


def _red(seed: int, power: float, samples: int = 4000, memory_s: float = 1.0) -> Array:
    """Red noise with `power` times the white noise's 1 mG^2."""
    keep = np.exp(-0.04 / memory_s)
    white = np.random.default_rng([seed, 77]).standard_normal((samples, 3))
    return np.asarray(
        1e-3 * np.sqrt(power * (1 - keep**2)) * lfilter([1.0], [1.0, -keep], white, axis=0)
    )


def test_white_innovations_have_no_colour_and_no_tails() -> None:
    for seed in range(4):
        done = _filtered(seed)
        assert fit_colour(done).order == 0
        assert tail_freedom(done) > 20
        assert level_facts(done, spec_given=True) == []


def test_colour_is_found_and_removed_by_its_filter() -> None:
    done = _filtered(0, _red(0, 0.3))
    colour = fit_colour(done)
    assert colour.order >= 1
    gain = colour.coefficients.sum()
    assert colour.variance / (1 - gain) ** 2 > 2  # the power at low frequency
    again = lfilter([1.0, *-colour.coefficients], [1.0], done.whitened[done.used], axis=0)
    again /= np.sqrt(colour.variance)
    rho = float(np.sum(again[1:] * again[:-1]) / np.sum(again**2))
    assert abs(rho) < 3 / np.sqrt(3 * len(again))
    assert abs(np.var(again) - 1) < 0.03


def test_degrees_of_freedom_of_heavy_tails_are_found() -> None:
    rng = np.random.default_rng(4)
    made = experiment("wam", samples=6000, sigma_mag=1e-6)
    track = track_of(made)
    t4 = rng.standard_t(5, (6000, 3)) * 1e-3 / np.sqrt(5 / 3)
    model = replace(true_model(made), sigma_mag_gauss=1e-3)
    done = run_filter(replace(track, mag_b_gauss=track.mag_b_gauss + t4), model)
    assert 4 < tail_freedom(done) < 10
    assert level_facts(done) == []


def test_noise_burst_is_found_with_its_time_and_size() -> None:
    rng = np.random.default_rng(6)
    extra = np.zeros((4000, 3))
    extra[1500:1900] = 3e-3 * rng.standard_normal((400, 3))
    (fact,) = level_facts(_filtered(1, extra))
    assert fact.effect == "noise_burst"
    begin, end = fact.where.intervals_s[0]
    assert abs(begin - 60) < 2.5
    assert abs(end - 76) < 2.5
    assert abs(fact.parameters[0].value / 3e-3 - 1) < 0.25


def test_several_bursts_are_separated() -> None:
    rng = np.random.default_rng(6)
    extra = np.zeros((4000, 3))
    spans = [(400, 560), (1700, 1850), (3700, 3880)]
    for a, b in spans:
        extra[a:b] = 2e-3 * rng.standard_normal((b - a, 3))
    (fact,) = level_facts(_filtered(1, extra))
    assert fact.effect == "noise_burst"
    assert len(fact.where.intervals_s) == 3
    for (a, b), (begin, end) in zip(spans, fact.where.intervals_s, strict=True):
        assert abs(begin - 0.04 * a) < 1.5
        assert abs(end - 0.04 * b) < 1.5


def _heavy(seed: int, samples: int) -> Filtered:
    """White innovations from Student's t with 3.5 degrees of freedom and variance 1."""
    done = _filtered(0)
    drawn = np.random.default_rng([seed, 35]).standard_t(3.5, (samples, 3)) / np.sqrt(3.5 / 1.5)
    track = replace(
        done.track,
        time_s=np.arange(samples) * 0.02,
        mag_b_gauss=np.zeros((samples, 3)),
        gyro_b_rad_s=np.zeros((samples, 3)),
    )
    return replace(done, track=track, whitened=drawn, used=np.ones(samples, dtype=bool))


@pytest.mark.parametrize("seed", range(20))
def test_heavy_tails_are_no_bursts_and_do_not_hide_one(seed: int) -> None:
    done = _heavy(seed, 10000)
    assert level_facts(done) == []
    louder = done.whitened.copy()
    louder[5000:5500] *= 1.8
    (fact,) = level_facts(replace(done, whitened=louder))
    assert fact.effect == "noise_burst"
    assert len(fact.where.intervals_s) <= 6
    inside = sum(
        min(b, 111.0) - max(a, 99.0) for a, b in fact.where.intervals_s if a < 111 and b > 99
    )
    assert inside > 8.0
    assert sum(b - a for a, b in fact.where.intervals_s) - inside < 8.0


@pytest.mark.parametrize("onset", [0, 1800])
def test_higher_noise_level_is_found_with_onset_and_size(onset: int) -> None:
    rng = np.random.default_rng(7)
    extra = np.zeros((4000, 3))
    extra[onset:] = 1.5e-3 * rng.standard_normal((4000 - onset, 3))
    (fact,) = level_facts(_filtered(2, extra), spec_given=True)
    assert fact.effect == "noise_level"
    assert abs(fact.where.intervals_s[0][0] - onset * 0.04) < 3
    assert abs(fact.parameters[0].value / 1.5e-3 - 1) < 0.2


@pytest.mark.parametrize("seed", range(4))
def test_outliers_are_not_a_higher_noise_level(seed: int) -> None:
    rng = np.random.default_rng([seed, 8])
    extra = np.where(rng.random((4000, 1)) < 0.003, 15e-3 * rng.standard_normal((4000, 3)), 0.0)
    done = _filtered(seed, extra)
    _, variance, size = block_variances(done)
    assert np.average(variance, weights=size) > 1.3  # the power is well above the specification
    assert level_facts(done, spec_given=True) == []


def test_decreasing_noise_level_is_not_a_burst() -> None:
    extra = np.zeros((4000, 3))
    extra[:1300] = 1.2e-3 * np.random.default_rng(8).standard_normal((1300, 3))
    (fact,) = level_facts(_filtered(3, extra))
    assert fact.effect == "noise_level"
    assert abs(fact.setting["onset_s"] - 52) < 3
    assert abs(fact.where.intervals_s[0][1] - 52) < 3
    assert abs(fact.parameters[0].value / 1.2e-3 - 1) < 0.2


def test_constant_field_has_no_noise_facts() -> None:
    done = _filtered(0)
    flat = replace(done.track, mag_b_gauss=np.tile(done.track.mag_b_gauss[:1], (4000, 1)))
    still = replace(flat, gyro_b_rad_s=np.zeros((4000, 3)))
    model = replace(done.model, gyro_bias_rad_s=np.zeros(3))
    filtered = run_filter(still, model)
    assert level_facts(filtered, spec_given=True) == []
    assert fit_colour(filtered).order == 0


def test_motion_with_a_dead_gyro_is_not_a_burst() -> None:
    done = _filtered(0)
    lost = replace(done.track, gyro_b_rad_s=np.zeros((4000, 3)))
    model = replace(done.model, sigma_mag_gauss=1e-2)
    assert level_facts(run_filter(lost, model), spec_given=True) == []


def test_slow_field_is_not_noise() -> None:
    t = np.arange(4000) * 0.04
    bump = 0.02 * np.exp(-(((t - 80) / 6) ** 2))[:, None] * np.array([1.0, 0.5, -1.0])
    done = _filtered(3, bump)
    assert done.normalised_innovation > 3
    assert level_facts(done, spec_given=True) == []
    _, variance, _ = block_variances(done)
    assert variance.max() < 2


def test_colour_before_a_filter_is_recovered_from_the_filtered_colour():
    wanted = Colour(np.array([0.6]), 1.0)
    found = Colour(np.array([0.3]), 0.9)
    colour, louder = colour_before_filter(wanted, found)
    expected = wanted.power**2 / found.power
    np.testing.assert_allclose(colour.power, expected, rtol=0.02)
    # variances are means of the spectral densities
    assert louder**2 == pytest.approx(expected.mean() / wanted.power.mean(), rel=0.01)
    same, factor = colour_before_filter(wanted, wanted)
    np.testing.assert_allclose(same.power, wanted.power, rtol=1e-4)
    assert factor == pytest.approx(1.0, abs=1e-5)
