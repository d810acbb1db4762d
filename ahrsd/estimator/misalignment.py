"""Is the magnetometer turned against the gyro?  The antisymmetric part of a 3x3 correction.

The estimator's A is symmetric: the magnetometer's axes are taken to be the gyro's. What the epochs
ask for beyond that (`instrument.py`), in sigmas, is the evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.estimator import chain
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.instrument import TURN, Said, instrument
from ahrsd.estimator.retraction import retract
from ahrsd.samples import Array

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


def misalignment(said: Said, graph: Graph, sigma_bias: float) -> Misalignment:
    """From what the epochs of a settled window say.  LinAlgError where the motion does not tell."""
    found = instrument(said, graph, sigma_bias)
    theta, spread = found.step[TURN], found.covariance[TURN, TURN]
    c = retract(graph.c, found.step[:9], graph.moments)
    C = so3.exp(-theta[None])[0] @ np.linalg.inv(chain.symmetric(c[:6]))
    full = Affine(C / np.cbrt(np.linalg.det(C)), c[6:9].copy())
    chi2 = float(theta @ np.linalg.solve(spread, theta))
    return Misalignment(theta, spread, chi2, found.misfit, full)
