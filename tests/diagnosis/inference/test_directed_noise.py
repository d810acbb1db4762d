"""Noise with a higher level along one direction is a source, not coloured sensor noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import coloured, experiment, track_of

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.diagnose import build_and_fit_null, diagnose
from ahrsd.diagnosis.inference.likelihood.directed_noise import DirectedNoise, fit_directed_noise
from ahrsd.diagnosis.inference.likelihood.linearisation import initial_point, linearise
from ahrsd.diagnosis.track import Spec

AXIS = np.array([0.6, -0.7, 0.39]) / np.linalg.norm([0.6, -0.7, 0.39])
RATE_HZ = 25.0


def _field(rows: int) -> np.ndarray:
    return experiment("wam", seed=15, samples=rows).field_b


def test_noise_independent_between_axes_has_no_direction():
    """Red noise with different levels of the axes: none of 12 draws comes near the threshold of
    an unknown cause.
    """
    rng, most, field_b = np.random.default_rng(3), -np.inf, _field(3000)
    for _ in range(12):
        left = rng.normal(size=(3000, 3)) + coloured(rng, (3000, 3), (0.0, 1.0))
        left *= np.exp(rng.normal(size=3) * priors.AXES_DIFFER / 2)
        most = max(most, fit_directed_noise(left, field_b, RATE_HZ, 1.0).nats)
    assert most < priors.UNKNOWN_ODDS / 2


@pytest.mark.parametrize("band_hz", [(0.3, 1.2), (2.0, 6.0)])
def test_directed_source_is_found_with_direction_octaves_and_power(band_hz: tuple[float, float]):
    rng, level = np.random.default_rng(4), np.array([1.2, 1.0, 1 / 1.2])
    left = rng.normal(size=(6000, 3)) * level
    left += 0.5 * coloured(rng, (6000, 1), band_hz) * AXIS
    found = fit_directed_noise(left, _field(6000), RATE_HZ, 1.0)
    assert found.nats > 50.0
    assert abs(found.direction @ AXIS) > 0.98
    assert found.level == pytest.approx(level, rel=0.05)
    middle_hz = (found.edges_hz[1:] + found.edges_hz[:-1]) / 2
    cosines = np.diff(found.edges_hz) / found.edges_hz[-1]
    power = found.power(middle_hz, np.ones(len(middle_hz))) * cosines
    assert power.sum() == pytest.approx(0.25, rel=0.25)
    inside = (found.edges_hz[1:] > band_hz[0]) & (found.edges_hz[:-1] < band_hz[1])
    assert power[inside].sum() > 0.9 * power.sum()


def test_directed_power_is_recovered_from_a_fully_whitened_residual():
    """Coloured noise absorbs the source when effects of higher odds are in the model."""
    rng, band_hz = np.random.default_rng(7), (2.0, 6.0)
    left = rng.normal(size=(6000, 3)) + 2.0 * coloured(rng, (6000, 1), band_hz) * AXIS
    whole = float(np.mean(left**2))
    found = fit_directed_noise(left / np.sqrt(whole), _field(6000), RATE_HZ, 1.0)
    middle_hz = (found.edges_hz[1:] + found.edges_hz[:-1]) / 2
    cosines = np.diff(found.edges_hz) / found.edges_hz[-1]
    power = found.power(middle_hz, np.full(len(middle_hz), whole)) @ cosines
    assert power == pytest.approx(4.0, rel=0.1)


def test_gyro_noise_across_the_field_is_no_source():
    rng, field_b = np.random.default_rng(5), _field(4000)
    field_b = np.broadcast_to(field_b[0], field_b.shape)  # a vehicle that does not turn
    unit = field_b / np.linalg.norm(field_b, axis=1, keepdims=True)
    gyro = 2.0 * coloured(rng, (4000, 3), (0.0, 2.0))
    left = rng.normal(size=(4000, 3)) + gyro - np.sum(gyro * unit, axis=1, keepdims=True) * unit
    assert fit_directed_noise(left, field_b, RATE_HZ, 1.0).nats < priors.UNKNOWN_ODDS


def test_whitening_by_directed_noise_and_its_log_determinant():
    track = track_of(experiment("wam", seed=14, samples=2000, sigma_mag=5e-4))
    problem, start = build_and_fit_null(track, Spec())
    point = initial_point(problem, start.filtered, ())
    source = DirectedNoise(
        np.array([1.1, 1.0, 1 / 1.1]),
        AXIS,
        np.array([3.0, 0.5]),
        np.zeros(2),
        np.array([0.0, 1.0, 12.5]),
        99.0,
    )
    plain = linearise(point, point.context)
    made = linearise(replace(point, directed=source), point.context)
    count = int(made.edges[-1])
    middle_hz = (made.edges[1:] + made.edges[:-1]) / 2 * problem.rate_hz / (2 * count)
    share = np.repeat(np.where(middle_hz < 1.0, 3.0, 0.5), np.diff(made.edges))
    covariance = (
        np.diag(source.level)
        @ (np.eye(3) + share[:, None, None] * np.outer(AXIS, AXIS))
        @ np.diag(source.level)
    )
    y, before = made.y.reshape(-1, 3), plain.y.reshape(-1, 3)
    square = np.einsum("ni,nij,nj->n", before, np.linalg.inv(covariance), before)
    assert np.sum(y**2, axis=1) == pytest.approx(square, rel=1e-5)
    denser = -0.5 * np.sum(np.log1p(share)) * np.count_nonzero(point.filtered.used) / count
    assert made.log_whitening - plain.log_whitening == pytest.approx(denser, rel=1e-6)


@pytest.mark.slow
def test_fast_unlogged_current_is_unknown_along_its_direction():
    """It was once absorbed by coloured noise, and nothing was reported."""
    track = track_of(experiment("wam", seed=14, samples=4000, sigma_mag=5e-4))
    rng = np.random.default_rng(8)
    added = 4e-4 * coloured(rng, (len(track), 1), (0.8, 2.5)) * AXIS
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    left = found.unexplained
    assert left.detected
    assert left.where.frame == "sensor"
    assert abs(np.array(left.where.direction) @ AXIS) > 0.95
    low, high = left.where.band_hz
    assert low < 0.9
    assert high > 2.0
    assert left.size == pytest.approx(np.sqrt(2.0) * 4e-4, rel=0.3)


@pytest.mark.slow
def test_temporarily_stronger_source_is_not_taken_for_noise():
    track = track_of(experiment("wam", seed=14, samples=4000, sigma_mag=5e-4))
    rng = np.random.default_rng(8)
    louder = np.where(track.time_s > 90.0, 2.0, 0.8)
    added = 4e-4 * louder[:, None] * coloured(rng, (len(track), 1), (0.8, 8.0)) * AXIS
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    assert found.unexplained.detected
    assert abs(np.array(found.unexplained.where.direction) @ AXIS) > 0.95


@pytest.mark.slow
def test_iron_on_an_unlogged_joint_is_unknown_on_the_sensor():
    track = track_of(experiment("wam", seed=14, samples=3500, sigma_mag=5e-4))
    angle = coloured(
        np.random.default_rng(5), (len(track), 1), (0.1, 0.4)
    )  # it oscillates within seconds
    added = 7e-4 * angle * AXIS
    found = diagnose(replace(track, mag_b_gauss=track.mag_b_gauss + added))
    assert found.findings == ()
    left = found.unexplained
    assert left.detected
    assert left.where.frame == "sensor"
    assert abs(np.array(left.where.direction) @ AXIS) > 0.95
    assert left.evidence_nats > 30.0
