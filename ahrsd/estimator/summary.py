"""From the graph's numbers to an `Estimate`: scale as a gauge, sigmas, heading, observability."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ahrsd.calibration import Observability
from ahrsd.estimator import chain
from ahrsd.estimator.graph import BLIND
from ahrsd.samples import Array

_NAMES = (
    *(f"soft iron {i}" for i in ("xx", "xy", "xz", "yy", "yz", "zz")),
    *(f"hard iron {i}" for i in "xyz"),
    *(f"gyro bias {i}" for i in "xyz"),
)
_TYPICAL_DIP_RAD = float(np.radians(65.0))  # pessimistic for most of the inhabited earth
_STEEPEST_RAD = float(np.radians(80.0))
_HEADINGS = 12
_FLOOR = 0.1  # ratio at which the observability score is 1


def unit_volume(c: Array) -> tuple[Array, Array, float, Array]:
    """A (3, 3) with det 1, b (3,), |h|, and d[A (6), b (3)]/d[M (6), b (3)] (9, 9).

    A = M / r with r = det(M)^(1/3), so dA = dM / r - A tr(M^-1 dM) / 3.
    """
    M = chain.symmetric(c[:6])
    r = float(np.cbrt(np.linalg.det(M)))
    A = M / r
    inverse = np.linalg.inv(M)
    J = np.eye(9)
    for j in range(6):
        dM = chain.symmetric(np.eye(6)[j])
        J[:6, j] = chain.upper_triangle(dM / r - A * np.trace(inverse @ dM) / 3)
    return A, c[6:9].copy(), r, J


def heading_sigma_deg(c: Array, covariance: Array, down_b: Array, dip_rad: float) -> float:
    """Worst 1-sigma heading error over 12 headings at the given tilts.

    down_b (K, 3): unit vectors towards the earth, sensor frame. The direction error of a field
    direction u is the tangential part of M^-1 (dM u + db); its part along (down x u) turns the
    heading by that over cos(dip).
    """
    M = chain.symmetric(c[:6])
    psi = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    helper = np.eye(3)[np.argmin(np.abs(down_b), axis=1)]
    north = np.cross(helper, down_b)
    north /= np.linalg.norm(north, axis=1, keepdims=True)
    east = np.cross(down_b, north)
    level = np.cos(psi)[:, None, None] * north + np.sin(psi)[:, None, None] * east
    u = (np.cos(dip_rad) * level + np.sin(dip_rad) * down_b).reshape(-1, 3)
    across = np.cross(down_b, level).reshape(-1, 3) @ np.linalg.inv(M) / np.cos(dip_rad)
    J = np.concatenate([chain.symmetric_columns(u), np.tile(np.eye(3), (len(u), 1, 1))], axis=2)
    row = (across[:, None, :] @ J)[:, 0]
    variance = np.sum((row @ covariance[:9, :9]) * row, axis=1)
    return float(np.degrees(np.sqrt(np.max(variance))))


_TELLS_DEG = 0.5  # a heading that is known better needs no advice
_WIDENED = {
    "motion": "the motion so far tells too little: turn through all headings, and roll and pitch",
    "misfit": "the field differs with place or attitude, or the iron changes meanwhile: repeat the "
    "motion at another place, away from steel and currents, once it is warm",
    "axes": "the magnetometer's axes may be turned against the gyro's: roll and pitch as well",
    "lag": "the field's readings may be late: turn fast and slow, both ways",
    "scales": "the gyro's scales may be off by a percent: turn about every axis, and back again",
    "bias": "the gyro's bias may still follow its temperature: go on until it is warm",
}


def widened_by(
    c: Array, parts: Mapping[str, Array], down: Array, dip_rad: float, sigma_deg: float
) -> str:
    """What makes more than half of the variance of a heading known to `sigma_deg`, in words.

    c, down, dip_rad: as for `heading_sigma_deg`; parts: covariances (12, 12) by the names of
    `_WIDENED`, which add up to that of the answer but for what they have in common
    """
    if not sigma_deg > _TELLS_DEG:
        return ""
    variances = {n: heading_sigma_deg(c, one, down, dip_rad) ** 2 for n, one in parts.items()}
    most = max(variances, key=lambda name: variances[name])
    if not variances[most] > 0.5 * sum(variances.values()):
        return ""
    return _WIDENED[most]


def attitude(tilts: Iterable[Array], epochs: Sequence[tuple[Array, Array]]) -> tuple[Array, float]:
    """Tilts driven (K, 3) and the field's dip in rad, from gravity; level and steep without it.

    tilts: unit vectors towards the earth, some nan; epochs: directions (n, 3) of the field and of
    down.
    """
    down = np.array([d for d in tilts if np.isfinite(d).all()])
    if len(down) == 0:
        return np.array([[0.0, 0.0, 1.0]]), _TYPICAL_DIP_RAD
    along = [
        float(u[len(u) // 2] @ d[len(u) // 2])
        for u, d in epochs
        if np.isfinite(d[len(u) // 2]).all()
    ]
    if not along:
        return down, _TYPICAL_DIP_RAD
    dip = float(np.median(np.arcsin(np.clip(along, -1.0, 1.0))))
    return down, float(np.clip(dip, -_STEEPEST_RAD, _STEEPEST_RAD))


def observability(covariance: Array, W: Array) -> Observability:
    """Compare the posterior of [M (6), b (3), w_b (3)] with the prior, direction by direction.

    W (12, 12) whitens the prior.
    """
    scaled = W @ covariance @ W.T
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    ratio = np.sqrt(np.clip(values, 0.0, None))
    return Observability(
        prior_ratio=ratio,
        unobservable=_blind_names(vectors[:, ratio > BLIND]),
        score=float(_FLOOR / max(float(ratio[-1]), 1e-9)),
    )


def _blind_names(vectors: Array) -> tuple[str, ...]:
    """One name for each dimension of the subspace that the orthonormal vectors (12, K) span.

    Eigenvectors of equal eigenvalues are any basis, another on each processor. So the parameter
    that lies nearest to the subspace is taken, then the nearest to what is left of it: with
    |P_ij| <= sqrt(P_ii P_jj) it leads its own projection, and no two names begin alike.
    """
    P = vectors @ vectors.T
    names = []
    for _ in range(vectors.shape[1]):
        lead = int(np.argmax(np.round(np.diag(P), 6)))
        v = P[:, lead] / np.sqrt(P[lead, lead])
        others = [i for i in np.argsort(-np.abs(v), kind="stable") if i != lead and abs(v[i]) > 0.4]
        names.append(" + ".join(_NAMES[i] for i in [lead, *others[:2]]))
        P = P - np.outer(v, v)
    return tuple(names)
