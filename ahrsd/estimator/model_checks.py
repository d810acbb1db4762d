"""Whether a settled window contradicts the model: an iron that changed, axes that are turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.estimator import chain
from ahrsd.estimator.epoch import TURN, InformationStack, believed, disagreement, instrument
from ahrsd.estimator.graph import Graph, retract
from ahrsd.samples import Array

# -- A change of the iron --------------------------------------------------------------------------
#
# Whether the iron has changed: an epoch contradicts a sure calibration, or two parts of all do.
#
# A magnet that passes disturbs some rows; one that stays with the sensor disturbs them all, and
# another hard iron explains what it does. A field that differs from place to place does neither.
#
# A change before the answer was sure leaves a mixture that no epoch agrees with. There, a second
# hard iron from some epoch on must take most of the disagreement away, more than what an instrument
# may have besides iron and bias (`epoch.instrument`): a lag of the field looks like a change to few
# epochs.
#
# Where it does not, but earlier and later data still ask for different irons by more than the
# covariance allows (a drift, a change amid other trouble, two places), the answer is in between,
# and known no better than that.

_HARD = slice(6, 9)
_CHI2, _CALMED = 100.0, 3.0  # of a second hard iron; times by which the disagreement must fall
_SIDE = 2  # epochs before and behind: a single one may have been somewhere else
_LEAST = 0.03  # of the field: a smaller change may be a place
_CHANCE = 12.0  # chi squared of the best of all times, in units of the misfit, that chance makes


def change_message(at_s: float) -> str:
    """The line for the log about a change of the iron at that time."""
    return f"the iron changed at about {at_s:.0f} s: calibrated anew from there"


@dataclass(frozen=True, slots=True)
class Division:
    """What two parts of the data say of each other.

    first: which of the epochs is the first of those that another hard iron explains; None if none
        is
    parted: by how much the variance of the answer is larger for what they differ, at least 1
    """

    first: int | None
    parted: float


def divided(
    epochs: InformationStack, graph: Graph, sigma_bias: float, sigma_b: float
) -> Division | None:
    """Whether a second hard iron is asked for from some epoch on; None for too few epochs.

    epochs: what they say (`epoch.informations`) at a settled calibration, linear around it.
    sigma_bias (rad/s) and sigma_b (gauss): what is believed of gyro bias and of a change
    without data.
    """
    Hs, gs = epochs
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


# -- Turned axes -----------------------------------------------------------------------------------
#
# Is the magnetometer turned against the gyro?  The antisymmetric part of a 3x3 correction.
#
# The estimator's A is symmetric: the magnetometer's axes are taken to be the gyro's. What the
# epochs ask for beyond that (`epoch.instrument`), in sigmas, is the evidence.

_EVIDENCE = 30.0  # chi squared with 3 degrees of freedom: once in a million where there is none
_MISFIT = 5.0
_WORTH_RAD = 0.002  # less is not worth a correction of its own


@dataclass(frozen=True, slots=True, eq=False)
class Misalignment:
    """Rotation vector theta (3,) in rad from the gyro's to the magnetometer's axes.

    covariance (3, 3), chi2: theta in sigmas, squared; misfit: how much the epochs still disagree,
    because a lag or a wandering field can look like a rotation; correction: C (3, 3) and b that
    include it, det C = 1, and give the field in the gyro's axes.
    """

    rotation_rad: Array
    covariance: Array
    chi2: float
    misfit: float
    correction: Affine

    @property
    def significant(self) -> bool:
        """Whether the full correction should be preferred to the symmetric one."""
        worth = float(np.linalg.norm(self.rotation_rad)) > _WORTH_RAD
        return worth and self.chi2 > _EVIDENCE and self.misfit < _MISFIT


def misalignment(
    epochs: InformationStack, graph: Graph, sigma_bias: float, taken_rad: Array
) -> Misalignment:
    """From what the epochs of a settled window say.  LinAlgError where the motion does not tell.

    taken_rad (3,): turn that is taken out of the gyro's angles already
    """
    found = instrument(epochs, graph, sigma_bias)
    theta, spread = taken_rad + found.step[TURN], found.covariance[TURN, TURN]
    c = retract(graph.c, found.step[:9], graph.moments)
    C = so3.exp(-theta[None])[0] @ np.linalg.inv(chain.symmetric(c[:6]))
    full = Affine(C / np.cbrt(np.linalg.det(C)), c[6:9].copy())
    chi2 = float(theta @ np.linalg.solve(spread, theta))
    return Misalignment(theta, spread, chi2, found.misfit, full)
