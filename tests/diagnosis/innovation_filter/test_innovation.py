"""The filter: equal to a plain loop, exact sensitivities, white innovations on nulls, no known
pitfalls.

Also columns that pass the filter together, and the 3x3 inverse of its gains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from tracks import experiment, moved_model, track_of, true_model

from ahrsd import so3
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    batch_columns,
    filtered_for_regression,
    join_columns,
    nominal_motion,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.innovation_filter.parallel_scan import NARROW
from ahrsd.diagnosis.model import Columns, NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array


def _with_gap(track: Track, first: int, count: int) -> Track:
    """The track without rows first..first+count: two runs."""
    keep = np.r_[0:first, first + count : len(track)]
    dt_s = track.dt_s[keep].copy()
    dt_s[first] = np.nan
    accel = None if track.accel_b_m_s2 is None else track.accel_b_m_s2[keep]
    return Track(
        track.time_s[keep],
        dt_s,
        track.mag_b_gauss[keep],
        track.gyro_b_rad_s[keep],
        accel,
        {},
        (slice(0, first), slice(first, len(keep))),
    )


def _sequential(track: Track, model: NullModel, nominal: Array) -> tuple[Array, Array]:
    """Whitened innovations and predicted fields by the textbook loop, row by row."""
    A, C = model.soft_iron, np.linalg.inv(model.soft_iron)
    R = model.sigma_mag_gauss**2 * np.eye(3)
    white, predicted = np.zeros_like(nominal), np.zeros_like(nominal)
    firsts = {run.start for run in track.runs}
    h, P = np.zeros(3), np.zeros((3, 3))
    for k, (mag, gyro) in enumerate(zip(track.mag_b_gauss, track.gyro_b_rad_s, strict=True)):
        if k in firsts:
            h, P = C @ (mag - model.hard_iron_gauss), C @ R @ C.T
            predicted[k] = h
            continue
        F = so3.exp(-(gyro - model.gyro_bias_rad_s) * track.dt_s[k])
        n = nominal[k] + F @ nominal[k - 1]
        size = np.linalg.norm(nominal[k])
        n *= size / np.linalg.norm(n)
        Q = (model.sigma_gyro_rad_s * track.dt_s[k]) ** 2 * (size**2 * np.eye(3) - np.outer(n, n))
        h, P = F @ h, F @ P @ F.T + Q
        S = A @ P @ A.T + R
        K = P @ A.T @ np.linalg.inv(S)
        e = mag - A @ h - model.hard_iron_gauss
        predicted[k] = h
        white[k] = np.linalg.solve(np.linalg.cholesky(S), e)
        h, P = h + K @ e, P - K @ S @ K.T
    return white, predicted


def test_block_filter_equals_the_plain_loop_across_a_gap() -> None:
    made = experiment(samples=900)
    track = _with_gap(track_of(made), 310, 40)
    model = true_model(made)
    done = run_filter(track, model)
    white, predicted = _sequential(track, model, done.nominal_b)
    assert np.abs(done.whitened - white).max() < 1e-9
    assert np.abs(done.predicted_b - predicted).max() < 1e-12
    assert not done.used[[0, 310]].any()
    assert done.used.sum() == len(track) - 2
    # products of one row and of many rows differ in the last bit on some processors
    first = _first_field(track, model, 310)
    np.testing.assert_allclose(done.predicted_b[310], first, rtol=1e-14)


def _first_field(track: Track, model: NullModel, row: int) -> Array:
    return np.asarray(
        (track.mag_b_gauss[row] - model.hard_iron_gauss) @ np.linalg.inv(model.soft_iron)
    )


def test_rows_without_readings_are_bridged_by_the_gyro() -> None:
    made = experiment(samples=600)
    track = track_of(made)
    mag = track.mag_b_gauss.copy()
    mag[200:220] = np.nan
    holed = replace(track, mag_b_gauss=mag)
    done = run_filter(holed, true_model(made))
    assert np.isfinite(done.whitened).all()
    assert not done.used[200:220].any()
    # twenty samples later the gyro has propagated the field correctly
    assert np.linalg.norm(done.predicted_b[220] - made_field(made)[220]) < 2e-3


@pytest.mark.parametrize("unread", [slice(500, 660), slice(500, 1100), slice(0, 600)])
def test_field_and_gains_stay_bounded_far_from_any_reading(unread: slice) -> None:
    """A saturated or stuck sensor for a minute, with a noisy gyro."""
    made = experiment("wam", samples=1500)
    track = track_of(made)
    mag = track.mag_b_gauss.copy()
    mag[unread] = np.nan
    loud = replace(true_model(made), sigma_gyro_rad_s=0.3, sigma_mag_gauss=1e-4)
    found = run_filter(replace(track, mag_b_gauss=mag), loud)
    whole = run_filter(track, loud)
    size = np.linalg.norm(found.nominal_b, axis=1)
    np.testing.assert_allclose(size, size[-1], rtol=1e-9)
    seen = np.isfinite(mag).all(axis=1)
    largest = np.abs(found.gains.innovation_covariance).max(axis=(1, 2))
    assert largest[seen].min() > 0.0
    assert largest.max() < 1e6 * np.abs(whole.gains.innovation_covariance).max()


def test_run_without_initial_readings_starts_at_its_first_reading() -> None:
    """The magnetometer is saturated at the start of the recording. The field was once zero
    there, with full weight.
    """
    made = experiment(samples=900)
    track = track_of(made)
    model = true_model(made)
    mag = track.mag_b_gauss.copy()
    mag[:130] = np.nan
    done = run_filter(replace(track, mag_b_gauss=mag), model)
    late = slice(130, len(track))
    later = Track(
        track.time_s[late],
        np.r_[np.nan, track.dt_s[131:]],
        track.mag_b_gauss[late],
        track.gyro_b_rad_s[late],
        None,
        {},
        (slice(0, 770),),
    )
    alone = run_filter(later, model)
    assert not done.used[:130].any()
    assert done.used[130:].all()
    # the first innovation is as uncertain as the start; the later ones are equal
    assert np.abs(done.whitened[130]).max() < 1.0
    assert np.abs(done.whitened[131:] - alone.whitened[1:]).max() < 0.05
    columns = nuisance_columns(done)
    seen, own = sensitivities(done, columns), sensitivities(alone, nuisance_columns(alone))
    assert np.abs(seen[140:] - own[10:]).max() < 0.02 * np.abs(own).max()


def made_field(made: object) -> Array:
    """True field of an experiment in units in which trace A = 3."""
    scale = np.trace(made.truth.soft_iron) / 3  # type: ignore[attr-defined]
    return np.asarray(made.field_b * scale)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("walk", "tolerance"), [(0.0, 1e-6), (1e-4, 2e-5)])
def test_sensitivities_equal_finite_differences_with_the_gain_held(
    walk: float, tolerance: float
) -> None:
    """With a wandering bias this is exact to first order in the bias: its lever is the nominal
    field.
    """
    made = experiment(samples=700, rate_hz=40.0)
    track = _with_gap(track_of(made), 240, 15)
    model = replace(true_model(made), gyro_walk_rad_s_sqrt_s=walk)
    done = run_filter(track, model)
    X = sensitivities(done, nuisance_columns(done))
    for at in range(11):
        step = np.zeros(11)
        step[at] = 1e-6
        up = run_filter(track, moved_model(model, step), gains_from=done).whitened
        down = run_filter(track, moved_model(model, -step), gains_from=done).whitened
        numeric = -(up - down) / 2e-6
        assert np.abs(X[:, :, at] - numeric).max() < tolerance * max(1.0, np.abs(numeric).max())


def test_regression_columns_equal_the_sensitivities_for_noise_free_rates() -> None:
    made = experiment(samples=700, rate_hz=40.0)
    track, model = _with_gap(track_of(made), 240, 15), true_model(made)
    done = run_filter(track, model)
    columns = nuisance_columns(done)
    same = filtered_for_regression(done, track.gyro_b_rad_s - model.gyro_bias_rad_s)
    X = sensitivities(done, columns)
    assert np.abs(sensitivities(same, columns) - X).max() < 1e-9 * np.abs(X).max()


def test_sensitivities_of_magnetometer_and_gyro_terms_add_up() -> None:
    made = experiment(samples=500)
    track, model = track_of(made), true_model(made)
    rng = np.random.default_rng(3)
    columns = Columns(rng.standard_normal((500, 3, 1)) * 1e-2, rng.standard_normal((500, 3, 1)))
    assert columns.mag is not None
    assert columns.gyro is not None
    done = run_filter(track, model)
    both = sensitivities(done, columns)
    alone = sensitivities(done, Columns(columns.mag)) + sensitivities(
        done, Columns(None, columns.gyro)
    )
    assert np.abs(both - alone).max() < 1e-9 * np.abs(both).max()
    up, down = (
        run_filter(
            track, model, s * columns.mag[:, :, 0], s * columns.gyro[:, :, 0], gains_from=done
        )
        for s in (1e-6, -1e-6)
    )
    numeric = -(up.whitened - down.whitened) / 2e-6
    assert np.abs(both[:, :, 0] - numeric).max() < 1e-6 * np.abs(numeric).max()


@pytest.mark.parametrize("walk", [0.0, 1e-4])
def test_few_and_many_columns_have_equal_sensitivities(walk: float) -> None:
    """The banded and the block recursion agree, across a gap too."""
    made = experiment(samples=500)
    track = _with_gap(track_of(made), 240, 15)
    done = run_filter(track, replace(true_model(made), gyro_walk_rad_s_sqrt_s=walk))
    rng = np.random.default_rng(5)
    mag, gyro = rng.standard_normal((2, len(track), 3, NARROW + 1))
    for mine in (Columns(mag), Columns(None, gyro), Columns(mag, gyro)):
        many = sensitivities(done, mine)
        few = Columns(
            *(None if part is None else part[:, :, :NARROW] for part in (mine.mag, mine.gyro))
        )
        assert np.abs(sensitivities(done, few) - many[:, :, :-1]).max() < 1e-9 * np.abs(many).max()


def test_nominal_motion_equals_that_of_the_filter() -> None:
    made = experiment(samples=500)
    track, model = _with_gap(track_of(made), 240, 15), true_model(made)
    mag, gyro = np.random.default_rng(6).standard_normal((2, len(track), 3)) * 1e-3
    done, quick = run_filter(track, model, mag, gyro), nominal_motion(track, model, mag, gyro)
    assert np.array_equal(quick.nominal_b, done.nominal_b)
    assert np.array_equal(quick.orientation, done.orientation)


def test_empty_columns_are_refused() -> None:
    made = experiment(samples=100)
    with pytest.raises(ValueError, match="input"):
        sensitivities(run_filter(track_of(made), true_model(made)), Columns())


@pytest.mark.parametrize(
    ("scenario", "motion", "sigma_gyro"),
    [("wam", "rov", 5e-4), ("mam", "rov", 5e-3), ("lam", "slow", 5e-3)],
)
def test_innovations_of_a_null_are_white(scenario: str, motion: str, sigma_gyro: float) -> None:
    whitened = []
    for seed in range(4):
        made = experiment(scenario, motion=motion, seed=seed, samples=8000, sigma_gyro=sigma_gyro)
        done = run_filter(track_of(made), true_model(made))
        whitened.append(done.whitened[done.used])
    flat = np.concatenate([w.ravel() for w in whitened])
    assert stats.kstest(flat, "norm").pvalue > 1e-3
    assert abs(np.var(flat) - 1) < 3.5 * np.sqrt(2 / len(flat))
    q = 0.0
    for w in whitened:
        for lag in range(1, 21):
            q += float(np.sum(np.sum(w[lag:] * w[:-lag], axis=0) ** 2) / len(w))
    assert 1e-3 < stats.chi2.sf(q, 4 * 20 * 3) < 1 - 1e-3


def _t_of(done: Filtered, extra: Array) -> float:
    """Estimate divided by its deviation for one magnetometer column, with the calibration
    projected out.
    """
    columns = nuisance_columns(done)
    assert columns.mag is not None
    assert columns.gyro is not None
    nothing = np.zeros_like(columns.gyro[:, :, :1])
    X = sensitivities(
        done,
        Columns(
            np.concatenate([columns.mag, extra], axis=2),
            np.concatenate([columns.gyro, nothing], axis=2),
        ),
    )[done.used].reshape(-1, 12)
    y = done.whitened[done.used].ravel()
    gram = X.T @ X
    inverse = np.linalg.inv(gram)
    return float((inverse @ X.T @ y)[11] / np.sqrt(inverse[11, 11]))


def test_predicted_field_has_no_trend_with_a_noisy_gyro() -> None:
    """At 5 mrad/s an additive update on its own sphere finds a trend in |h| in every null."""
    values = []
    for seed in range(8):
        made = experiment("wam", seed=seed, samples=5000, sigma_gyro=5e-3)
        track, model = track_of(made), true_model(made)
        done = run_filter(track, model)
        course = (track.time_s - track.time_s.mean()) / 200.0
        trend = (done.predicted_b @ model.soft_iron * course[:, None])[:, :, None]
        values.append(_t_of(done, trend))
    assert abs(np.mean(values)) < 3 / np.sqrt(8)
    assert np.sum(np.square(values)) < stats.chi2.ppf(0.999, 8)


def test_sensitivities_at_rest_have_no_information_on_the_iron() -> None:
    """At rest only the sum of hard iron and field is observed."""
    made = experiment("lam", samples=600)
    track = track_of(made)
    still = replace(
        track,
        mag_b_gauss=np.tile(track.mag_b_gauss[:1], (600, 1)),
        gyro_b_rad_s=np.tile(true_model(made).gyro_bias_rad_s, (600, 1)),
    )
    done = run_filter(still, true_model(made))
    X = sensitivities(done, nuisance_columns(done))[done.used].reshape(-1, 11)
    scaled = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    # hard iron and soft iron change the first reading and all later ones equally
    assert np.abs(X[:, :8]).max() < 1e-6 * np.abs(X[:, 8:]).max()
    assert np.isfinite(scaled).all()


def test_traceless_directions_have_no_trace_and_full_rank() -> None:
    assert np.abs(np.trace(TRACELESS, axis1=1, axis2=2)).max() == 0
    assert np.linalg.matrix_rank(TRACELESS.reshape(5, 9)) == 5


def of(mag: int = 0, gyro: int = 0) -> Columns:
    rng = np.random.default_rng(mag + 10 * gyro)
    sides = [rng.normal(size=(5, 3, width)) if width else None for width in (mag, gyro)]
    return Columns(*sides)


def test_batches_have_one_sensor_and_a_limited_width() -> None:
    columns = [
        of(mag=3),
        of(gyro=2),
        of(mag=4),
        of(mag=2, gyro=2),
        of(mag=9),
        of(gyro=5),
        of(mag=1),
    ]
    found = batch_columns(columns, 7)
    assert found == [[0, 2], [4], [6], [1, 5], [3]]
    for batch in found:
        together = join_columns([columns[k] for k in batch])
        for part, k in ((together.mag, "mag"), (together.gyro, "gyro")):
            own = [getattr(columns[number], k) for number in batch]
            if part is None:
                assert own == [None] * len(batch)
            else:
                np.testing.assert_array_equal(part, np.concatenate(own, axis=2))
