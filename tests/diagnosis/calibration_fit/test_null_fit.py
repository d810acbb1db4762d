"""The null fit: truth within its standard deviations, noise found, and no divergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from tracks import experiment, recorded, track_of, true_model

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null, rate_at_rest
from ahrsd.diagnosis.calibration_fit.problem import build_problem
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.samples import Array
from ahrsd.simulation import ScenarioSettings, simulate


def _difference(fit: NullFit, truth: NullModel) -> Array:
    off = fit.model.soft_iron - truth.soft_iron
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    return np.concatenate(
        [
            soft,
            fit.model.hard_iron_gauss - truth.hard_iron_gauss,
            fit.model.gyro_bias_rad_s - truth.gyro_bias_rad_s,
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "motion", "sigma_gyro"), [("mam", "rov", 5e-4), ("wam", "slow", 5e-3)]
)
def test_cold_start_recovers_the_truth_within_its_covariance(
    scenario: str, motion: str, sigma_gyro: float
) -> None:
    squares = []
    for seed in range(2):
        made = experiment(scenario, motion=motion, seed=seed, samples=6000, sigma_gyro=sigma_gyro)
        fit = fit_null(track_of(made))
        off = _difference(fit, true_model(made))
        squares.append(float(off @ np.linalg.solve(fit.covariance, off)))
        assert fit.converged
        assert abs(fit.model.sigma_mag_gauss / 1e-3 - 1) < 0.04
        assert abs(fit.model.sigma_gyro_rad_s / sigma_gyro - 1) < 0.35
        assert fit.model.gyro_walk_rad_s_sqrt_s < priors.WALK_CAP_RAD_S_SQRT_S / 3
        assert abs(fit.filtered.normalised_innovation - 1) < 0.04
    assert 1e-3 < stats.chi2.sf(sum(squares), 22) < 1 - 1e-3


@pytest.mark.slow
def test_fit_leaves_a_local_minimum_when_motion_is_small() -> None:
    """With small angular motion each of three starts ended 0.26 gauss off, 208 nats above this
    minimum.
    """
    run = simulate(ScenarioSettings("lam", "slow", 9700, 10_000, 25.0, 1e-3, 5e-3))
    asked, cold = build_problem(track_of(run), Spec())
    fit = fit_null(asked.track, asked.spec, cold, walk=False)
    assert np.linalg.norm(fit.model.hard_iron_gauss - run.truth.hard_iron_gauss) < 0.03
    assert abs(fit.filtered.normalised_innovation - 1) < 0.01


@pytest.mark.parametrize("scenario", ["wam", "mam", "lam"])
def test_calibration_is_recovered_when_the_gyro_is_noisier_than_the_magnetometer(
    scenario: str,
) -> None:
    """Only the size of the field locates the iron; Gauss-Newton steps from a sphere ended 0.1 gauss
    off.
    """
    made = experiment(
        scenario, motion="slow", seed=0, samples=8000, sigma_mag=1e-4, sigma_gyro=0.05
    )
    fit = fit_null(track_of(made))
    off = _difference(fit, true_model(made))
    assert np.abs(off[:8]).max() < (0.01 if scenario == "lam" else 3e-4)
    assert abs(fit.model.sigma_mag_gauss / 1e-4 - 1) < 0.06
    assert abs(fit.model.sigma_gyro_rad_s / 0.05 - 1) < 0.03


def test_gyro_noise_is_recovered_when_the_magnetometer_has_no_noise() -> None:
    """The gyro's noise must not compensate for the floor of the magnetometer's noise."""
    made = experiment("wam", motion="slow", seed=0, samples=6000, sigma_mag=0.0, sigma_gyro=5e-3)
    fit = fit_null(track_of(made))
    assert fit.model.sigma_mag_gauss == 2e-5
    assert abs(fit.model.sigma_gyro_rad_s / 5e-3 - 1) < 0.05


def test_slow_turns_at_a_high_noise_level_are_not_taken_for_rest() -> None:
    """That 0.05 gauss of noise hides a change of the field from second to second does not prove
    rest.
    """
    made = experiment("wam", motion="slow", seed=3, samples=10_000, sigma_mag=0.05, sigma_gyro=0.05)
    rest = rate_at_rest(track_of(made))
    off = 0.0 if rest is None else rest.rate_rad_s - true_model(made).gyro_bias_rad_s
    unseen = np.inf if rest is None else rest.unseen_rad_s
    assert np.abs(off).max() < 2 * unseen
    fit = fit_null(track_of(made))
    found = np.abs(_difference(fit, true_model(made)))[8:]
    assert np.max(found / np.sqrt(np.diag(fit.covariance))[8:11]) < 4


@pytest.mark.slow
def test_null_model_contains_a_random_walk_of_the_gyro_bias() -> None:
    made = experiment(samples=8000, seed=4)
    track = track_of(made)
    rng = np.random.default_rng(2)
    walk = np.cumsum(rng.standard_normal((8000, 3)) * 1e-5 * np.sqrt(0.04), axis=0)
    fit = fit_null(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + walk))
    assert 4e-6 < fit.model.gyro_walk_rad_s_sqrt_s < 1.3e-5
    off = _difference(fit, true_model(made))[:8]
    chi2 = float(off @ np.linalg.solve(fit.covariance[:8, :8], off))
    assert stats.chi2.sf(chi2, 8) > 1e-3


def test_fit_at_rest_finds_the_gyro_bias_and_does_not_diverge() -> None:
    rng = np.random.default_rng(0)
    bias = np.array([4e-3, -5e-3, 2e-3])
    field = np.array([0.2, 0.05, 0.41])
    dt = np.full(3000, 0.04)
    dt[0] = np.nan
    still = Track(
        np.arange(3000, dtype=np.float64) * 0.04,
        dt,
        field + 1e-3 * rng.standard_normal((3000, 3)),
        bias + 1e-3 * rng.standard_normal((3000, 3)),
        None,
        {},
        (slice(0, 3000),),
    )
    rest = rate_at_rest(still)
    assert rest is not None
    assert np.abs(rest.rate_rad_s - bias).max() < 1e-4
    assert rest.unseen_rad_s < 1e-3
    assert rate_at_rest(track_of(experiment("lam", motion="slow", samples=3000))) is None
    fit = fit_null(still)
    assert np.abs(fit.model.soft_iron - np.eye(3)).max() < 0.05
    assert np.abs(fit.model.gyro_bias_rad_s - bias).max() < 5e-4
    assert np.sqrt(np.diag(fit.covariance)[:8]).min() > 1e-4  # determined by the prior alone


@pytest.mark.slow  # a short one, simulated: test_fit_at_rest_finds_the_gyro_bias...
@pytest.mark.recordings
def test_fit_of_a_stationary_recording_does_not_diverge() -> None:
    fit = fit_null(recorded("vn100/F00379"))
    assert np.linalg.norm(fit.model.soft_iron - np.eye(3)) < 0.3
    assert np.linalg.norm(fit.model.hard_iron_gauss) < 0.5
    assert np.abs(fit.model.gyro_bias_rad_s - [3.3e-3, 1.5e-3, 7.0e-3]).max() < 1.5e-3


def test_track_that_cannot_be_fitted_raises_a_one_line_error() -> None:
    track = track_of(experiment(samples=200))
    none = np.full((200, 3), np.nan)
    with pytest.raises(ValueError, match="no readings"):
        fit_null(replace(track, mag_b_gauss=none))
    with pytest.raises(ValueError, match="no readings"):
        fit_null(replace(track, mag_b_gauss=np.zeros((200, 3))))
    alone = replace(
        track, dt_s=np.full(200, np.nan), runs=tuple(slice(k, k + 1) for k in range(200))
    )
    with pytest.raises(ValueError, match="samples without a gap before them: 0, 15 are needed"):
        fit_null(alone)


def test_tracks_of_short_runs_or_with_missing_readings_are_fitted() -> None:
    track = track_of(experiment(samples=1200))
    dt_s = track.dt_s.copy()
    dt_s[::40] = np.nan
    cut = replace(track, dt_s=dt_s, runs=tuple(slice(k, k + 40) for k in range(0, 1200, 40)))
    mag = track.mag_b_gauss.copy()
    mag[300:900] = np.nan
    for one in (cut, replace(track, mag_b_gauss=mag)):
        fit = fit_null(one)
        assert fit.converged
        assert abs(fit.model.sigma_mag_gauss / 1e-3 - 1) < 0.1
        assert np.isfinite(fit.covariance).all()


@pytest.mark.slow
def test_fit_is_finite_when_the_gyro_contradicts_the_field() -> None:
    track = track_of(experiment(samples=1200))
    for gyro in (np.zeros((1200, 3)), track.gyro_b_rad_s * 2000):
        fit = fit_null(replace(track, gyro_b_rad_s=gyro))
        assert np.isfinite(fit.model.soft_iron).all()
        assert fit.model.sigma_mag_gauss > 0.05  # the field moved without explanation
