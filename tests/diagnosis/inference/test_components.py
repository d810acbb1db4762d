"""Laws of coefficients, functions of the remainder, and the noise's weights."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_t

from ahrsd.diagnosis import inference, priors
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.inference.components.component import ScaledLaw
from ahrsd.diagnosis.inference.components.gaussian_process import GaussianProcessLaw
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.estimator.locked import harmonics, rate_products


@pytest.mark.parametrize("psi", [np.array([0.3, 0.5]), np.array([-1.0, 3.0])])
def test_a_course_has_the_size_that_its_law_says(psi):
    law = GaussianProcessLaw(np.repeat(np.arange(1.0, 41.0), 3), 1e-3)
    variance = np.exp(law.log_variance(psi))
    t = np.linspace(0.0, 1.0, 4001)
    modes = np.cos(np.pi * t[:, None] * np.arange(1, 41))
    over_time = np.mean(modes**2, axis=0) @ variance[::3]
    assert np.sqrt(over_time) == pytest.approx(1e-3 * np.exp(psi[0]), rel=1e-3)


def test_slopes_are_those_of_differences():
    law = GaussianProcessLaw(np.repeat(np.arange(1.0, 21.0), 3), 1e-3, mean=0.5, spread=1.2)
    psi = np.array([0.2, 1.1])
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        ahead, behind = law.log_variance(psi + step), law.log_variance(psi - step)
        np.testing.assert_allclose(law.slope(psi)[:, k], (ahead - behind) / 2e-6, atol=1e-6)
        density = (law.log_prior(psi + step)[0] - law.log_prior(psi - step)[0]) / 2e-6
        assert law.log_prior(psi)[1][k] == pytest.approx(density, abs=1e-6)


def test_an_ordinary_size_is_a_lognormal_density():
    law = ScaledLaw(np.ones(2), np.array([-20.0]), np.array([20.0]), mean=-1.0, spread=0.7)
    grid = np.linspace(-10.0, 10.0, 4001)
    density = np.exp([law.log_prior(np.array([x]))[0] for x in grid])
    assert np.sum(density) * (grid[1] - grid[0]) == pytest.approx(1.0, abs=1e-6)
    assert law.log_variance(np.array([-1.0]))[0] == pytest.approx(-2.0)


def test_harmonics_are_orthonormal_and_no_calibration():
    rng = np.random.default_rng(1)
    n = rng.normal(size=(200_000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    H = harmonics(0.5 * n)
    np.testing.assert_allclose(H.T @ H / len(n), np.eye(12), atol=0.03)
    np.testing.assert_allclose(H.T @ np.column_stack([np.ones(len(n)), n]) / len(n), 0.0, atol=0.02)


def test_squares_of_the_rates():
    np.testing.assert_allclose(rate_products(np.array([[2.0, 3.0, 5.0]])), [[4, 9, 25, 6, 15, 10]])


def test_octaves_cover_all_cosines():
    edges = noise_model.octave_edges(6000)
    assert edges[0] == 0
    assert edges[-1] == 6000
    assert len(edges) == priors.BANDS + 1
    assert np.all(edges[2:-1] * 2 <= edges[3:] + 1)


def test_the_noise_prior_has_the_slope_of_its_differences():
    x = np.array([0.3, -0.2, 0.9, 0.1])
    _, gradient = noise_model.log_prior(x, 0.6)
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        slope = (
            noise_model.log_prior(x + step, 0.6)[0] - noise_model.log_prior(x - step, 0.6)[0]
        ) / 2e-6
        assert gradient[k] == pytest.approx(slope, abs=1e-6)


def test_a_wild_reading_counts_less_and_rows_that_are_normal_count_alike():
    rng = np.random.default_rng(2)
    residual = rng.normal(size=(2000, 3))
    used = np.ones(2000, dtype=bool)
    calm = noise_model.fit_noise_levels(residual, used, 10.0)
    assert np.ptp(np.log(calm.amplitude)) < 0.9  # the level alone, a median of forty
    residual[500:2000:50] = 30.0
    weight = noise_model.fit_noise_levels(residual, used, 10.0).amplitude
    assert np.all(weight[500:2000:50] > 5.0)
    assert np.median(weight) == pytest.approx(1.0, abs=0.15)


def test_rows_of_students_law_are_as_likely_as_that_law_says():
    """The tangent at the residual of which they were made, in its density's own units."""
    rng = np.random.default_rng(5)
    scale = np.sqrt(rng.chisquare(3.0, size=4000) / 3.0)
    residual = rng.normal(size=(4000, 3)) / scale[:, None]
    loud = noise_model.fit_noise_levels(residual, np.ones(4000, dtype=bool), 20.0)
    rows = residual / loud.amplitude[:, None]
    nats = loud.tails - 0.5 * np.sum(rows**2) - 3.0 * np.sum(np.log(loud.amplitude))
    nats -= 1.5 * len(rows) * np.log(2 * np.pi)
    law = multivariate_t(np.zeros(3), np.eye(3), df=3.0)
    # a level of its own every few seconds costs some nats
    assert nats == pytest.approx(law.logpdf(residual).sum(), abs=150.0)


def test_the_level_follows_noise_that_is_louder_for_long():
    rng = np.random.default_rng(3)
    residual = rng.normal(size=(4000, 3))
    residual[2500:] *= 4.0
    weight = noise_model.fit_noise_levels(residual, np.ones(4000, dtype=bool), 10.0).amplitude
    assert np.median(weight[3000:]) / np.median(weight[:2000]) == pytest.approx(4.0, rel=0.15)


def test_identifiers_of_effects_stand_in_the_library_alone():
    sources = sorted(Path(next(iter(inference.__path__))).rglob("*.py"))
    texts = {
        (path.name, node.value)
        for path in sources
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert len(sources) > 10
    assert {(name, text) for name, text in texts if text in EFFECTS} == set()


def test_what_the_model_must_know_of_an_effect_is_in_its_row():
    jumps = {name: row.frame or row.family for name, row in EFFECTS.items() if row.jumps}
    assert jumps == {"hard_iron_step": "sensor", "field_step": "world", "gyro_bias_step": "gyro"}
    assert {name for name, row in EFFECTS.items() if row.recurs} - set(jumps) == {"soft_iron_step"}
    delays = {name: row.delay for name, row in EFFECTS.items() if row.delay}
    late = {"mag_time_lag": 1.0, "mag_low_pass": 1.0, "gyro_integration": 1.0}
    assert delays == {**late, "gyro_time_lag": -1.0}
    assert EFFECTS["field_anomaly"].ordinary == pytest.approx(8.8)
    assert [name for name, row in EFFECTS.items() if row.ordinary_part] == ["flexible_mount"]
