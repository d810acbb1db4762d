"""Laws of coefficients, functions of the remainder, and the noise weights."""

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
def test_gaussian_process_has_the_standard_deviation_of_its_law(psi):
    law = GaussianProcessLaw(np.repeat(np.arange(1.0, 41.0), 3), 1e-3)
    variance = np.exp(law.log_variance(psi))
    t = np.linspace(0.0, 1.0, 4001)
    modes = np.cos(np.pi * t[:, None] * np.arange(1, 41))
    over_time = np.mean(modes**2, axis=0) @ variance[::3]
    assert np.sqrt(over_time) == pytest.approx(1e-3 * np.exp(psi[0]), rel=1e-3)


def test_slopes_of_the_process_law_agree_with_finite_differences():
    law = GaussianProcessLaw(np.repeat(np.arange(1.0, 21.0), 3), 1e-3, mean=0.5, spread=1.2)
    psi = np.array([0.2, 1.1])
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        ahead, behind = law.log_variance(psi + step), law.log_variance(psi - step)
        np.testing.assert_allclose(law.slope(psi)[:, k], (ahead - behind) / 2e-6, atol=1e-6)
        density = (law.log_prior(psi + step)[0] - law.log_prior(psi - step)[0]) / 2e-6
        assert law.log_prior(psi)[1][k] == pytest.approx(density, abs=1e-6)


def test_prior_of_an_ordinary_size_is_log_normal():
    law = ScaledLaw(np.ones(2), np.array([-20.0]), np.array([20.0]), mean=-1.0, spread=0.7)
    grid = np.linspace(-10.0, 10.0, 4001)
    density = np.exp([law.log_prior(np.array([x]))[0] for x in grid])
    assert np.sum(density) * (grid[1] - grid[0]) == pytest.approx(1.0, abs=1e-6)
    assert law.log_variance(np.array([-1.0]))[0] == pytest.approx(-2.0)


def test_harmonics_are_orthonormal_and_orthogonal_to_the_calibration():
    rng = np.random.default_rng(1)
    n = rng.normal(size=(200_000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    H = harmonics(0.5 * n)
    np.testing.assert_allclose(H.T @ H / len(n), np.eye(12), atol=0.03)
    np.testing.assert_allclose(H.T @ np.column_stack([np.ones(len(n)), n]) / len(n), 0.0, atol=0.02)


def test_rate_products_of_one_row():
    np.testing.assert_allclose(rate_products(np.array([[2.0, 3.0, 5.0]])), [[4, 9, 25, 6, 15, 10]])


def test_octaves_cover_all_cosine_frequencies():
    edges = noise_model.octave_edges(6000)
    assert edges[0] == 0
    assert edges[-1] == 6000
    assert len(edges) == priors.BANDS + 1
    assert np.all(edges[2:-1] * 2 <= edges[3:] + 1)


def test_gradient_of_the_noise_prior_agrees_with_finite_differences():
    x = np.array([0.3, -0.2, 0.9, 0.1])
    _, gradient = noise_model.log_prior(x, 0.6)
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        slope = (
            noise_model.log_prior(x + step, 0.6)[0] - noise_model.log_prior(x - step, 0.6)[0]
        ) / 2e-6
        assert gradient[k] == pytest.approx(slope, abs=1e-6)


def test_outliers_have_low_weight_and_normal_rows_equal_weights():
    rng = np.random.default_rng(2)
    residual = rng.normal(size=(2000, 3))
    used = np.ones(2000, dtype=bool)
    calm = noise_model.fit_noise_levels(residual, used, 10.0)
    assert np.ptp(np.log(calm.amplitude)) < 0.9  # due to the level only, a median of forty rows
    residual[500:2000:50] = 30.0
    weight = noise_model.fit_noise_levels(residual, used, 10.0).amplitude
    assert np.all(weight[500:2000:50] > 5.0)
    assert np.median(weight) == pytest.approx(1.0, abs=0.15)


def test_log_likelihood_of_weighted_rows_equals_that_of_the_student_distribution():
    """The tangent at the residual from which the weights were made, in units of its density."""
    rng = np.random.default_rng(5)
    scale = np.sqrt(rng.chisquare(3.0, size=4000) / 3.0)
    residual = rng.normal(size=(4000, 3)) / scale[:, None]
    loud = noise_model.fit_noise_levels(residual, np.ones(4000, dtype=bool), 20.0)
    rows = residual / loud.amplitude[:, None]
    nats = loud.tails - 0.5 * np.sum(rows**2) - 3.0 * np.sum(np.log(loud.amplitude))
    nats -= 1.5 * len(rows) * np.log(2 * np.pi)
    law = multivariate_t(np.zeros(3), np.eye(3), df=3.0)
    # a separate level every few seconds costs some nats
    assert nats == pytest.approx(law.logpdf(residual).sum(), abs=150.0)


def test_noise_level_follows_a_lasting_change_of_the_noise():
    rng = np.random.default_rng(3)
    residual = rng.normal(size=(4000, 3))
    residual[2500:] *= 4.0
    weight = noise_model.fit_noise_levels(residual, np.ones(4000, dtype=bool), 10.0).amplitude
    assert np.median(weight[3000:]) / np.median(weight[:2000]) == pytest.approx(4.0, rel=0.15)


def test_no_module_of_the_inference_names_an_effect():
    sources = sorted(Path(next(iter(inference.__path__))).rglob("*.py"))
    texts = {
        (path.name, node.value)
        for path in sources
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert len(sources) > 10
    assert {(name, text) for name, text in texts if text in EFFECTS} == set()


def test_library_marks_jumps_delays_and_ordinary_effects():
    jumps = {name: row.frame or row.family for name, row in EFFECTS.items() if row.jumps}
    assert jumps == {"hard_iron_step": "sensor", "field_step": "world", "gyro_bias_step": "gyro"}
    assert {name for name, row in EFFECTS.items() if row.recurs} - set(jumps) == {"soft_iron_step"}
    delays = {name: row.delay for name, row in EFFECTS.items() if row.delay}
    late = {"mag_time_lag": 1.0, "mag_low_pass": 1.0, "gyro_integration": 1.0}
    assert delays == {**late, "gyro_time_lag": -1.0}
    assert EFFECTS["field_anomaly"].ordinary == pytest.approx(8.8)
    assert [name for name, row in EFFECTS.items() if row.ordinary_part] == ["flexible_mount"]
