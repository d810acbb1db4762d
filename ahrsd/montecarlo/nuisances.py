"""What an ordinary instrument and an ordinary place add to the readings, for the extended bound.

The sizes are the estimator's own (`estimator/parameters.py`): one table. How they act is derived
here again, from the readings and not from the estimator's residuals:

    turn, scale, shape   the gyro reads (1 + E) w, E = [theta]x + s 1 + a symmetric traceless matrix
    lag                  the field read is that of a time tau before: - tau M du/dt, du/dt = -w x u
    drift                offsets go at one rate: the gyro's bias is that of the end, the iron's the
                         mean
    place                the field in the world differs by a course of straight pieces, in its axes
    noise not white      the same in the sensor's axes
"""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.estimator.parameters import ASSEMBLED, ORDINARY, Imperfections, Surroundings
from ahrsd.montecarlo.cramer_rao import Nuisances, Trajectory
from ahrsd.samples import Array

_ROOT = np.sqrt(1.5)  # straight between independent values, the mean square is 2/3 of theirs
_THIRD = 1 / np.sqrt(3.0)
#: the five ways in which the gyro's scales differ and its axes are not at right angles
SHAPES = np.array(
    [
        [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]],
        [[_THIRD, 0.0, 0.0], [0.0, _THIRD, 0.0], [0.0, 0.0, -2 * _THIRD]],
        [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
        [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)


def together(*parts: Nuisances) -> Nuisances:
    """All of them."""
    return Nuisances(
        np.concatenate([part.field_gauss for part in parts], axis=2),
        np.concatenate([part.rate_rad_s for part in parts], axis=2),
    )


def lag(trajectory: Trajectory, soft_iron: Array, sigma_s: float) -> Nuisances:
    """The field is late against the gyro by a time that is known to this much.

    At the first sample it turns as in the step behind it.
    """
    rate = np.nan_to_num(np.vstack([trajectory.rate_b_rad_s[1:2], trajectory.rate_b_rad_s[1:]]))
    late = np.cross(rate, trajectory.field_b) @ soft_iron.T * sigma_s
    return Nuisances(late[:, :, None], np.zeros((len(late), 3, 0)))


def instrument(
    trajectory: Trajectory, soft_iron: Array, kind: Imperfections = ASSEMBLED
) -> Nuisances:
    """Turned axes, lag, the gyro's scales, and the drift of both offsets: (N, 3, 4) and 12."""
    rate, time_s = np.nan_to_num(trajectory.rate_b_rad_s), times_s(trajectory)
    span_s = max(float(time_s[-1]), 1e-9)
    generators = np.concatenate(
        [kind.turn_rad * so3.skew(np.eye(3)), kind.scale * np.eye(3)[None], kind.shape * SHAPES]
    )
    angles = np.einsum("kij,nj->nik", generators, rate)
    until = (time_s / span_s - 1.0)[:, None, None]
    drift = kind.bias_rad_s * until * np.eye(3)
    iron = kind.iron_gauss * (until + 0.5) * np.eye(3)
    late = lag(trajectory, soft_iron, kind.lag_s).field_gauss
    return Nuisances(np.concatenate([late, iron], axis=2), np.concatenate([angles, drift], axis=2))


def surroundings(
    trajectory: Trajectory,
    soft_iron: Array,
    noise_mag_gauss: float,
    kind: Surroundings = ORDINARY,
) -> Nuisances:
    """A field that differs by place, and noise that is not white: (N, 3, 6 K), none of the gyro."""
    n = len(trajectory.field_b)
    share = hats(times_s(trajectory), kind.knot_s)
    place = soft_iron @ np.swapaxes(attitude(trajectory), 1, 2) * (_ROOT * kind.place_gauss)
    own = np.broadcast_to(np.eye(3) * (_ROOT * kind.coloured * noise_mag_gauss), (n, 3, 3))
    columns = [np.einsum("nk,nij->nijk", share, each).reshape(n, 3, -1) for each in (place, own)]
    return Nuisances(np.concatenate(columns, axis=2), np.zeros((n, 3, 0)))


def ordinary(trajectory: Trajectory, soft_iron: Array, noise_mag_gauss: float) -> Nuisances:
    """All that an instrument put together from parts, at an ordinary place, adds."""
    return together(
        instrument(trajectory, soft_iron), surroundings(trajectory, soft_iron, noise_mag_gauss)
    )


def times_s(trajectory: Trajectory) -> Array:
    """Times since the first sample (N,); a gap counts as no time."""
    return np.cumsum(np.r_[0.0, np.nan_to_num(trajectory.dt_s[1:])])


def attitude(trajectory: Trajectory) -> Array:
    """Sensor to world (N, 3, 3), the world being where the sensor began."""
    angle = np.nan_to_num(trajectory.rate_b_rad_s[1:] * trajectory.dt_s[1:, None])
    return np.concatenate([np.eye(3)[None], so3.products(so3.exp(angle))])


def hats(time_s: Array, knot_s: float) -> Array:
    """Shares (N, K) of values `knot_s` apart, straight in between."""
    at = time_s / knot_s
    knots = np.arange(int(np.ceil(at[-1])) + 1)
    return np.clip(1.0 - np.abs(at[:, None] - knots), 0.0, None)
