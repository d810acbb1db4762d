"""The log marginal likelihood of a model, its gradient and curvature, and its maximisation.

    y = B w + e,    w_j ~ N(0, Phi_j(psi)),    e in band b white of variance v_b

The data enter by the bands' products G_b = B_b^T B_b, s_b = B_b^T y_b, y_b^T y_b and their numbers
of rows n_b; all else is algebra of the size of B.  With D = Phi^(1/2), G = sum_b G_b / v_b, s =
sum_b s_b / v_b, A = I + D G D and m = A^-1 D s,

    2 L = -sum_b n_b log v_b - log |A| - sum_b y_b^T y_b / v_b + m^T D s - n log 2 pi

    dL / d log phi_j = (m_j^2 - 1 + (A^-1)_jj) / 2
    dL / d log v_b   = (|r_b|^2 / v_b - n_b + tr(A^-1 D G_b D) / v_b) / 2

with r_b the band's residual.  The calibration is in B with its own wide prior, so this is a
restricted likelihood.  Log priors of psi and log v are added: their joint density is maximised, and
every hypothesis is judged at its own maximum.

A step to the maximum takes the average information (Gilmour, Thompson and Cullis 1995), half of
Z^T P Z with Z the columns dV P y and P the projection of the restricted likelihood: the mean of
observed and expected curvature, without a trace of a product.  With M = I - A^-1 and, of each band,
t_b = A^-1 D B_b^T r_b / v_b it is

    2 H(phi_i, phi_j) = m_i M_ij m_j,    2 H(v_b, phi_j) = t_bj m_j,
    2 H(v_b, v_c) = |r_b|^2 / v_b if b = c, less (B_b^T r_b / v_b)^T D A^-1 D (B_c^T r_c / v_c)

If a variance is far too large, m nearly vanishes and with it this curvature; so its diagonal is at
least the expected one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ahrsd.diagnosis.inference.components.component import Law
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.samples import Array

#: relative increase of the diagonal: if columns are equal but for rounding, there would be no root
_JITTER = 1e-10
#: gain of a step, nats, below which the maximum is reached; most steps; longest step of a logarithm
_CONVERGED_NATS, _MOST_STEPS, _LONGEST_STEP = 0.02, 40, 2.0
#: largest gain of the remaining steps, as a multiple of the gain predicted of the next step
_HOPED_FACTOR = 5.0
#: shares of a step that are tried in turn
_STEP_SHARES = (1.0, 0.3, 0.1, 0.02)
#: curvature of a logarithm that is not constrained;  multiples of the curvature's diagonal that are
#: added to it in turn until a step leads up
_LEAST_CURVATURE, _DAMPING = 0.02, (0.0, 0.1, 1.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """Products of the columns and the data, band by band.

    G (B, q, q), s (B, q), square (B,), rows (B,);  step: prior deviation of the noise's spectrum
    from octave to octave (`noise_model`);  alone: indices of bands that are not tied to their
    neighbours
    """

    G: Array
    s: Array
    square: Array
    rows: Array
    step: float
    alone: slice | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ModelFit:
    """A model at one point of its hyperparameters.

    nats: log likelihood and log priors; -inf where rounding exceeds the residual's square
    gradient (k,), curvature (k, k): in (log v, psi)
    mean, deviation: (q,) of the coefficients' posterior
    """

    nats: float
    gradient: Array
    curvature: Array
    mean: Array
    deviation: Array
    log_noise: Array
    psi: Array


@dataclass(frozen=True, slots=True, eq=False)
class _JointPrior:
    """The laws at one psi: log variances (q,), slopes (q, k), log density, slope and stiffness."""

    phi: Array
    slopes: Array
    nats: float
    gradient: Array
    stiffness: Array


@dataclass(frozen=True, slots=True, eq=False)
class _BandResiduals:
    """Of each band: residual square, expected and at the posterior mean (B,), B^T r (B, q)."""

    expected: Array
    square: Array
    score: Array


def evaluate(products: Products, laws: Sequence[Law], log_noise: Array, psi: Array) -> ModelFit:
    """The log marginal likelihood with its priors, at these hyperparameters."""
    prior, inverse = _joint_prior(laws, psi), np.exp(-log_noise)
    deviation = np.exp(0.5 * prior.phi)
    scaled = deviation * (inverse @ products.s)
    A_inverse, log_det = _invert(products, inverse, deviation)
    m = A_inverse @ scaled
    certainty = 1.0 - np.diag(A_inverse)
    slope_by_phi = 0.5 * (m**2 - certainty)
    noise = _band_residuals(products, A_inverse, m * deviation, deviation)
    slope_by_noise = 0.5 * (noise.expected * inverse - products.rows)
    noise_log_prior, noise_prior_slope = noise_model.log_prior(
        log_noise, products.step, products.alone
    )
    residual_square = float(products.square @ inverse) - float(m @ scaled)
    likelihood = -0.5 * float(
        products.rows @ (log_noise + np.log(2 * np.pi)) + log_det + residual_square
    )
    return ModelFit(
        likelihood + prior.nats + noise_log_prior if residual_square > 0.0 else -np.inf,
        np.concatenate(
            [slope_by_noise + noise_prior_slope, prior.slopes.T @ slope_by_phi + prior.gradient]
        ),
        _curvature(products, prior, noise, A_inverse, m, inverse),
        m * deviation,
        deviation * np.sqrt(np.diag(A_inverse)),
        log_noise,
        psi,
    )


def _invert(products: Products, inverse: Array, deviation: Array) -> tuple[Array, float]:
    """A^-1 of A = I + D G D, and log |A|."""
    A = (inverse @ products.G.reshape(len(inverse), -1)).reshape(products.G.shape[1:])
    A *= deviation
    A *= deviation[:, None]
    diagonal = np.diag_indices_from(A)
    A[diagonal] = A[diagonal] * (1.0 + _JITTER) + 1.0
    root, info = linalg.lapack.dpotrf(A.T, lower=0, overwrite_a=1, clean=1)
    if info:
        raise np.linalg.LinAlgError("the columns of a model are alike to the last digit")
    log_det = 2.0 * float(np.sum(np.log(np.diag(root))))
    half, _ = linalg.lapack.dpotri(root, lower=0, overwrite_c=1)
    half_diagonal = np.diag(half).copy()
    A_inverse = half + half.T
    A_inverse[diagonal] = half_diagonal
    return np.asarray(A_inverse), log_det


def _band_residuals(
    products: Products, A_inverse: Array, mean: Array, deviation: Array
) -> _BandResiduals:
    """Squares of the bands' residuals at the posterior mean, and products with them."""
    fitted = products.G @ mean
    square = products.square - 2 * products.s @ mean + fitted @ mean
    covariance = A_inverse * deviation
    covariance *= deviation[:, None]
    uncertainty = products.G.reshape(len(square), -1) @ covariance.ravel()
    return _BandResiduals(square + uncertainty, square, products.s - fitted)


def _curvature(
    products: Products,
    prior: _JointPrior,
    noise: _BandResiduals,
    A_inverse: Array,
    m: Array,
    inverse: Array,
) -> Array:
    """Average information of (log v, psi), its diagonal at least the expected, plus the priors'."""
    deviation, count = np.exp(0.5 * prior.phi), len(inverse)
    projected = noise.score * inverse[:, None] * deviation
    projected_A_inverse = projected @ A_inverse
    by_phi = prior.slopes * m[:, None]
    M = -A_inverse
    M[np.diag_indices_from(M)] += 1.0
    H = np.zeros((count + by_phi.shape[1],) * 2)
    H[:count, :count] = np.diag(noise.square * inverse) - projected_A_inverse @ projected.T
    H[:count, count:] = projected_A_inverse @ by_phi
    H[count:, :count] = H[:count, count:].T
    H[count:, count:] = by_phi.T @ M @ by_phi
    uncertainty = (noise.expected - noise.square) * inverse
    expected = [
        products.rows - uncertainty,
        np.einsum("ik,ij,jk->k", prior.slopes, M**2, prior.slopes, optimize=True),
    ]
    diagonal = np.diag_indices_from(H)
    H[diagonal] = np.maximum(H[diagonal], np.concatenate(expected))
    H *= 0.5
    H[:count, :count] += noise_model.prior_curvature(count, products.step, products.alone)
    H[diagonal] += np.concatenate([np.zeros(count), prior.stiffness])
    return H


def _joint_prior(laws: Sequence[Law], psi: Array) -> _JointPrior:
    """The laws of all components together."""
    starts = np.cumsum([0, *(len(law.start) for law in laws)])
    psi_of_laws = [psi[a:b] for a, b in itertools.pairwise(starts)]
    phi = [law.log_variance(law_psi) for law, law_psi in zip(laws, psi_of_laws, strict=True)]
    rows = np.cumsum([0, *(len(law_psi) for law_psi in phi)])
    slopes = np.zeros((rows[-1], starts[-1]))
    gradient, stiffness, nats = np.zeros(starts[-1]), np.zeros(starts[-1]), 0.0
    for k, (law, law_psi) in enumerate(zip(laws, psi_of_laws, strict=True)):
        own = slice(starts[k], starts[k + 1])
        slopes[rows[k] : rows[k + 1], own] = law.slope(law_psi)
        density, gradient[own] = law.log_prior(law_psi)
        stiffness[own] = law.stiffness
        nats += density
    return _JointPrior(np.concatenate(phi), slopes, nats, gradient, stiffness)


def maximise(products: Products, laws: Sequence[Law], start: tuple[Array, Array]) -> ModelFit:
    """The most probable hyperparameters, found by Newton steps from a start (log noise, psi)."""
    found = maximise_above(products, laws, start, -np.inf)
    if found is None:
        raise ValueError("a climb that nothing ends has an end")
    return found


def maximise_above(
    products: Products,
    laws: Sequence[Law],
    start: tuple[Array, Array],
    required: float,
    *,
    start_small: Sequence[int] = (),
) -> ModelFit | None:
    """The same; None as soon as the maximum is surely below `required` nats.

    Newton steps with the average information, within the bounds of the hyperparameters.
    start_small: indices of laws that start at their lower bound if that is more probable.  A size
    of many coefficients that the data do not constrain decreases by half a logarithm a step, which
    looks like convergence.
    """
    count = len(products.rows)
    low, high = noise_model.bounds(count)
    low = np.concatenate([low, *(law.low for law in laws)])
    high = np.concatenate([high, *(law.high for law in laws)])
    x = np.clip(np.concatenate(start), low, high)
    at = evaluate(products, laws, x[:count], x[count:])
    if start_small:
        first = np.cumsum([count, *(len(law.start) for law in laws)])
        smallest = x.copy()
        for k in start_small:
            smallest[first[k] : first[k + 1]] = low[first[k] : first[k + 1]]
        if (
            fit_smallest := evaluate(products, laws, smallest[:count], smallest[count:])
        ).nats > at.nats:
            x, at = smallest, fit_smallest
    for _ in range(_MOST_STEPS):
        step = _newton_step(at, x, low, high)
        gain = 0.5 * float(at.gradient @ step)
        if at.nats + _HOPED_FACTOR * max(gain, _CONVERGED_NATS) < required:
            return None
        step *= min(1.0, _LONGEST_STEP / max(float(np.max(np.abs(step))), 1e-300))
        if 0.5 * float(at.gradient @ step) < _CONVERGED_NATS:
            break
        for part in _STEP_SHARES:
            new = np.clip(x + part * step, low, high)
            found = evaluate(products, laws, new[:count], new[count:])
            if found.nats > at.nats:
                break
        else:
            break
        x, at = new, found
    return at


def _newton_step(at: ModelFit, x: Array, low: Array, high: Array) -> Array:
    """The step to the maximum of the local quadratic approximation, within the bounds.

    If a logarithm is at its bound and is strongly correlated with another, as the size and the
    corner of a Gaussian process, the remaining step may lead down: then the curvature is damped.
    """
    step = np.zeros(len(x))
    for damping in _DAMPING:
        step = _bounded_step(at, x, low, high, damping)
        if float(at.gradient @ step) >= 0.0:
            break
    return step


def _bounded_step(at: ModelFit, x: Array, low: Array, high: Array, damping: float) -> Array:
    """The step with a multiple of the curvature's diagonal added, bound after bound held fixed."""
    g = at.gradient
    H = at.curvature + np.diag(_LEAST_CURVATURE + damping * np.diag(at.curvature))
    step = np.zeros(len(x))
    free = ~(((x <= low) & (g < 0.0)) | ((x >= high) & (g > 0.0)))
    while np.any(free):
        remaining_gradient = g[free] - H[np.ix_(free, ~free)] @ step[~free]
        step[free] = _solve_scaled(H[np.ix_(free, free)], remaining_gradient)
        allowed = np.clip(step, low - x, high - x)
        clipped = free & (allowed != step)
        step = allowed
        if not np.any(clipped):
            break
        free &= ~clipped
    return step


def _solve_scaled(H: Array, g: Array) -> Array:
    """H^-1 g of a curvature, each hyperparameter in its own unit.

    Given a source a thousand times larger than the noise, some curvatures are 1e12 times others,
    and unscaled the matrix is singular to rounding.
    """
    scale = 1.0 / np.sqrt(np.diag(H))
    scaled = H * scale * scale[:, None]
    return np.asarray(scale * linalg.solve(scaled, scale * g, assume_a="pos"))
