"""The figures by which calibrations are judged, compared with values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.montecarlo.accuracy import (
    MethodAnswer,
    expected_heading_deg,
    figures,
    geodesic,
    heading_rms_deg,
    nees,
    unit_volume,
)
from ahrsd.simulation import Iron, ScenarioSettings, simulate
from ahrsd.simulation.scenarios import measured

EXPERIMENT = simulate(ScenarioSettings("mam", samples=500))
TRUTH = EXPERIMENT.truth


def test_the_truth_has_no_error_whatever_its_volume():
    exact = MethodAnswer(7.0 * TRUTH.soft_iron, TRUTH.hard_iron_gauss, TRUTH.gyro_bias_rad_s)
    found = figures(exact, EXPERIMENT)
    for name in ("hard_iron_gauss", "soft_iron", "soft_iron_geodesic", "gyro_bias_rad_s"):
        assert found[name] == pytest.approx(0.0, abs=1e-12)
    assert found["heading_deg"] == pytest.approx(0.0, abs=1e-9)
    # exact parameters, 10 mG of noise: [R]'s noise floor is 2.54 deg
    assert found["heading_10mg_deg"] == pytest.approx(2.54, rel=0.15)
    assert found["nees"] is None


def test_errors_are_norms_of_differences():
    hard_iron = TRUTH.hard_iron_gauss + np.array([3e-3, 0.0, 4e-3])
    off = MethodAnswer(None, hard_iron, TRUTH.gyro_bias_rad_s + np.array([0.0, 2e-3, 0.0]))
    found = figures(off, EXPERIMENT)
    assert found["hard_iron_gauss"] == pytest.approx(5e-3)
    assert found["gyro_bias_rad_s"] == pytest.approx(2e-3)
    assert found["soft_iron"] is None
    assert found["heading_deg"] > 1.0  # without a soft iron the register gets the identity


def test_field_spread_and_constraint_error_of_a_hard_iron():
    """A hard iron of d too much leaves |h + d|, about |h| + u.d: its spread is that of u.d."""
    d = np.array([0.0, 1e-4, 0.0])
    made = EXPERIMENT
    off = MethodAnswer(TRUTH.soft_iron, TRUTH.hard_iron_gauss - TRUTH.soft_iron @ d, None)
    found = figures(off, made)
    along = (made.field_b[::5] / TRUTH.field_gauss) @ d
    assert found["field_spread"] == pytest.approx(np.std(along) / TRUTH.field_gauss, rel=2e-3)
    assert found["constraint_gauss"] == pytest.approx(np.sqrt(np.mean(along**2)), rel=2e-3)


def test_geodesic_is_affine_invariant():
    A, B = np.diag([2.0, 1.0, 0.5]), np.eye(3)
    assert geodesic(A, B) == pytest.approx(np.sqrt(2) * np.log(2))
    P = np.array([[1.0, 0.3, 0.0], [0.0, 2.0, 0.5], [0.2, 0.0, 0.7]])
    assert geodesic(P @ A @ P.T, P @ B @ P.T) == pytest.approx(geodesic(A, B))
    assert geodesic(B, A) == pytest.approx(geodesic(A, B))


def test_hard_iron_across_the_field_rotates_the_level_heading_by_its_angle():
    """A level sensor without soft iron that turns once; b along x of 5 % of the level field."""
    n = 3600
    heading = np.linspace(0, 2 * np.pi, n, endpoint=False)
    R = so3.from_yaw_pitch_roll(heading, np.zeros(n), np.zeros(n))
    iron = Iron(
        soft_iron=np.eye(3),
        pseudo_hard_iron_gauss=np.array([0.01, 0.0, 0.0]),
        field_n_gauss=np.array([0.2, 0.0, 0.4]),
    )
    rng = np.random.default_rng(0)
    made = measured("turn", iron, R, np.ones((n, 3)), np.arange(n) / 25, (0.0, 0.0), (rng, rng))
    error = heading_rms_deg(made, np.eye(3), np.zeros(3))
    assert error == pytest.approx(np.degrees(0.05) / np.sqrt(2), rel=2e-3)


@pytest.mark.parametrize("noise_gauss", [0.0, 2e-3])
def test_expected_heading_error_equals_that_of_draws_from_the_covariance(noise_gauss):
    made = simulate(ScenarioSettings("mam", "rov", samples=5000))
    draws = 1e-4 * np.random.default_rng(3).standard_normal((40, 12))
    errors = []
    for draw in draws:
        A = np.zeros((3, 3))
        A[np.triu_indices(3)] = draw[:6]
        A = TRUTH.soft_iron + A + np.triu(A, 1).T
        b = TRUTH.hard_iron_gauss + draw[6:9]
        errors.append(heading_rms_deg(made, A, b, noise_gauss))
    drawn = np.sqrt(np.mean(np.square(errors)))
    found = expected_heading_deg(made, draws.T @ draws / len(draws), noise_gauss)
    assert found == pytest.approx(drawn, rel=0.02)


def test_each_experiment_has_its_own_noise_on_headings():
    def floor(seed):
        made = simulate(ScenarioSettings("mam", seed=seed, samples=500))
        return heading_rms_deg(made, TRUTH.soft_iron, TRUTH.hard_iron_gauss, 0.01)

    assert floor(1) == floor(1)
    assert floor(1) != floor(2)


def test_nees_of_draws_from_the_covariance_is_one():
    rng = np.random.default_rng(0)
    A = TRUTH.soft_iron
    gradient = np.zeros(12)
    gradient[:6] = (np.linalg.inv(A) * (2 - np.eye(3)))[np.triu_indices(3)]
    root = rng.standard_normal((12, 12)) * np.logspace(-6, -1, 12)[:, None]
    keep = np.eye(12) - np.outer(gradient, gradient) / (gradient @ gradient)
    root = keep @ root  # singular along det A, as an estimate's covariance is
    covariance = root @ root.T
    draws = [nees(root @ rng.standard_normal(12), covariance, A) for _ in range(2000)]
    assert np.mean(draws) == pytest.approx(1.0, abs=0.03)
    assert np.var(draws) == pytest.approx(2 / 11, rel=0.15)
    assert nees(root @ np.ones(12), covariance / 4, A) == pytest.approx(
        4 * nees(root @ np.ones(12), covariance, A)
    )


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (MethodAnswer(-np.eye(3), np.zeros(3), np.zeros(3)), "determinant -1 cannot"),
        (MethodAnswer(np.full((3, 3), np.nan), np.zeros(3), None), "soft iron is not finite"),
        (MethodAnswer(np.diag([-1.0, -1.0, 1.0]), np.zeros(3), None), "not positive definite"),
        (MethodAnswer(None, np.array([np.nan, 0, 0]), None), "hard_iron_gauss is not finite"),
    ],
)
def test_invalid_calibration_is_refused(answer, message):
    with pytest.raises(ValueError, match=message):
        figures(answer, EXPERIMENT)


def test_unit_volume():
    assert unit_volume(np.diag([8.0, 1.0, 1.0])) == pytest.approx(np.diag([4.0, 0.5, 0.5]))
