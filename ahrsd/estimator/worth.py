"""What an estimate is worth: scale as a gauge, the heading's sigma, and what would shrink it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd import so3
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
    u, across = _headings(down_b, dip_rad)
    along = across @ np.linalg.inv(chain.symmetric(c[:6]))
    J = np.concatenate([chain.symmetric_columns(u), np.tile(np.eye(3), (len(u), 1, 1))], axis=2)
    row = (along[:, None, :] @ J)[:, 0]
    variance = np.sum((row @ covariance[:9, :9]) * row, axis=1)
    return float(np.degrees(np.sqrt(max(float(np.max(variance)), 0.0))))


def turned_heading_deg(turn_rad: Array, down_b: Array, dip_rad: float) -> float:
    """Worst heading error over the same headings where the magnetometer's axes are turned (3,)."""
    u, across = _headings(down_b, dip_rad)
    return float(np.degrees(np.max(np.abs(np.sum(np.cross(turn_rad, u) * across, axis=1)))))


def _headings(down_b: Array, dip_rad: float) -> tuple[Array, Array]:
    """Field directions (n, 3) over 12 headings at each tilt, and what turns each heading (n, 3)."""
    psi = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    helper = np.eye(3)[np.argmin(np.abs(down_b), axis=1)]
    north = np.cross(helper, down_b)
    north /= np.linalg.norm(north, axis=1, keepdims=True)
    east = np.cross(down_b, north)
    level = np.cos(psi)[:, None, None] * north + np.sin(psi)[:, None, None] * east
    u = (np.cos(dip_rad) * level + np.sin(dip_rad) * down_b).reshape(-1, 3)
    return u, np.cross(down_b, level).reshape(-1, 3) / np.cos(dip_rad)


_TELLS_DEG = 0.5  # a heading that is known better needs no advice
_MOTION = "the motion so far tells too little: {}"
_WIDENED = {
    "misfit": "the field differs with place or attitude, or the iron changes meanwhile: repeat the "
    "motion at another place, away from steel and currents, once it is warm; `ahrsd diagnose` of "
    "the recording says what it is",
    "axes": "the magnetometer's axes may be turned against the gyro's: roll and pitch as well",
    "turned": "the magnetometer's axes are turned against the gyro's: mount them alike, or take "
    "the correction that `ahrsd calibrate` of a recording gives for it",
    "lag": "the field's readings may be late: turn fast and slow, both ways",
    "scales": "the gyro's scales may be off by a percent: turn about every axis, and back again",
    "bias": "the gyro's bias may still follow its temperature: go on until it is warm",
}
_LEAN_RAD = float(np.radians(30.0))
_AS_WELL = 1.5  # times the least sigma that counts as the same
_SECONDS, _ROWS = 60.0, 20.0  # that a manoeuvre lasts, and readings at each of its attitudes


def motion_and_misfit(plain: Array, answer: Array, W: Array) -> dict[str, Array]:
    """The answer's covariance (12, 12) of [M, b, w_b] shared out between motion and misfit.

    plain (12, 12): what it were if the model explained the data; W whitens the prior. What misfit
    does to a direction that is left undetermined is the motion's doing: the data say too little of
    it to outweigh what they always leave over, and another place would change nothing.
    """
    scaled = W @ answer @ W.T
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    blind = vectors[:, values > BLIND**2]
    at_blind = np.linalg.solve(W, blind @ blind.T @ W)
    others = np.eye(len(W)) - at_blind
    more = answer - plain
    return {
        "motion": plain + at_blind @ more @ at_blind.T,
        "misfit": others @ more @ others.T,
    }


@dataclass(frozen=True, slots=True, eq=False)
class HeadingAdvice:
    """What `widened_by` asks: the calibration c (9,) = [M, b], attitudes and dip that were driven.

    down, dip_rad: as for `heading_sigma_deg`; noise_gauss: of one reading
    """

    c: Array
    down: Array
    dip_rad: float
    noise_gauss: float

    def widened_by(
        self, parts: Mapping[str, Array], covariance: Array, turned_deg: float = 0.0
    ) -> str:
        """What makes more than half of the heading's variance, in words; empty: it is known well.

        covariance (12, 12): the answer's; parts: covariances (12, 12) by "motion" and the names of
        `_WIDENED`, which add up to it but for what they have in common; turned_deg: what axes that
        were found to be turned make of the heading
        """
        if not np.hypot(self._sigma_deg(covariance), turned_deg) > _TELLS_DEG:
            return ""
        variances = {name: self._sigma_deg(one) ** 2 for name, one in parts.items()}
        variances["turned"] = turned_deg**2
        most = max(variances, key=lambda name: variances[name])
        if not variances[most] > 0.5 * sum(variances.values()):
            return ""
        if most == "motion":
            return _MOTION.format(self.manoeuvre(covariance))
        return _WIDENED[most]

    def manoeuvre(self, covariance: Array) -> str:
        """The easiest of a turn, a roll and a pitch after which the heading is known as well as
        after any of them."""
        sigma = np.sqrt(np.diag(covariance))
        size = np.outer(sigma, sigma)
        known = np.linalg.inv(covariance / size)
        after = {
            name: self._sigma_deg(size * np.linalg.inv(known + self._told(attitudes) * size))
            for name, attitudes in self._manoeuvres().items()
        }
        least = min(after.values())
        return next((name for name in after if after[name] <= _AS_WELL * least), "turn and lean")

    def _sigma_deg(self, covariance: Array) -> float:
        return heading_sigma_deg(self.c, covariance, self.down, self.dip_rad)

    def _manoeuvres(self) -> dict[str, list[Array]]:
        """Attitudes (n, 3, 3) from the level to the sensor, one after the other, in pieces."""
        mean = np.mean(self.down, axis=0)
        level = _level(mean / np.linalg.norm(mean))
        headings = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
        turned = so3.exp(headings[:, None] * level[:, 2]) @ level
        lean = _LEAN_RAD * np.sin(headings)[:, None]
        found = {"turn through all headings": [turned]}
        for name, axis in (("roll", [1.0, 0.0, 0.0]), ("pitch", [0.0, 1.0, 0.0])):
            leant = so3.exp(lean * np.array(axis))
            found[f"{name} by 30 deg both ways, on four headings"] = [
                leant @ one for one in turned[::3]
            ]
        return found

    def _told(self, pieces: Sequence[Array]) -> Array:
        """Information (12, 12) of a manoeuvre; where each piece begins to point is not known.

        As much for a manoeuvre of several pieces as of one.
        """
        M = chain.symmetric(self.c[:6])
        field = np.array([np.cos(self.dip_rad), 0.0, np.sin(self.dip_rad)])
        across = so3.tangent_basis(field[None])[0]
        total = np.zeros((12, 12))
        for R in pieces:
            columns = chain.symmetric_columns(R @ field)
            gone = np.cumsum(np.swapaxes(R, 1, 2), axis=0) * (_SECONDS / len(pieces) / len(R))
            bias = -M @ R @ so3.skew(field) @ gone  # the gyro's error in the level, by its bias
            iron = np.concatenate([columns, np.tile(np.eye(3), (len(R), 1, 1)), bias], axis=2)
            J = np.concatenate([iron, M @ R @ across], axis=2).reshape(-1, 14)
            H = J.T @ J
            own = H[:12, :12] - H[:12, 12:] @ np.linalg.solve(H[12:, 12:], H[12:, :12])
            total += own / len(pieces)
        return total * _ROWS / self.noise_gauss**2


def _level(down: Array) -> Array:
    """Columns north, east, down (3, 3) in the sensor's frame, north in some direction."""
    north = np.cross(np.eye(3)[np.argmin(np.abs(down))], down)
    north /= np.linalg.norm(north)
    return np.column_stack([north, np.cross(down, north), down])


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
        unobservable=blind_names(vectors[:, ratio > BLIND]),
        score=float(_FLOOR / max(float(ratio[-1]), 1e-9)),
    )


def blind_names(vectors: Array) -> tuple[str, ...]:
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
