"""The context: attitude, field, rates and force compared with the simulation's truth."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracks import experiment, track_of, true_model

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit
from ahrsd.diagnosis.innovation_filter.context import (
    bandwidth_hz,
    build_context,
    denoised_force,
    rate_without_own_row,
    smoothed_rate,
)
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.model import Context
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array
from ahrsd.simulation import Experiment

RATE_HZ = 50.0


def _context(track: Track, made: Experiment) -> Context:
    filtered = run_filter(track, true_model(made))
    empty = np.zeros((11, 11))
    return build_context(
        track, NullFit(filtered.model, filtered, True, empty, np.ones(11, dtype=bool))
    )


def _apart_deg(R: Array, truth: Array) -> Array:
    """Angles in degrees between attitudes, up to one constant rotation of the world."""
    offset = R @ np.swapaxes(truth, 1, 2)
    mean = Rotation.from_matrix(offset).mean().as_matrix()
    return np.asarray(np.degrees(np.linalg.norm(so3.log(np.swapaxes(offset, 1, 2) @ mean), axis=1)))


def test_attitude_is_levelled_and_does_not_drift() -> None:
    """The accelerometer levels it and the field fixes it, at 5 mrad/s of gyro noise."""
    made = experiment("wam", samples=6000, sigma_gyro=5e-3)
    context = _context(track_of(made), made)
    assert context.world_levelled
    down = np.einsum("nij,nj->ni", context.R_nb, made.R_nb[:, 2, :])
    assert np.degrees(np.arccos(np.clip(down[:, 2], -1, 1))).max() < 1.0
    assert _apart_deg(context.R_nb, made.R_nb).max() < 1.5
    assert np.abs(np.linalg.det(context.R_nb) - 1).max() < 1e-9


def test_field_is_constant_in_the_world_frame_without_an_accelerometer() -> None:
    made = experiment("wam", samples=6000, sigma_gyro=5e-3)
    context = _context(replace(track_of(made), accel_b_m_s2=None), made)
    assert not context.world_levelled
    field = np.einsum("nij,nj->ni", context.R_nb, made.field_b)
    assert np.degrees(np.linalg.norm(field - field[0], axis=1) / np.linalg.norm(field[0])).max() < 1
    assert _apart_deg(context.R_nb, made.R_nb).max() < 12  # it may drift about the field


def test_context_ignores_a_reference_attitude() -> None:
    """The filter turns its field by the gyro, so a field of the world has to turn by the gyro as
    well.
    """
    made = experiment("wam", samples=600, sigma_gyro=5e-3)
    q = Rotation.from_matrix(made.R_nb).as_quat(scalar_first=True)
    names = ("ref_qw", "ref_qx", "ref_qy", "ref_qz")
    plain = track_of(made)
    context = _context(replace(plain, covariates=dict(zip(names, q.T, strict=True))), made)
    np.testing.assert_array_equal(context.R_nb, _context(plain, made).R_nb)


@pytest.mark.parametrize("motion", ["slow", "rov"])
def test_rates_are_smoothed_but_not_delayed(motion: str) -> None:
    made = experiment("mam", motion=motion, samples=4000, sigma_gyro=5e-3)
    context = _context(track_of(made), made)
    inner = slice(50, -50)
    error = (context.rate_b_rad_s - made.rate_b_rad_s)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.35 * 5e-3
    # a delay of d would give an error of d * dw/dt
    slope = np.gradient(made.rate_b_rad_s, 0.04, axis=0)[inner]
    delay_s = float(np.sum(error * slope) / np.sum(slope**2))
    assert abs(delay_s) < 0.03 if motion == "slow" else abs(delay_s) < 0.004
    truth = np.gradient(made.field_b, 0.04, axis=0)[inner] * np.trace(made.truth.soft_iron) / 3
    off = context.field_dot_b[inner] - truth
    assert np.sqrt(np.mean(off**2)) < 0.35 * 5e-3 * 0.5


def test_fast_motion_keeps_its_bandwidth() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(4000) / 100.0
    clean = np.column_stack([3 * np.sin(2 * np.pi * 5 * t), np.cos(2 * np.pi * 3 * t), 0 * t])
    noisy = clean + 0.01 * rng.standard_normal(clean.shape)
    runs = (slice(0, 4000),)
    assert bandwidth_hz(noisy, runs, 0.01, 0.01) > 8
    smooth = smoothed_rate(noisy, runs, 0.01, 0.01)
    assert np.abs(smooth - clean)[100:-100].max() < 0.06
    slow = clean * 0 + 0.01 * rng.standard_normal(clean.shape)
    assert bandwidth_hz(slow, runs, 0.01, 0.01) == 0.5


def test_slow_motion_is_smoothed_over_a_long_time() -> None:
    """One turn takes minutes at 5 mrad/s of noise: the slope over a second would be mostly
    noise.
    """
    rng = np.random.default_rng(5)
    t = np.arange(10_000) / 25.0
    clean = 0.08 * np.cos(2 * np.pi * np.outer(t, [8e-3, 6e-3, 5e-3]))
    noisy = clean + 5e-3 * rng.standard_normal(clean.shape)
    runs = (slice(0, 10_000),)
    assert bandwidth_hz(noisy, runs, 0.04, 5e-3) < 0.25
    error = (smoothed_rate(noisy, runs, 0.04, 5e-3) - clean)[250:-250]
    assert np.sqrt(np.mean(error**2)) < 0.2 * 5e-3
    slope = np.gradient(clean, 0.04, axis=0)[250:-250]
    assert np.std(np.gradient(error, 0.04, axis=0)) < 0.5 * np.std(slope)
    briefly = noisy + 0.05 * np.sin(2 * np.pi * 3 * t)[:, None] * (t % 100 < 20)[:, None]
    assert bandwidth_hz(briefly, runs, 0.04, 5e-3) > 5.0


def test_constant_rate_is_smoothed_to_its_mean() -> None:
    """Columns made of the gyro's noise would correlate with what that noise did to the field."""
    rng = np.random.default_rng(1)
    t = np.arange(40_000) / 100.0
    slowly = 0.01 * np.sin(2 * np.pi * t / 200)  # far slower than a segment of four seconds
    clean = np.column_stack([0.2 + 0 * t, 0.1 * np.sin(2 * np.pi * 0.5 * t), slowly])
    noisy = clean + 0.005 * rng.standard_normal(clean.shape)
    smooth = smoothed_rate(noisy, (slice(0, 20_000), slice(20_000, 40_000)), 0.01, 0.005)
    np.testing.assert_array_equal(smooth[:, 0], noisy[:, 0].mean())
    assert np.corrcoef(smooth[:, 1], clean[:, 1])[0, 1] > 0.99
    assert np.corrcoef(smooth[:, 2], slowly)[0, 1] > 0.97


def test_noise_has_no_bandwidth_when_all_runs_are_short() -> None:
    """With a hundred lost rows, the spectrum of the longest run alone exceeded any floor by
    chance.
    """
    rng = np.random.default_rng(4)
    edges = np.unique(np.concatenate([[0, 3200], rng.integers(0, 3200, 110)]))
    runs = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    assert 64 < max(run.stop - run.start for run in runs) < 320
    still = 2e-3 * rng.standard_normal((3200, 3))
    assert bandwidth_hz(still, runs, 0.1, 2e-3) == 0.5
    shaken = still + 4e-2 * np.sin(2 * np.pi * 2.1 * 0.1 * np.arange(3200))[:, None]
    assert bandwidth_hz(shaken, runs, 0.1, 2e-3) >= 4.2


def test_predicted_field_has_no_noise_of_its_own_reading() -> None:
    """With a poor gyro a large part of the smoothed field is the reading itself."""
    made = experiment("mam", samples=3000, sigma_gyro=2e-2, sigma_mag=4e-4)
    track, row = track_of(made), 1500
    noisy = track.mag_b_gauss.copy()
    noisy[row] += [1e-3, 0.0, 0.0]
    before, after = (
        _context(replace(track, mag_b_gauss=m), made) for m in (track.mag_b_gauss, noisy)
    )
    foretold, smooth = after.field_b - before.field_b, after.smooth_b - before.smooth_b
    assert np.abs(foretold[: row + 1]).max() < 1e-6  # through the gains only
    assert np.linalg.norm(foretold[row + 1]) > 1e-4
    assert np.linalg.norm(smooth[row]) > 5e-5
    np.testing.assert_allclose(
        after.field_b[0], after.smooth_b[0], atol=4e-4
    )  # the first row of the run


def test_column_of_rates_has_no_noise_of_its_own_row() -> None:
    """It would correlate with what that noise did to the field, and look like a scale error."""
    draw = np.random.default_rng(4)
    t = np.arange(200_000) / 25.0
    clean = 0.1 * np.cos(2 * np.pi * np.outer(t, [0.03, 0.05, 0.04]))
    noise = 0.05 * draw.standard_normal(clean.shape)
    runs = (slice(0, len(t)),)
    smooth = smoothed_rate(clean + noise, runs, 0.04, 0.05)
    own = np.sum(smooth * noise, axis=0) / np.sum(clean**2, axis=0)
    assert np.all(own > 6e-3)  # sigma of each: 0.05 / 0.07 / sqrt(N) = 1.6e-3
    width = 1.0 / (2 * np.pi * bandwidth_hz(clean + noise, runs, 0.04, 0.05) * 0.04)
    others = rate_without_own_row(clean + noise, smooth, width)
    share = np.sum(others * noise, axis=0) / np.sum(clean**2, axis=0)
    np.testing.assert_allclose(share, 0.0, atol=5e-3)
    inner = slice(250, -250)
    assert np.std((others - clean)[inner]) < 0.3 * 0.05


def test_axis_without_rotation_keeps_its_mean() -> None:
    """Its smoothed rate has no part of a single row. Removing one would add that row's noise."""
    draw = np.random.default_rng(6)
    t = np.arange(5000) / 25.0
    clean = np.column_stack([np.full(len(t), 0.02), 0.2 * np.cos(0.3 * t), 0.2 * np.sin(0.2 * t)])
    rate = clean + 0.02 * draw.standard_normal(clean.shape)
    runs = (slice(0, len(t)),)
    smooth = smoothed_rate(rate, runs, 0.04, 0.02)
    assert np.ptp(smooth[:, 0]) == 0.0
    width = 1.0 / (2 * np.pi * bandwidth_hz(rate, runs, 0.04, 0.02) * 0.04)
    others = rate_without_own_row(rate, smooth, width)
    np.testing.assert_array_equal(others[:, 0], smooth[:, 0])
    assert np.all(np.std(others - smooth, axis=0)[1:] > 0.0)


def test_rates_without_smoothing_are_unchanged() -> None:
    rate = np.random.default_rng(1).standard_normal((100, 3))
    assert rate_without_own_row(rate, rate, 1.0) is rate


def swaying(count: int = 8000) -> np.ndarray:
    t = np.arange(count) / RATE_HZ
    x = 1.8 * np.sin(2 * np.pi * 0.11 * t + 0.3) + 0.3 * np.sin(2 * np.pi * 0.37 * t)
    return np.column_stack([x, 0.4 * np.cos(2 * np.pi * 0.07 * t), -9.8 + 0.2 * np.sin(t)])


def test_slow_force_is_kept_and_its_noise_is_removed() -> None:
    force = swaying()
    noise = 0.2 * np.random.default_rng(1).standard_normal(force.shape)
    found = denoised_force(force + noise, [slice(0, len(force))])
    assert np.sqrt(np.mean((found - force) ** 2)) < 0.25 * 0.2
    # the force itself is not reduced (the third axis sways no more than the noise)
    along = np.sum((found - found.mean(0)) * (force - force.mean(0)), axis=0)
    np.testing.assert_allclose(along / np.sum((found - found.mean(0)) ** 2, axis=0), 1.0, atol=0.03)


def test_force_is_constant_at_rest() -> None:
    noise = 0.2 * np.random.default_rng(2).standard_normal((4000, 3))
    found = denoised_force(np.array([0.1, -0.2, -9.8]) + noise, [slice(0, 4000)])
    assert found.std(axis=0).max() < 0.01


def test_runs_are_smoothed_separately_and_short_or_incomplete_ones_are_unchanged() -> None:
    force = swaying(600)
    force[400:] += 50.0
    runs = [slice(0, 400), slice(400, 450), slice(450, 600)]
    force[500, 1] = np.nan
    found = denoised_force(force, runs)
    np.testing.assert_array_equal(found[400:], force[400:])
    np.testing.assert_allclose(found[:400], force[:400], atol=0.02)
