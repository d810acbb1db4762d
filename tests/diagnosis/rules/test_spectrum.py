"""Noise with a spectrum in the world, measured and whitened out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import fft
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.descent import moved
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.regression import Base, base, without_known
from ahrsd.diagnosis.rules.reweighted import reweighted
from ahrsd.diagnosis.rules.search import State, at_model, formed_basis_of
from ahrsd.diagnosis.rules.spectrum import against, in_world, smooth_power, spectrum_of, transformed
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.diagnosis.values import Columns


def world(track: Track, field: np.ndarray) -> np.ndarray:
    """A field of the world (N, 3) in the sensor's axes."""
    context = fit_null(track, walk=False).context()
    return np.einsum("nji,nj->ni", context.R_nb, field)


def wave(track: Track, size: float) -> np.ndarray:
    """A field of the world that comes and goes every two seconds, in a band of frequencies."""
    rng = np.random.default_rng(4)
    frequency_hz = rng.uniform(0.45, 0.55, 40)
    phase = rng.uniform(0, 2 * np.pi, (40, 3))
    angle = 2 * np.pi * frequency_hz[:, None, None] * track.time_s[:, None] + phase[:, None]
    return size * np.sin(angle).sum(axis=0) / np.sqrt(20.0)


def made(size: float = 5e-3) -> Track:
    track = track_of(experiment("wam", motion="rov", samples=3000))
    return replace(track, mag_b_gauss=track.mag_b_gauss + world(track, wave(track, size)))


def basis_of(track: Track) -> Base:
    fit = fit_null(track, walk=False)
    return base(fit.context(), fit.filtered, [], 25.0)


def test_the_power_of_a_walk_and_a_level_is_found_at_every_frequency():
    count = 4000
    walk = 4.0 * np.sin(np.pi * np.maximum(np.arange(count), 0.5) / (2 * count)) ** 2
    true = np.stack([2e-4 / walk + 0.3, 2e-4 / walk + 0.3, 4.0 * walk + 0.1], axis=1)
    power = []
    for seed in range(20):
        noise = np.sqrt(true) * np.random.default_rng(seed).standard_normal((count, 3))
        power.append(smooth_power(noise, np.ones_like(noise)))
    ratio = np.mean(power, axis=0) / true
    np.testing.assert_allclose(ratio[30:], 1.0, atol=0.2)
    np.testing.assert_allclose(ratio[:30], 1.0, atol=0.6)


def test_what_the_filter_followed_is_put_back():
    """The world sees the calibrated readings, turned by the gyro alone, but for their mean."""
    basis = basis_of(made())
    seen = transformed(in_world(basis), basis.innovation[:, :, None])[:, :, 0]
    left = fft.idct(seen, type=2, axis=0, norm="ortho")
    done = basis.filtered
    field = (done.track.mag_b_gauss - done.model.hard_iron_gauss) @ np.linalg.inv(
        done.model.soft_iron
    )
    carried = np.einsum("nij,nj->ni", done.orientation, field)
    carried -= carried.mean(axis=0)
    turn, _ = np.linalg.qr(np.linalg.lstsq(carried, left, rcond=None)[0])
    turn *= np.sign(np.sum((carried @ turn) * left, axis=0))
    np.testing.assert_allclose(left, carried @ turn, atol=1e-4)
    assert np.std(left) > 5e-3


def test_a_gyro_error_that_adds_up_is_seen_beside_a_quick_remainder():
    basis = basis_of(made())
    late = np.where(basis.context.track.time_s > 60.0, 1e-3, 0.0)
    columns = basis.whitened([Columns(gyro=np.eye(3) * late[:, None, None])])[0]
    quiet = against(basis, spectrum_of(basis))
    own, _ = without_known(quiet, quiet.rest.whitened(columns))
    assert np.min(np.linalg.norm(own, axis=(0, 1))) > 20.0


def test_what_is_left_of_a_band_in_the_world_is_white_afterwards():
    basis = basis_of(made())
    quiet = against(basis, spectrum_of(basis))
    assert basis.colour > 4.0
    assert quiet.colour < 1.6
    assert np.mean(quiet.innovation**2) < 1.1


def test_a_candidate_is_worth_what_less_is_left_beside_it():
    track = made()
    lit = (np.floor(track.time_s / 7.0) % 2)[:, None]
    value = np.array([3e-3, -2e-3, 2e-3])
    gains = []
    for size in (0.0, 1.0):
        basis = basis_of(replace(track, mag_b_gauss=track.mag_b_gauss + size * lit * value))
        columns = basis.whitened([Columns(mag=np.eye(3) * lit[:, :, None])])[0]
        gains.append(spectrum_of(basis, columns).nats - spectrum_of(basis).nats)
    assert abs(gains[0]) < 8.0
    assert gains[1] > 60.0


def test_a_fit_against_the_spectrum_finds_the_calibration_that_a_white_one_misses():
    track = made(2e-2)
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    fit = fit_null(problem.track, problem.spec, cold, walk=False)
    off = moved(fit.model, np.array([0.0] * 5 + [5e-3, -5e-3, 5e-3] + [0.0] * 3))
    state = reweighted(State(problem, replace(fit, model=fit.model)))
    again = reweighted(State(problem, at_model(problem.track, off, ())))
    np.testing.assert_allclose(
        again.fit.model.hard_iron_gauss, state.fit.model.hard_iron_gauss, atol=2e-4
    )
    left = formed_basis_of(state)
    quiet = against(left, spectrum_of(left))
    Z = quiet.known.reshape(-1, quiet.known.shape[2])
    pulls = Z.T @ quiet.innovation.ravel() / np.linalg.norm(Z, axis=0)
    assert np.max(np.abs(pulls)) < 0.5
