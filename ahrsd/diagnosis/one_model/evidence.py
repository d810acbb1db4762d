"""The log marginal likelihood of a model, its gradient, and where it is largest.

    y = B w + e,    w_j ~ N(0, Phi_j(psi)),    e in band b white of variance v_b

With the bands' products G_b = B_b^T B_b, s_b = B_b^T y_b, y_b^T y_b and n_b rows, everything else
is algebra of the size of B: with D = Phi^(1/2), G = sum_b G_b / v_b, s likewise, A = I + D G D and
m = A^-1 D s,

    2 L = -sum_b n_b log v_b - log |A| - sum_b y_b^T y_b / v_b + m^T D s - n log 2 pi

    dL / d log phi_j = (m_j^2 - 1 + (A^-1)_jj) / 2
    dL / d log v_b   = (r_b / v_b - n_b + tr(A^-1 D G_b D) / v_b) / 2

with r_b the square of the band's residual.  The calibration is in B with its own wide prior, so
this is a restricted likelihood.  Priors of psi and log v are added: what is maximised is their
joint density, and every hypothesis is judged at its own maximum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from ahrsd.diagnosis.one_model import noise_model
from ahrsd.diagnosis.one_model.component import Law
from ahrsd.samples import Array

#: relative: columns that are alike but for rounding would else leave no root
_ROUNDED = 1e-10
#: a maximum is reached where a step gains less, in machine precisions of the nats; and steps
_FLAT, _STEPS = 4e8, 60


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """What the data say, band by band.

    G (B, q, q), s (B, q), square (B,), rows (B,);  step: of the noise's spectrum (`noise_model`)
    """

    G: Array
    s: Array
    square: Array
    rows: Array
    step: float


@dataclass(frozen=True, slots=True, eq=False)
class At:
    """The model at one point of its hyperparameters.

    nats: log likelihood and log priors;  gradient: in (log v, psi)
    mean, root: of the coefficients: D m, and R with D A^-1 D = R^T R
    residual: (B,) expected square of each band's noise
    """

    nats: float
    gradient: Array
    mean: Array
    root: Array
    residual: Array
    log_noise: Array
    psi: Array

    @property
    def covariance(self) -> Array:
        """(q, q) posterior covariance of the coefficients."""
        return np.asarray(self.root.T @ self.root)


def evaluated(products: Products, laws: Sequence[Law], log_noise: Array, psi: Array) -> At:
    """The log marginal likelihood with its priors, at these hyperparameters."""
    phi, slopes, prior, slope_of_prior = _laws(laws, psi)
    inverse = np.exp(-log_noise)
    deviation = np.exp(0.5 * phi)
    bands = products.G.reshape(len(inverse), -1)
    G = (inverse @ bands).reshape(products.G.shape[1:])
    G *= deviation
    G *= deviation[:, None]
    s = deviation * (inverse @ products.s)
    A = G.copy()
    diagonal = np.diag_indices_from(A)
    A[diagonal] = A[diagonal] * (1.0 + _ROUNDED) + 1.0
    L, broken = linalg.lapack.dpotrf(A.T, lower=1, overwrite_a=1)
    if broken:
        raise np.linalg.LinAlgError("the columns of a model are alike to the last digit")
    root, _ = linalg.lapack.dtrtri(L, lower=1, overwrite_c=1)
    seen = root @ s
    m = seen @ root
    weighted = m * deviation
    covariance = root.T @ root
    covariance *= deviation
    covariance *= deviation[:, None]
    fitted = products.G @ weighted
    square = products.square - 2 * products.s @ weighted + fitted @ weighted
    unsure = bands @ covariance.ravel()
    residual = square + unsure
    by_phi = 0.5 * (m**2 - 1.0 + np.einsum("ij,ij->j", root, root))
    by_noise = 0.5 * (residual * inverse - products.rows)
    of_noise, slope_of_noise = noise_model.log_prior(log_noise, products.step)
    likelihood = 0.5 * float(seen @ seen) + float(np.sum(np.log(np.diag(root))))
    likelihood -= 0.5 * float(
        products.rows @ (log_noise + np.log(2 * np.pi)) + products.square @ inverse
    )
    gradient = np.concatenate([by_noise + slope_of_noise, slopes.T @ by_phi + slope_of_prior])
    nats = likelihood + prior + of_noise
    return At(nats, gradient, weighted, root * deviation, residual, log_noise, psi)


def _laws(laws: Sequence[Law], psi: Array) -> tuple[Array, Array, float, Array]:
    """Log variances (q,), their slopes (q, k), log prior of psi and its gradient (k,)."""
    phi, slopes, gradients, prior, at = [], [], [], 0.0, 0
    for law in laws:
        mine = psi[at : at + len(law.start)]
        at += len(mine)
        phi.append(law.log_variance(mine))
        slopes.append(law.slope(mine))
        density, gradient = law.log_prior(mine)
        prior += density
        gradients.append(gradient)
    flat = np.concatenate([*gradients, np.zeros(0)])
    return np.concatenate(phi), linalg.block_diag(*slopes), prior, flat


def maximised(products: Products, laws: Sequence[Law], starts: Sequence[tuple[Array, Array]]) -> At:
    """The likeliest hyperparameters found from any of the starts (log noise, psi)."""
    return max((_climbed(products, laws, *start) for start in starts), key=lambda one: one.nats)


def _climbed(products: Products, laws: Sequence[Law], log_noise: Array, psi: Array) -> At:
    """Quasi-Newton, each variable in units of its own expected curvature."""
    count = len(products.rows)
    low, high = noise_model.bounds(count)
    low = np.concatenate([low, *(law.low for law in laws)])
    high = np.concatenate([high, *(law.high for law in laws)])
    unit = np.concatenate([np.sqrt(2.0 / (products.rows + 4.0)), np.full(len(psi), 0.5)])
    best: list[At] = []

    def cost(x: Array) -> tuple[float, Array]:
        whole = x * unit
        at = evaluated(products, laws, whole[:count], whole[count:])
        if not best or at.nats > best[0].nats:
            best[:] = [at]
        return -at.nats, -at.gradient * unit

    start = np.clip(np.concatenate([log_noise, psi]), low, high) / unit
    box = list(zip(low / unit, high / unit, strict=True))
    optimize.fmin_l_bfgs_b(
        cost, start, bounds=box, factr=_FLAT, pgtol=1e-3, maxiter=_STEPS, maxfun=2 * _STEPS
    )
    return best[0]
