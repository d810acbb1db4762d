"""The omnibus tests: p values are uniform on nulls, and each test detects its kind of misfit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.omnibus import Test, omnibus_tests, variance_test
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.innovation_filter.context import build_context
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.model import Context
from ahrsd.samples import Array


def _filtered(seed: int, extra: Array | None = None) -> Filtered:
    made = experiment("mam", seed=seed, samples=1500)
    track = track_of(made)
    if extra is not None:
        track = replace(track, mag_b_gauss=track.mag_b_gauss + extra)
    return run_filter(track, true_model(made))


def _context(done: Filtered) -> Context:
    fit = NullFit(done.model, done, True, np.zeros((11, 11)))
    return build_context(done.track, fit)


def _named(tests: tuple[Test, ...]) -> dict[str, Test]:
    return {test.name: test for test in tests}


def test_p_values_are_uniform_on_nulls() -> None:
    found: dict[str, list[float]] = {}
    for seed in range(40):
        done = _filtered(seed)
        for test in omnibus_tests(done, _context(done)):
            found.setdefault(test.name, []).append(test.p_value)
    assert set(found) == {
        "normalised_innovation",
        "ljung_box",
        "cumulative_periodogram",
        "normality",
        "variance",
    }
    for name, values in found.items():
        assert min(values) > 1e-4, name
        if name == "cumulative_periodogram":  # Bonferroni over the axes: conservative
            assert stats.kstest(values, "uniform", alternative="greater").pvalue > 1e-3, name
        else:
            assert stats.kstest(values, "uniform").pvalue > 1e-3, name


def test_normalised_innovation_detects_noise_above_the_model() -> None:
    rng = np.random.default_rng(0)
    tests = _named(omnibus_tests(_filtered(1, 6e-4 * rng.standard_normal((1500, 3)))))
    assert tests["normalised_innovation"].p_value < 1e-6
    assert tests["normalised_innovation"].value > 1.2
    assert tests["ljung_box"].p_value > 1e-3


def test_whiteness_tests_detect_a_slow_field_and_a_fast_line() -> None:
    t = np.arange(1500) * 0.04
    slow = 3e-3 * np.sin(2 * np.pi * 0.3 * t)[:, None] * np.array([1.0, 0.0, 1.0])
    tests = _named(omnibus_tests(_filtered(1, slow)))
    assert tests["ljung_box"].p_value < 1e-6
    assert tests["cumulative_periodogram"].p_value < 1e-6
    fast = 1e-3 * np.sin(2 * np.pi * 9.3 * t)[:, None] * np.array([0.0, 1.0, 0.0])
    assert _named(omnibus_tests(_filtered(1, fast)))["cumulative_periodogram"].p_value < 1e-4


def test_normality_test_detects_outliers() -> None:
    rng = np.random.default_rng(3)
    hit = 8e-3 * rng.standard_normal((1500, 3)) * (rng.random((1500, 1)) < 0.01)
    assert _named(omnibus_tests(_filtered(1, hit)))["normality"].p_value < 1e-9


def test_variance_test_names_the_column_that_the_variance_follows() -> None:
    rng = np.random.default_rng(2)
    current = np.where(np.arange(1500) % 400 < 150, 8.0, 1.0)
    done = _filtered(1, 2e-4 * current[:, None] * rng.standard_normal((1500, 3)))
    columns = {"motor_current_a": current, "time": done.track.time_s, "constant": np.ones(1500)}
    test = variance_test(done, columns)
    assert test.p_value < 1e-9
    assert test.expected == 2
    assert "motor_current_a" in test.words
    assert variance_test(done, {"constant": np.ones(1500)}).p_value == 1.0


def test_no_omnibus_tests_when_samples_are_too_few() -> None:
    made = experiment(samples=60)
    assert omnibus_tests(run_filter(track_of(made), true_model(made))) == ()


def test_no_omnibus_tests_when_the_noise_level_is_only_assumed() -> None:
    """A simulation without magnetometer noise: the readings have no scatter along the field."""
    made = experiment("mam", seed=0, samples=1500, sigma_mag=0.0, sigma_gyro=5e-3)
    model = replace(true_model(made), sigma_mag_gauss=priors.FLOOR_MAG_GAUSS)
    done = run_filter(track_of(made), model)
    assert float(np.mean(done.whitened[done.used] ** 2)) < 0.75
    assert omnibus_tests(done, _context(done)) == ()
    louder = experiment(
        "mam", seed=0, samples=1500, sigma_mag=priors.FLOOR_MAG_GAUSS, sigma_gyro=5e-3
    )
    done = run_filter(track_of(louder), model)
    assert {test.p_value > 1e-4 for test in omnibus_tests(done, _context(done))} == {True}
