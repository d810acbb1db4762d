"""What is believed of a calibration before the data, and the first place to look for it.

Gaussian, and a thousand times too wide to matter where the motion shows anything.  Where it does
not, it keeps the calibration from running after slow noise: at rest A and b would go anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis.calibration_fit.coarse import noise_of
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    nuisance_columns,
    sensitivities,
)
from ahrsd.diagnosis.track import Track
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

#: prior deviations of the 11: soft iron about I, hard iron (gauss) about 0, gyro bias (rad/s)
PRIOR = np.array([0.15] * 5 + [0.5] * 3 + [0.03] * 3)
PRIOR.flags.writeable = False
#: scatter of the field over its size that shows the iron
TURNED = 0.1
_BLOCKS = 40  # in which the scores are summed
_REPEATED = 3.0  # repetition from which the prior is made to count
#: what the mean of a resting gyro may differ from its bias, where the field shows that it rests
_AT_REST_RAD_S = 1e-3
_SPHERE_ROWS, _NO_SPHERE = 100, 0.1  # rows that a recording counts for, and how far from a sphere


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is believed before the data: mean and deviation (11,), in the order of the fit.

    repetition: of how many data one says something new: the deviations are for that many
    """

    mean: Array
    deviation: Array
    repetition: float = 1.0

    def sharper(self, repetition: float) -> Prior:
        """For data of which only one in `repetition` says anything new; itself where all do."""
        if repetition < _REPEATED:
            return self
        sharp = self.deviation / np.sqrt(repetition / self.repetition)
        return Prior(self.mean, sharp, repetition)


def prior_of(track: Track) -> Prior:
    """The usual one; where the sensor rests for long, its gyro reads its bias.

    Iron shows itself by turning only.  Without turning, slow noise of the magnetometer would be
    laid at its door, so the less the field turned, the closer the iron is held.
    """
    mean, deviation = np.zeros(11), PRIOR.copy()
    deviation[:8] *= np.clip(turned(track.mag_b_gauss) / TURNED, 0.02, 1.0)
    rest = rate_at_rest(track)
    if rest is not None:
        mean[8:] = rest.rate_rad_s
        deviation[8:] = np.minimum(np.hypot(_AT_REST_RAD_S, rest.unseen_rad_s), PRIOR[8:])
    return Prior(mean, deviation)


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Still seconds: the gyro's mean reading (3,), and the rate that the field may hide there."""

    rate_rad_s: Array
    unseen_rad_s: float


def rate_at_rest(track: Track) -> Rest | None:
    """What the gyro reads in the still seconds, None where fewer than a fifth are still.

    Still: neither the readings' scatter within the second nor the magnetometer's mean against the
    second before is more than their noise.  What turns slower than that is unseen in one second;
    in all of them together it is what their steps have beyond the noise, and twice its deviation.
    """
    mag_noise, gyro_noise = noise_of(track)
    rows = max(8, round(1.0 / max(track.step_s, 1e-6)))
    whole = len(track) // rows * rows
    if whole < 5 * rows:
        return None
    mag = track.mag_b_gauss[:whole].reshape(-1, rows, 3)
    gyro = track.gyro_b_rad_s[:whole].reshape(-1, rows, 3)
    moved = np.linalg.norm(np.diff(mag.mean(axis=1), axis=0, prepend=np.nan), axis=1)
    still = (
        (np.max(gyro.std(axis=1), axis=1) < 2 * gyro_noise)
        & (np.max(mag.std(axis=1), axis=1) < 2 * mag_noise)
        & (moved < 6 * mag_noise / np.sqrt(rows) + 1e-4)
    )
    if np.count_nonzero(still) < 0.2 * len(still):
        return None
    steps = np.square(moved[still & np.isfinite(moved)])
    by_noise = 6.0 * mag_noise**2 / rows
    beyond = max(float(np.mean(steps)) - by_noise, 0.0)
    unseen = beyond + 2.0 * by_noise * np.sqrt(2.0 / (3.0 * len(steps)))
    rate = np.median(gyro[still].mean(axis=1), axis=0)
    size_gauss = max(track.usual_gauss, 1e-12)
    return Rest(np.asarray(rate), float(np.sqrt(unseen)) / (size_gauss * rows * track.step_s))


def turned(mag: Array) -> float:
    """Scatter of the field (N, 3) over its size; 0 where there is no field."""
    seen = mag[np.isfinite(mag).all(axis=1)]
    if not len(seen):
        return 0.0
    size = float(np.median(np.linalg.norm(seen, axis=1)))
    return float(np.linalg.norm(np.std(seen, axis=0))) / max(size, 1e-12)


def sphere_centre(mag: Array) -> Array:
    """Centre of the sphere |m - b| = r, |m|^2 = 2 m.b + c, drawn to 0 where the motion is poor."""
    if not len(mag):
        return np.zeros(3)
    square = np.sum(mag**2, axis=1)
    off = 2 * (mag - mag.mean(axis=0))
    weight = _SPHERE_ROWS / len(mag) / (_NO_SPHERE * float(np.mean(square))) ** 2
    gram = weight * off.T @ off + np.diag(1 / PRIOR[5:8] ** 2)
    return np.asarray(np.linalg.solve(gram, weight * off.T @ (square - square.mean())))


def ellipsoid(mag: Array) -> tuple[Array, Array] | None:
    """Soft iron of trace 3 and hard iron (gauss) of the ellipsoid through the readings (N, 3).

    |m|^2 + q.(m^T T m) = 2 m.u + c with the traceless directions T of a quadric I + q.T, least
    squares: exact where the magnetometer has no noise, drawn to nothing.  None where it is open.
    """
    middle = mag.mean(axis=0)
    m = mag - middle
    squares = np.einsum("ni,aij,nj->na", m, TRACELESS, m)
    columns = np.column_stack([-squares, 2.0 * m, np.ones(len(m))])
    found = np.linalg.lstsq(columns, np.sum(m**2, axis=1), rcond=None)[0]
    quadric = np.eye(3) + np.einsum("a,aij->ij", found[:5], TRACELESS)
    values, vectors = np.linalg.eigh(quadric)
    if values[0] <= 0.0:
        return None
    A = (vectors / np.sqrt(values)) @ vectors.T
    return A * 3.0 / np.trace(A), middle + np.linalg.solve(quadric, found[5:8])


def repetition_of(done: Filtered) -> float:
    """How many times larger the variance of the scores is than if the innovations were white.

    A misfit that lasts makes the data look surer than they are: of the sum of a block's scores
    white innovations have the block's information as variance.  1 on a null.
    """
    X = sensitivities(done, nuisance_columns(done))
    score = np.einsum("nia,ni->na", X, done.whitened)
    edges = np.linspace(0, len(score), _BLOCKS + 1).astype(int)[:-1]
    sums = np.add.reduceat(score, edges, axis=0)
    flat = X.reshape(-1, 11)
    ridge = np.diag(1.0 / PRIOR**2)
    ratio = np.trace(np.linalg.solve(flat.T @ flat + ridge, sums.T @ sums))
    return float(ratio / 11 / (1 - 11 / _BLOCKS))
