"""Quadrics: which are ellipsoids, and the sign of the soft iron."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulation import HARD_IRON, UNIT_SOFT_IRON, clean, simulate

from ahrsd.baselines import MethodError, MethodSettings, run
from ahrsd.baselines.attitude_independent import refuse_other_quadrics

SIGNS = [np.array([x, y, z]) for x in (1, -1) for y in (1, -1) for z in (1, -1)]


@pytest.mark.parametrize("constraint", ["trace", "fang"])
@pytest.mark.parametrize("signs", SIGNS, ids=str)
def test_flipped_axes_give_the_flipped_soft_iron(signs, constraint):
    data = clean().data
    flipped = replace(data, raw_b_gauss=data.raw_b_gauss * signs)
    result = run("ellipsoid", flipped, MethodSettings(ellipsoid_constraint=constraint))
    assert np.allclose(result.soft_iron, UNIT_SOFT_IRON * np.outer(signs, signs), atol=1e-10)
    assert np.allclose(result.hard_iron_gauss, HARD_IRON * signs, atol=1e-11)
    assert np.linalg.eigvalsh(result.soft_iron)[0] > 0
    assert np.linalg.det(result.soft_iron) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("diagonal", "d", "words"),
    [
        ([1, 1, 0], -1, "a cylinder"),
        ([1, 1, 1], 0, "a cone"),
        ([1, 1, -1], -1, "a hyperboloid"),
        ([1, 1, 1], 1, "no real ellipsoid"),
    ],
)
def test_the_four_conditions(diagonal, d, words):
    for sign in (1.0, -1.0):
        with pytest.raises(MethodError, match=words):
            refuse_other_quadrics(sign * np.diag(np.float64(diagonal)), np.zeros(3), sign * d)


def test_an_ellipsoid_passes_at_either_sign():
    Q, n = np.diag([1.0, 2.0, 0.5]), np.array([0.1, -0.2, 0.3])
    refuse_other_quadrics(Q, n, -1.0)
    refuse_other_quadrics(-Q, -n, 1.0)


def test_a_hyperboloid_of_readings_is_refused():
    rng = np.random.default_rng(2)
    t, s = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(-1, 1, 2000)
    raw = 0.3 * np.column_stack([np.cosh(s) * np.cos(t), np.cosh(s) * np.sin(t), np.sinh(s)])
    data = replace(simulate("wam", n=2000).data, raw_b_gauss=raw)
    result = run("ellipsoid", data, MethodSettings(sigma_mag_gauss=1e-6))
    assert not result.converged
    assert "a hyperboloid" in result.reason


def test_fangs_own_constraint_is_far_better_where_z_varies_little():
    found = {"trace": [], "fang": []}
    for seed in range(4):
        data = simulate("lam", seed).data
        for constraint, errors in found.items():
            result = run("ellipsoid", data, MethodSettings(ellipsoid_constraint=constraint))
            errors.append(1e3 * np.linalg.norm(result.hard_iron_gauss - HARD_IRON))
    assert np.mean(found["fang"]) < 70
    assert np.mean(found["trace"]) > 150
