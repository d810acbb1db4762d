"""The epoch as a factor: its error is the negative log likelihood, and its derivatives are
correct.
"""

from __future__ import annotations

import importlib.util
import sys
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, U
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ahrsd.estimator.epoch_factor import (
    Epoch,
    EpochKeys,
    Noise,
    Point,
    epoch_factor,
    summarise,
)
from ahrsd.montecarlo.cramer_rao import TRIANGLE, Trajectory, cramer_rao
from ahrsd.simulation import ScenarioSettings, simulate

EXAMPLE = Path(__file__).parents[2] / "docs" / "guide" / "examples" / "smoothing_with_epochs.py"
NOISE = Noise(1e-3, 5e-3)
APART, JOINED = EpochKeys(C(0), B(0)), EpochKeys(C(0), B(0), U(0), U(1))


def made(seed=0, rows=30, scenario="mam"):
    """A short, fast experiment at 5 Hz, so that the direction turns visibly between readings."""
    return simulate(ScenarioSettings(scenario, "rov", seed=seed, samples=rows, rate_hz=5.0))


def part(experiment, rows, **options):
    s = experiment.samples
    return Epoch.of(s.raw_b_gauss[rows], s.gyro_b_rad_s[rows], s.dt_s[rows], NOISE, **options)


def calibration(truth):
    M = truth.soft_iron * truth.field_gauss
    return np.r_[[M[entry] for entry in TRIANGLE], truth.hard_iron_gauss]


def near_truth(experiment, joined, size, seed=0, last=-1):
    """The true values, with an error of `size` standard scales."""
    rng, truth = np.random.default_rng(seed), experiment.truth
    c = calibration(truth) + size * rng.standard_normal(9)
    bias = truth.gyro_bias_rad_s + size * rng.standard_normal(3)
    if not joined:
        return Point(c, bias)
    ends = experiment.field_b[[0, last]] + size * rng.standard_normal((2, 3))
    first, end = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    return Point(c, bias, first, end)


def likelihood(experiment, point):
    """Negative log likelihood by a SciPy search over all directions, sharing no code with the
    project.

    Directions are free vectors that are normalised, and the gyro's residual is a cross product.
    """
    s, c = experiment.samples, point.calibration
    M = np.zeros((3, 3))
    for value, (i, j) in zip(c[:6], TRIANGLE, strict=True):
        M[i, j] = M[j, i] = value
    dt = s.dt_s[1:, None]
    turns = Rotation.from_rotvec(-(s.gyro_b_rad_s[1:] - point.gyro_bias_rad_s) * dt)

    def residuals(free):
        v = free.reshape(-1, 3)
        u = v / np.linalg.norm(v, axis=1, keepdims=True)
        if point.first is not None:
            u[0], u[-1] = point.first, point.last
        field = (s.raw_b_gauss - u @ M.T - c[6:]) / NOISE.mag_gauss
        motion = np.cross(turns.apply(u[:-1]), u[1:]) / (NOISE.gyro_rad_s * dt)
        return np.concatenate([field.ravel(), motion.ravel()])

    start = np.linalg.solve(M, (s.raw_b_gauss - c[6:]).T).T
    found = least_squares(residuals, start.ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-12)
    return found.cost


@pytest.mark.parametrize("keys", [APART, JOINED], ids=["apart", "joined"])
@pytest.mark.parametrize("size", [1e-4, 5e-3])
def test_error_of_the_factor_is_the_negative_log_likelihood(keys, size):
    experiment = made()
    point = near_truth(experiment, keys.first is not None, size)
    factor = epoch_factor(part(experiment, slice(None)), keys)
    direct = likelihood(experiment, point)
    assert factor.error(point.values(keys)) == pytest.approx(direct, rel=2e-5)
    summary = summarise(part(experiment, slice(None)), point)
    assert summary.cost == pytest.approx(direct, rel=2e-5)
    assert summary.factor(keys).error(point.values(keys)) == pytest.approx(summary.cost)


def moved(values, keys, delta):
    steps, at = gtsam.VectorValues(), 0
    for key, width in zip(keys.listed, (9, 3, 2, 2)):
        steps.insert(key, delta[at : at + width])
        at += width
    return values.retract(steps)


def gradient(linear, keys):
    """Gradient of a Gaussian factor in the order of the keys: at zero it is minus A^T b."""
    found = gtsam.GaussianFactorGraph()
    found.push_back(linear)
    at_zero = found.gradientAtZero()
    return np.concatenate([at_zero.at(key) for key in keys.listed])


@pytest.mark.parametrize("keys", [APART, JOINED], ids=["apart", "joined"])
@pytest.mark.parametrize("size", [1e-4, 3e-3])
def test_jacobian_agrees_with_numeric_differences(keys, size):
    experiment = made()
    values = near_truth(experiment, keys.first is not None, size).values(keys)
    factor = epoch_factor(part(experiment, slice(None)), keys)
    analytic = gradient(factor.linearize(values), keys)
    numeric = np.empty(len(analytic))
    for k in range(len(analytic)):
        step = np.zeros(len(analytic))
        step[k] = 1e-6
        ends = [factor.error(moved(values, keys, sign * step)) for sign in (1, -1)]
        numeric[k] = (ends[0] - ends[1]) / 2e-6
    scale = np.sqrt(
        np.diag(summarise(part(experiment, slice(None)), Point.of(values, keys)).information)
    )
    assert np.max(np.abs(analytic - numeric) / scale) < 1e-3 * max(
        1.0, np.max(np.abs(analytic) / scale)
    )


@pytest.mark.parametrize("keys", [APART, JOINED], ids=["apart", "joined"])
def test_summary_equals_the_factor_to_second_order(keys):
    experiment = made()
    epoch = part(experiment, slice(None))
    point = near_truth(experiment, keys.first is not None, 1e-4)
    summary, factor = summarise(epoch, point), epoch_factor(epoch, keys)
    frozen = summary.factor(keys)
    rng = np.random.default_rng(1)
    scale = 1 / np.sqrt(np.diag(summary.information))
    for _ in range(5):
        delta = 0.3 * scale * rng.standard_normal(len(scale))
        there = moved(point.values(keys), keys, delta)
        rise = factor.error(there) - summary.cost
        assert frozen.error(there) - summary.cost == pytest.approx(rise, abs=0.02)


def test_information_at_the_truth_is_the_fisher_matrix():
    """The inverse is the Cramer-Rao bound, which is computed by separate code."""
    experiment = simulate(ScenarioSettings("wam", "rov", seed=3, samples=2000, rate_hz=5.0))
    truth = experiment.truth
    u = experiment.field_b / truth.field_gauss
    summary = summarise(
        part(experiment, slice(None)), Point(calibration(truth), truth.gyro_bias_rad_s), u
    )
    covariance = np.linalg.inv(summary.information)
    bound = cramer_rao(
        Trajectory(experiment.field_b, experiment.rate_b_rad_s, experiment.samples.dt_s),
        truth.soft_iron,
        NOISE.mag_gauss,
        NOISE.gyro_rad_s,
    )
    assert np.sqrt(np.trace(covariance[6:9, 6:9])) == pytest.approx(bound.hard_iron_gauss, rel=0.02)
    assert np.sqrt(np.trace(covariance[9:, 9:])) == pytest.approx(bound.gyro_bias_rad_s, rel=0.02)


def test_joined_epochs_equal_one_long_epoch():
    experiment = made(rows=60)
    truth = experiment.truth
    start = calibration(truth)
    u = experiment.field_b / truth.field_gauss

    def solved(cuts):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(C(0), start)
        values.insert(B(0), truth.gyro_bias_rad_s)
        for k, (begin, end) in enumerate(pairwise(cuts)):
            epoch = part(experiment, slice(begin, end + 1), follows=k > 0)
            graph.add(epoch_factor(epoch, EpochKeys(C(0), B(0), U(k), U(k + 1))))
        for k, cut in enumerate(cuts):
            values.insert(U(k), gtsam.Unit3(u[cut]))
        sigma = gtsam.noiseModel.Diagonal.Sigmas(np.r_[np.full(6, 0.1), np.full(3, 0.1)])
        graph.addPriorVector(C(0), start, sigma)
        graph.addPriorVector(B(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.05))
        best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return graph.error(best), best.atVector(C(0)), gtsam.Marginals(graph, best)

    (error, c, whole), (error_3, c_3, parts) = solved([0, 59]), solved([0, 20, 40, 59])
    assert error_3 == pytest.approx(error, rel=1e-6)
    P, P_3 = (np.array(m.marginalCovariance(C(0))) for m in (whole, parts))
    sigma = np.sqrt(np.diag(P))
    assert np.max(np.abs(c - c_3) / sigma) < 0.01
    assert np.sqrt(np.diag(P_3)) == pytest.approx(sigma, rel=0.01)


def test_error_is_infinite_for_an_impossible_calibration():
    factor = epoch_factor(part(made(), slice(None)), APART)
    values = Point(np.zeros(9), np.zeros(3)).values(APART)
    assert factor.error(values) == np.inf
    with pytest.raises(ValueError, match="not positive definite"):
        factor.linearize(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"field": np.nan}, "field_b_gauss of row 2 cannot be used"),
        ({"gyro": np.inf}, "gyro_b_rad_s of row 2 cannot be used"),
        ({"dt": 0.0}, "dt_s of row 2 cannot be used"),
        ({"dt": -0.1}, "dt_s of row 2 cannot be used"),
        ({"noise": Noise(0.0, 5e-3)}, "noise must be a positive number"),
        ({"rows": 3}, "3 readings: an epoch has at least 4"),
    ],
)
def test_error_names_the_bad_reading(change, message):
    rows = change.get("rows", 10)
    field, gyro, dt = np.ones((rows, 3)), np.zeros((rows, 3)), np.full(rows, 0.1)
    for array, name in ((field, "field"), (gyro, "gyro"), (dt, "dt")):
        if name in change:
            array[2] = change[name]
    with pytest.raises(ValueError, match=message):
        Epoch.of(field, gyro, dt, change.get("noise", NOISE))


def test_border_directions_are_variables_at_both_ends_or_at_neither():
    with pytest.raises(ValueError, match="at both ends or at neither"):
        EpochKeys(C(0), B(0), U(0))
    summary = summarise(part(made(), slice(None)), near_truth(made(), False, 1e-4))
    with pytest.raises(ValueError, match="differ in whether directions are variables"):
        summary.factor(JOINED)


def test_example_recovers_calibration_map_and_attitude(capsys):
    spec = importlib.util.spec_from_file_location("smoothing_with_epochs", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = example
    spec.loader.exec_module(example)
    experiment = simulate(ScenarioSettings("wam", "rov", seed=1, samples=3100))
    result = example.smooth(experiment)
    truth, c = experiment.truth, result.values.atVector(C(0))
    error = c[6:] - truth.hard_iron_gauss
    assert np.linalg.norm(error) < 0.5e-3
    assert error @ np.linalg.solve(result.covariance[6:, 6:], error) / 3 < 4.0
    assert np.max(np.abs(example.soft_iron(c) - truth.soft_iron)) < 2e-3
    assert np.max(np.abs(result.last_bias - truth.gyro_bias_rad_s)) < 0.6e-3
    assert np.linalg.norm(result.again[6:] - c[6:]) < 0.01e-3
    sensor, graph = result.attitude_error_deg
    assert graph < 0.9 * sensor
    n = experiment.R_nb[0] @ experiment.field_b[0]
    dip = np.degrees(np.arcsin(n[2] / np.linalg.norm(n)))
    found = example.declination_dip_deg(
        np.array(result.values.atUnit3(gtsam.symbol("n", 0)).point3())
    )
    assert found[1] == pytest.approx(dip, abs=1.5)
    assert "hard iron b, mG" in "\n".join(example.report(result, experiment))


def test_example_runs_as_a_program(capsys):
    spec = importlib.util.spec_from_file_location("smoothing_with_epochs", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = example
    spec.loader.exec_module(example)
    example.main(["--scenario", "mam", "--seconds", "60", "--seed", "2"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:4] == ["hard", "iron", "b,", "mG"]
    true, found = np.array(lines[1].split()[4:], float).reshape(2, 3)
    assert true == pytest.approx([37.6, 109.4, 113.0])
    assert np.linalg.norm(found - true) < 20.0
