"""The figures by which methods are compared."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation import FIELD, HARD_IRON, UNIT_SOFT_IRON, clean

from ahrsd.methods import metrics


def positive(seed):
    G = np.random.default_rng(seed).normal(size=(3, 3))
    return G @ G.T + 0.2 * np.eye(3)


def test_norms():
    assert metrics.error_norm(np.array([3.0, 4.0, 0.0]), np.zeros(3)) == 5.0
    assert metrics.soft_iron_frobenius(2 * np.eye(3), np.eye(3)) == pytest.approx(np.sqrt(3))


def test_the_geodesic_distance_of_scaled_identities():
    assert metrics.soft_iron_geodesic(np.eye(3), np.e * np.eye(3)) == pytest.approx(np.sqrt(3))


@given(st.integers(0, 10**6))
def test_the_geodesic_distance_by_its_definition_and_invariance(seed):
    A, B, G = positive(seed), positive(seed + 1), positive(seed + 2)
    values, vectors = np.linalg.eigh(A)
    root = vectors @ np.diag(values**-0.5) @ vectors.T
    expected = np.linalg.norm(np.log(np.linalg.eigvalsh(root @ B @ root)))
    distance = metrics.soft_iron_geodesic(A, B)
    assert distance == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert metrics.soft_iron_geodesic(B, A) == pytest.approx(distance, rel=1e-6)
    assert metrics.soft_iron_geodesic(G @ A @ G.T, G @ B @ G.T) == pytest.approx(distance, rel=1e-5)


def test_no_distance_from_what_is_not_positive_definite():
    for pair in ((np.eye(3), -np.eye(3)), (-np.eye(3), np.eye(3))):
        with pytest.raises(ValueError, match="not positive definite"):
            metrics.soft_iron_geodesic(*pair)


def test_the_right_calibration_has_no_spread_and_no_heading_error():
    run = clean(n=3000)
    raw, R = run.data.raw_b_gauss, run.data.R_nb
    right = metrics.corrected(raw, UNIT_SOFT_IRON, HARD_IRON)
    assert np.allclose(right, run.field_b, atol=1e-14)
    assert metrics.field_spread(right) < 1e-14
    assert metrics.heading_rmse_deg(right, R, FIELD) < 1e-8
    assert metrics.field_spread(raw) > 0.1
    assert metrics.heading_rmse_deg(raw, R, FIELD) > 5


def test_spread_of_two_sizes():
    assert metrics.field_spread(np.array([[1.0, 0, 0], [0, 3.0, 0]])) == 0.5


def test_without_a_soft_iron_only_the_hard_iron_is_taken_away():
    raw = np.array([[1.0, 2.0, 3.0]])
    assert metrics.corrected(raw, None, np.array([1.0, 1.0, 1.0])).tolist() == [[0.0, 1.0, 2.0]]


def test_a_turned_field_turns_the_heading():
    R = np.eye(3)[None]
    east = np.radians(10.0)
    field = np.array([[np.cos(east), -np.sin(east), 0.5]])  # the sensor points 10 deg to the east
    assert np.degrees(metrics.heading_rad(field, R))[0] == pytest.approx(10.0)
    assert np.degrees(metrics.heading_rad(field, R, np.radians(3.0)))[0] == pytest.approx(13.0)
