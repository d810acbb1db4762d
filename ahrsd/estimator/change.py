"""Whether the iron has changed: an epoch contradicts a sure calibration, or two parts of all do.

A magnet that passes disturbs some rows; one that stays with the sensor disturbs them all, and
another hard iron explains what it does. A field that differs from place to place does neither.

A change before the answer was sure leaves a mixture that no epoch agrees with. There, a second hard
iron from some epoch on must take most of the disagreement away, more than what an instrument may
have besides iron and bias (`instrument.py`): a lag of the field looks like a change to few epochs.

Where it does not, but earlier and later data still ask for different irons by more than the
covariance allows (a drift, a change amid other trouble, two places), the answer is in between, and
known no better than that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.epoch import WindowEpoch
from ahrsd.estimator.excitation import spread
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.instrument import Said, believed, disagreement
from ahrsd.samples import Array

_MOST_ROWS = 0.6
_ATTITUDES = 0.1  # rad, spread of the field's direction over the rows that contradict
_EXPLAINED = 0.9  # share of the epoch's cost that another hard iron alone must take away
_HARD = slice(6, 9)
_CHI2, _CALMED = 100.0, 3.0  # of a second hard iron; times by which the disagreement must fall
_SIDE = 2  # epochs before and behind: a single one may have been somewhere else
_LEAST = 0.03  # of the field: a smaller change may be a place
_CHANCE = 12.0  # chi squared of the best of all times, in units of the misfit, that chance makes
_FREE = np.r_[6:9, 12:16]  # hard iron and borders among the numbers of `chain.Quadratic`


def change_message(at_s: float) -> str:
    """The line for the log about a change of the iron at that time."""
    return f"the iron changed at about {at_s:.0f} s: calibrated anew from there"


def contradicts(
    epoch: WindowEpoch, c: Array, covariance: Array, usual: chain.Noise, limit_sigma: float
) -> bool:
    """Most of its rows are beyond what noise and the covariance (9, 9) of c allow, and b mends it.

    They must be of more than one attitude: in one, another iron and another place are the same.

    Its directions must still be where the epoch was linearised, at c.
    """
    u = chain.move(epoch.u, epoch.quadratic, np.zeros(chain.WIDTH))
    J = chain.symmetric_columns(epoch.data.seen(u))
    J = np.concatenate([J, np.broadcast_to(np.eye(3), (len(u), 3, 3))], axis=2)
    known = np.sum((J @ covariance) * J, axis=(1, 2))
    error = np.sum(epoch.data.field_error(u, c) ** 2, axis=1)
    beyond = error > limit_sigma**2 * (usual.mag_gauss**2 / epoch.data.count + known)
    if not epoch.turned or float(np.mean(beyond)) <= _MOST_ROWS:
        return False
    if spread(u[beyond]) < _ATTITUDES:
        return False
    q = epoch.quadratic
    H, g = q.H[np.ix_(_FREE, _FREE)], q.g[_FREE]
    explained = 0.5 * g @ np.linalg.lstsq(H, g, rcond=1e-12)[0]
    return bool(explained > _EXPLAINED * q.cost)


@dataclass(frozen=True, slots=True)
class Division:
    """What two parts of the data say of each other.

    first: which of the epochs is the first of those that another hard iron explains; None if none
        is
    parted: by how much the variance of the answer is larger for what they differ, at least 1
    """

    first: int | None
    parted: float


def divided(said: Said, graph: Graph, sigma_bias: float, sigma_b: float) -> Division | None:
    """Whether a second hard iron is asked for from some epoch on; None for too few epochs.

    said: what they say (`instrument.py`) at a settled calibration: linear around it.
    sigma_bias (rad/s) and sigma_b (gauss): what is believed of gyro bias and of a change
    without data.
    """
    Hs, gs = said
    if len(Hs) < 2 * _SIDE:
        return None
    H, g = believed(graph, sigma_bias)
    H, g = H + Hs.sum(axis=0), g + gs.sum(axis=0)
    steps, chi2 = _seconds(H, g, Hs, gs, np.eye(3) * graph.temper / sigma_b**2)
    first = int(np.argmax(chi2[_SIDE - 1 : len(Hs) - _SIDE])) + _SIDE
    step, change = steps[first - 1, :-3], steps[first - 1, -3:]
    own = np.tile(step, (len(Hs), 1))
    own[first:, _HARD] += change
    one = disagreement(Hs, gs, -np.linalg.solve(H, g))
    two = max(1.0, disagreement(Hs, gs, own))
    size = float(np.cbrt(np.linalg.det(chain.symmetric(graph.c[:6]))))
    told = chi2[first - 1] > _CHI2 * two and one > _CALMED * two
    told = told and bool(np.linalg.norm(change) > _LEAST * size)
    parted = max(1.0, float(np.max(chi2)) / (graph.temper * _CHANCE))
    return Division(first if told else None, parted)


def _seconds(H: Array, g: Array, Hs: Array, gs: Array, prior: Array) -> tuple[Array, Array]:
    """Steps (N - 1, 20) and chi squared (N - 1,) of a second hard iron from each epoch on."""
    late_H = np.cumsum(Hs[:0:-1], axis=0)[::-1]
    late_g = np.cumsum(gs[:0:-1], axis=0)[::-1]
    n = len(g)
    both = np.empty((len(late_H), n + 3, n + 3))
    both[:, :n, :n] = H
    both[:, :n, n:], both[:, n:, :n] = late_H[:, :, _HARD], late_H[:, _HARD]
    both[:, n:, n:] = late_H[:, _HARD, _HARD] + prior
    gradient = np.column_stack([np.broadcast_to(g, (len(late_g), n)), late_g[:, _HARD]])
    covariance = np.linalg.inv(both)
    steps = -(covariance @ gradient[:, :, None])[:, :, 0]
    change = steps[:, n:, None]
    return steps, np.sum(change * np.linalg.solve(covariance[:, n:, n:], change), axis=(1, 2))
