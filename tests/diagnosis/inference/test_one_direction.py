"""Quick sources of one direction: what noise of a colour, which is alike on all axes, swallows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.inference.search.one_direction import as_loud_along, unalike


def test_what_is_alike_along_all_axes_has_no_direction():
    rng, most = np.random.default_rng(1), 0.0
    for _ in range(300):
        most = max(most, unalike(rng.normal(size=(60, 3)))[0])
    assert 5.0 < most < priors.UNALIKE


def test_the_direction_is_the_loudest():
    rng, axis = np.random.default_rng(2), np.array([0.6, -0.7, 0.39])
    axis /= np.linalg.norm(axis)
    rows = rng.normal(size=(120, 3)) + 2.0 * rng.normal(size=(120, 1)) * axis
    nats, direction = unalike(rows)
    assert abs(direction @ axis) > 0.98
    assert nats > 50.0
    powers = np.linalg.eigvalsh(rows.T @ rows / 120)
    assert nats == pytest.approx(60.0 * (3 * np.log(powers.mean()) - np.log(powers).sum()))


def test_noise_that_is_louder_along_the_field_has_no_direction():
    """Across the field a filter follows what is slow, and slow noise is left along it alone."""
    made_one = experiment("wam", seed=15, samples=4000)
    unit = made_one.field_b / np.linalg.norm(made_one.field_b, axis=1, keepdims=True)
    rng = np.random.default_rng(6)
    left = rng.normal(size=unit.shape) + 3.0 * rng.normal(size=(len(unit), 1)) * unit
    into_world = np.einsum("nij,nj->ni", made_one.R_nb, left)
    assert unalike(into_world[:200])[0] > 50.0
    even = as_loud_along(left, made_one.field_b, 200)
    assert unalike(np.einsum("nij,nj->ni", made_one.R_nb, even)[:200])[0] < priors.UNALIKE


def test_iron_on_a_joint_that_nobody_logged_is_unknown_on_the_sensor():
    track = track_of(experiment("wam", seed=14, samples=3500, sigma_mag=5e-4))
    rng, rate_hz = np.random.default_rng(5), 25.0
    angle = np.fft.rfft(rng.normal(size=len(track)))
    hertz = np.fft.rfftfreq(len(track), 1 / rate_hz)
    angle *= (hertz > 0.1) & (hertz < 0.4)  # it moves to and fro in some seconds
    angle = np.fft.irfft(angle, len(track))
    axis = np.array([0.6, -0.7, 0.39]) / np.linalg.norm([0.6, -0.7, 0.39])
    added = 7e-4 * (angle / angle.std())[:, None] * axis
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    left = found.unexplained
    assert left.detected
    assert left.where.frame == "sensor"
    assert abs(np.array(left.where.direction) @ axis) > 0.95
    assert left.evidence_nats > 30.0


@pytest.mark.filterwarnings("error")
def test_a_field_that_is_not_known_takes_nothing_from_a_residual():
    left = np.random.default_rng(7).normal(size=(400, 3))
    field_b = np.tile([0.2, 0.0, 0.4], (400, 1))
    field_b[5], field_b[6] = 0.0, np.inf
    even = as_loud_along(left, field_b, 50)
    np.testing.assert_allclose(even[5:7], left[5:7])
    assert not np.allclose(even[7], left[7])
