"""Log Bayes factors of candidates for a model that is factored once, averaged over sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit
from ahrsd.diagnosis.inference.likelihood.linearisation import Linearised
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class CandidateScan:
    """A model in its noise, to which candidates are added one at a time.

    at: its coefficients and noise
    inverse (B,): inverse noise power of each band
    root: lower Cholesky factor of the posterior precision of its coefficients
    projected_y: root^-1 s
    """

    made: Linearised
    keys: Sequence[str]
    at: ModelFit
    inverse: Array
    root: Array
    projected_y: Array

    def project(self, products: Array) -> Array:
        """(q, p) root^-1 times the products of the model with candidates."""
        return np.asarray(solve_triangular(self.root, products, lower=True, check_finite=False))

    def at_sensor_noise(self) -> CandidateScan:
        """The same model in the sensor's own noise: no octave above the power of the highest.

        In the noise of the model, what a candidate explains still counts as noise.
        """
        noise = np.minimum(self.at.log_noise, self.at.log_noise[-1])
        return candidate_scan(self.made, self.keys, replace(self.at, log_noise=noise))

    def estimate(self, candidate: Component) -> tuple[Array, Array]:
        """(p,) coefficients of a candidate at its prior's largest size, and their deviations."""
        self.made.add_tentatively([candidate])
        cross_products, own_products, s = self.made.candidate_products(
            self.keys, [candidate.key], self.inverse
        )
        W = self.project(cross_products)
        G = own_products[0] - W.T @ W
        G[np.diag_indices_from(G)] += np.exp(-candidate.law.log_variance(candidate.law.high))
        covariance = np.linalg.inv(G)
        return covariance @ (s - self.projected_y @ W), np.sqrt(np.diagonal(covariance))

    def log_bayes_factors(self, candidates: Sequence[str]) -> dict[str, float]:
        """Log Bayes factor of each candidate, averaged over sizes."""
        cross_products, own_products, s = self.made.candidate_products(
            self.keys, candidates, self.inverse
        )
        W = self.project(cross_products)
        residual_score = s - self.projected_y @ W
        out, begin = {}, 0
        for key, own_information in zip(candidates, own_products, strict=True):
            part = slice(begin, begin + len(own_information))
            begin += len(own_information)
            G = own_information - W[:, part].T @ W[:, part]
            out[key] = averaged_log_bayes_factor(
                G, residual_score[part], self.made.seen[key].component
            )
        return out


def candidate_scan(made: Linearised, keys: Sequence[str], at: ModelFit) -> CandidateScan:
    """Factor a model, to scan candidates added to it."""
    products = made.products(keys, priors.NOISE_STEP_REAL)
    inverse = np.exp(-at.log_noise)
    phi, begin = [], 0
    for law in (made.seen[key].component.law for key in keys):
        width = len(law.start)
        phi.append(law.log_variance(at.psi[begin : begin + width]))
        begin += width
    A = np.tensordot(inverse, products.G, 1)
    A[np.diag_indices_from(A)] += np.exp(-np.concatenate(phi))
    root = cholesky(A, lower=True, check_finite=False)
    projected_y = solve_triangular(root, inverse @ products.s, lower=True, check_finite=False)
    return CandidateScan(made, tuple(keys), at, inverse, root, projected_y)


def averaged_log_bayes_factor(G: Array, s: Array, component: Component) -> float:
    """Log Bayes factor of a component of information G (p, p) and score s (p,), over all sizes."""
    variance = component.law.log_variance(np.zeros(len(component.law.start)))
    deviation = np.exp(0.5 * variance)
    scaled = G * deviation * deviation[:, None]
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    values = np.maximum(values, 0.0)
    score = vectors.T @ (s * deviation)
    size_squared = (
        np.square(np.array(priors.EFFECT_GRID))[:, None]
        if len(component.law.start)
        else np.ones((1, 1))
    )
    terms = 0.5 * np.sum(
        score**2 / (values + 1 / size_squared) - np.log1p(size_squared * values), axis=1
    )
    return float(np.logaddexp.reduce(terms) - np.log(len(size_squared)))
