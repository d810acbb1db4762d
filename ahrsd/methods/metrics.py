"""How far a calibration is from the truth, and how well it does without one.

Error norms of hard iron and gyro bias, two distances between soft irons, the normalised standard
deviation of the field ([R] 4.4) and the heading's RMSE.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from ahrsd.headings import wrapped
from ahrsd.samples import Array


def error_norm(found: Array, truth: Array) -> float:
    """|found - truth|: of hard irons (3,) in gauss or gyro biases (3,) in rad/s."""
    return float(np.linalg.norm(found - truth))


def soft_iron_frobenius(found: Array, truth: Array) -> float:
    """|A - A_true|_F of (3, 3) matrices, at the scale they have."""
    return float(np.linalg.norm(found - truth))


def soft_iron_geodesic(found: Array, truth: Array) -> float:
    """|log(A^-1/2 A_true A^-1/2)|_F, which no common change of coordinates alters.

    Both (3, 3) symmetric positive definite, else ValueError.
    """
    try:
        values = eigh(truth, found, eigvals_only=True)
    except np.linalg.LinAlgError as error:
        raise ValueError("a soft iron is not positive definite") from error
    if not np.all(values > 0):
        raise ValueError("a soft iron is not positive definite")
    return float(np.linalg.norm(np.log(values)))


def field_spread(corrected: Array) -> float:
    """Standard deviation of |h| over its mean, of corrected fields (N, 3); 0 is perfect."""
    size = np.linalg.norm(corrected, axis=1)
    return float(np.std(size) / np.mean(size))


def corrected(raw_b_gauss: Array, soft_iron: Array | None, hard_iron_gauss: Array) -> Array:
    """A^-1 (m - b) of readings (N, 3); without a soft iron m - b."""
    centred = raw_b_gauss - hard_iron_gauss
    if soft_iron is None:
        return centred
    return np.asarray(np.linalg.solve(soft_iron, centred.T).T, dtype=np.float64)


def heading_rad(field_b: Array, R_nb: Array, declination_rad: float = 0.0) -> Array:
    """True heading (N,) of corrected fields (N, 3) levelled by R_nb ([R] 2.1-2.2).

    heading = atan2(-m_y, m_x) in the levelled frame, plus the declination, positive to the east.
    """
    pitch = np.arcsin(np.clip(-R_nb[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(R_nb[:, 2, 1], R_nb[:, 2, 2])
    x, y, z = field_b.T
    across = np.cos(roll) * y - np.sin(roll) * z
    along = np.cos(pitch) * x + np.sin(pitch) * (np.sin(roll) * y + np.cos(roll) * z)
    return wrapped(np.arctan2(-across, along) + declination_rad)


def heading_rmse_deg(field_b: Array, R_nb: Array, field_n_gauss: Array) -> float:
    """RMSE in deg of the heading from corrected fields (N, 3) against that of R_nb (N, 3, 3)."""
    declination = float(np.arctan2(field_n_gauss[1], field_n_gauss[0]))
    true = np.arctan2(R_nb[:, 1, 0], R_nb[:, 0, 0])
    error = wrapped(heading_rad(field_b, R_nb, declination) - true)
    return float(np.degrees(np.sqrt(np.mean(error**2))))
