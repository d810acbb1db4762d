"""The evidence compared with a dense Gaussian, its gradient with differences, and its maximum."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from ahrsd.diagnosis.inference.components.component import FixedLaw, ScaledLaw
from ahrsd.diagnosis.inference.components.gaussian_process import GaussianProcessLaw
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.diagnosis.inference.likelihood.evidence import (
    Products,
    evaluate,
    maximise,
    maximise_above,
)

ROWS, STEP = (20, 20, 40, 80), 0.7


def design(seed: int, widths: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Correlated columns, and readings that contain some of them."""
    rng = np.random.default_rng(seed)
    count = sum(ROWS)
    B = rng.normal(size=(count, sum(widths))) + 0.5 * rng.normal(size=(count, 1))
    band = np.repeat(np.arange(len(ROWS)), ROWS)
    y = B @ rng.normal(scale=0.7, size=B.shape[1]) + np.exp(0.3 * band) * rng.normal(size=count)
    return B, y


def products(B: np.ndarray, y: np.ndarray) -> Products:
    edges = np.cumsum([0, *ROWS])
    parts = [slice(a, b) for a, b in itertools.pairwise(edges)]
    return Products(
        np.stack([B[p].T @ B[p] for p in parts]),
        np.stack([B[p].T @ y[p] for p in parts]),
        np.array([y[p] @ y[p] for p in parts]),
        np.array(ROWS, dtype=float),
        STEP,
    )


def laws() -> list:
    even = (np.array([np.log(0.01)]), np.array([np.log(10.0)]))
    return [
        FixedLaw(np.full(3, 4.0)),
        ScaledLaw(np.array([0.5, 1.0, 2.0]), *even),
        ScaledLaw(np.ones(4), *even, mean=np.log(0.3), spread=0.8),
        GaussianProcessLaw(np.repeat(np.arange(1, 6), 2).astype(float), 1.0),
    ]


WIDTHS = (3, 3, 4, 10)


def dense(B: np.ndarray, y: np.ndarray, log_noise: np.ndarray, psi: np.ndarray) -> float:
    """Log density of the readings by their full covariance, plus that of the hyperparameters."""
    at, variance, prior = 0, [], 0.0
    for law in laws():
        mine = psi[at : at + len(law.start)]
        at += len(mine)
        variance.append(np.exp(law.log_variance(mine)))
        prior += law.log_prior(mine)[0]
    V = np.diag(np.repeat(np.exp(log_noise), ROWS)) + (B * np.concatenate(variance)) @ B.T
    readings = multivariate_normal(np.zeros(len(y)), V).logpdf(y)
    return float(readings + prior + noise_model.log_prior(log_noise, STEP)[0])


LOG_NOISE, PSI = np.array([0.4, 0.1, -0.2, 0.3]), np.array([-0.4, -0.9, 0.2, 0.8])


def test_evidence_equals_that_of_the_dense_gaussian():
    B, y = design(1, WIDTHS)
    at = evaluate(products(B, y), laws(), LOG_NOISE, PSI)
    assert at.nats == pytest.approx(dense(B, y, LOG_NOISE, PSI), abs=1e-6)


def test_gradient_of_the_evidence_agrees_with_finite_differences():
    B, y = design(2, WIDTHS)
    at = evaluate(products(B, y), laws(), LOG_NOISE, PSI)
    x = np.concatenate([LOG_NOISE, PSI])
    for k in range(len(x)):
        step = 1e-5 * np.eye(len(x))[k]
        ahead, behind = (dense(B, y, (x + s)[:4], (x + s)[4:]) for s in (step, -step))
        assert at.gradient[k] == pytest.approx((ahead - behind) / 2e-5, rel=1e-5, abs=1e-5)


def test_posterior_mean_and_deviation_equal_those_of_bayesian_regression():
    B, y = design(3, WIDTHS)
    at = evaluate(products(B, y), laws(), LOG_NOISE, PSI)
    weight = np.repeat(np.exp(-LOG_NOISE), ROWS)
    k, variance = 0, []
    for law in laws():
        variance.append(np.exp(law.log_variance(PSI[k : k + len(law.start)])))
        k += len(law.start)
    precision = (B.T * weight) @ B + np.diag(1 / np.concatenate(variance))
    covariance = np.linalg.inv(precision)
    np.testing.assert_allclose(at.deviation, np.sqrt(np.diag(covariance)), rtol=1e-7)
    np.testing.assert_allclose(at.mean, covariance @ (B.T @ (weight * y)), atol=1e-7)


def test_evidence_does_not_depend_on_the_search_path_for_200_sets():
    """A set has the same evidence whether it is reached by adding or by removing members."""
    rng = np.random.default_rng(4)
    width, members = 3, 8
    worst = 0.0
    for trial in range(200):
        if trial % 20 == 0:
            B, y = design(100 + trial, (width,) * members)
        few = np.sort(rng.choice(members, size=rng.integers(1, members), replace=False))
        whole = np.arange(members)

        def of(chosen, start=None, B=B, y=y):
            columns = np.concatenate([np.arange(width) + width * k for k in chosen])
            even = (np.array([np.log(0.01)]), np.array([np.log(10.0)]))
            own = [ScaledLaw(np.ones(width), *even) for _ in chosen]
            begin = start or (np.full(4, 1.0), np.zeros(len(chosen)))
            return maximise(products(B[:, columns], y), own, begin)

        rich = of(whole)
        dropped = of(few, (rich.log_noise, rich.psi[few]))
        fewer = of(few[:-1]) if len(few) > 1 else of(few)
        psi = np.concatenate([fewer.psi, [0.0]]) if len(few) > 1 else np.zeros(1)
        added = of(few, (fewer.log_noise, psi))
        worst = max(worst, abs(added.nats - dropped.nats))
    assert worst < 1.0


def test_maximum_has_the_true_size_and_a_small_size_for_an_absent_component():
    rng = np.random.default_rng(5)
    B = rng.normal(size=(sum(ROWS), 16))
    y = B[:, :8] @ rng.normal(scale=2.0, size=8) + rng.normal(size=len(B))
    even = (np.array([np.log(0.01)]), np.array([np.log(10.0)]))
    found = maximise(
        products(B, y),
        [ScaledLaw(np.ones(8), *even), ScaledLaw(np.ones(8), *even)],
        (np.zeros(4), np.zeros(2)),
    )
    assert np.exp(found.psi[0]) == pytest.approx(2.0, rel=0.5)
    assert np.exp(found.psi[1]) < 0.15
    np.testing.assert_allclose(np.exp(found.log_noise), 1.0, rtol=0.6)


def test_maximisation_is_abandoned_only_below_the_threshold():
    for seed in range(30):
        B, y = design(60 + seed, WIDTHS)
        start = (np.full(4, 1.5), np.full(len(PSI), -0.5))
        top = maximise(products(B, y), laws(), start)
        found = maximise_above(products(B, y), laws(), start, top.nats - 0.1)
        assert found is not None
        assert found.nats == top.nats
        assert maximise_above(products(B, y), laws(), start, top.nats + 1e3) is None


def test_curvature_is_the_average_information_bounded_by_the_expected():
    B, y = design(6, WIDTHS)
    at = evaluate(products(B, y), laws(), LOG_NOISE, PSI)
    begin, variance, slopes, stiff = 0, [], [], []
    for law in laws():
        mine = PSI[begin : begin + len(law.start)]
        begin += len(mine)
        variance.append(np.exp(law.log_variance(mine)))
        slopes.append(law.slope(mine))
        stiff.append(law.stiffness)
    phi, slope = np.concatenate(variance), block_diag(*slopes)
    noise = np.repeat(np.exp(LOG_NOISE), ROWS)
    band = np.repeat(np.eye(len(ROWS)), ROWS, axis=0)
    P = np.linalg.inv(np.diag(noise) + (B * phi) @ B.T)
    changes = [np.diag(noise * part) for part in band.T]
    changes += [(B * phi * part) @ B.T for part in slope.T]
    Z = np.column_stack([change @ P @ y for change in changes])
    average = 0.5 * Z.T @ P @ Z
    k = len(ROWS)
    found = at.curvature.copy()
    found[:k, :k] -= noise_model.prior_curvature(k, STEP)
    found[k:, k:] -= np.diag(np.concatenate(stiff))
    off = ~np.eye(len(found), dtype=bool)
    np.testing.assert_allclose(found[off], average[off], rtol=1e-6, atol=1e-9)
    expected = [0.5 * np.trace(P @ change @ P @ change) for change in changes[k:]]
    most = np.maximum(np.diag(average)[k:], expected)
    np.testing.assert_allclose(np.diag(found)[k:], most, rtol=1e-6)


def test_maximum_equals_that_of_a_quasi_newton_search():
    """Newton steps compared with a quasi-Newton search of the same function from far away."""
    for seed in range(10):
        B, y = design(20 + seed, WIDTHS)
        found = maximise(products(B, y), laws(), (np.full(4, 1.5), np.zeros(4)))

        of_all = products(B, y)

        def cost(x, known=of_all):
            at = evaluate(known, laws(), x[:4], x[4:])
            return -at.nats, -at.gradient

        low, high = noise_model.bounds(4)
        low = np.concatenate([low, *(law.low for law in laws())])
        high = np.concatenate([high, *(law.high for law in laws())])
        start = np.concatenate([found.log_noise, found.psi]) + 0.3
        other = minimize(cost, start, jac=True, bounds=list(zip(low, high, strict=True)))
        assert found.nats == pytest.approx(-other.fun, abs=0.05)


def test_narrow_bands_may_have_any_power() -> None:
    edges, alone = noise_model.insert_narrow_bands(noise_model.octave_edges(4000), 700, 900, 50)
    assert edges.tolist() == [0, 62, 125, 250, 500, 700, 750, 800, 850, 900, 2000, 4000]
    assert edges[alone].tolist() == [700, 750, 800, 850]
    quiet = np.zeros(len(edges) - 1)
    loud = quiet.copy()
    loud[alone] = 3.0
    near, far = (noise_model.log_prior(loud, STEP, where)[0] for where in (alone, None))
    assert near > noise_model.log_prior(quiet, STEP, alone)[0] - 1.1
    assert far < noise_model.log_prior(quiet, STEP)[0] - 15.0
    _, slope = noise_model.log_prior(loud, STEP, alone)
    for k, one in enumerate(np.eye(len(loud))):
        up, down = (noise_model.log_prior(loud + d * one, STEP, alone)[0] for d in (1e-4, -1e-4))
        assert slope[k] == pytest.approx((up - down) / 2e-4, abs=1e-6)
    expected = -noise_model.prior_curvature(len(loud), STEP, alone) @ loud
    np.testing.assert_allclose(slope, expected, atol=1e-9)


@pytest.mark.parametrize("size", [0.03, 0.1])
def test_maximisation_continues_when_size_and_corner_are_nearly_degenerate(size: float) -> None:
    """All half waves that are seen have equal power: the corner ends at its upper bound."""
    rng, count, known = np.random.default_rng(1), 200, 1e4
    w = size * rng.normal(size=count)
    s = known * w + np.sqrt(known) * rng.normal(size=count)
    rows = 3.0 * count
    said = Products(
        np.diag(np.full(count, known))[None],
        s[None],
        np.array([s @ s / known + rows - count]),
        np.array([rows]),
        STEP,
    )
    law = GaussianProcessLaw(np.arange(1, count + 1).astype(float), 1.0)
    starts = [np.array([0.0, np.log(corner)]) for corner in (4.0, 36.0)]
    low, high = (maximise(said, [law], (np.zeros(1), start)) for start in starts)
    assert low.nats == pytest.approx(high.nats, abs=0.05)
    assert np.exp(low.psi[1]) == pytest.approx(40.0, rel=0.01)
