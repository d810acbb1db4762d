"""Is the magnetometer turned against the gyro?  The antisymmetric part of a 3x3 correction.

The estimator's A is symmetric: the magnetometer's axes are taken to be the gyro's. If they are not,
the rate in the magnetometer's frame is R w with R = Exp(theta), and a step's rotation is R phi. One
Gauss-Newton step from the answer gives theta beside M, b and the bias; its size in sigmas is the
evidence. Derivative: dq/dtheta = dq/dphi dphi/dtheta = (dq/dw_b / dt) [phi]x. Every epoch of the
window stands alone here, its borders free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.estimator import chain
from ahrsd.estimator.epoch import Epoch
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.retraction import moved
from ahrsd.samples import Array

_TURN = slice(12, 15)
_SIZE = 15
_EVIDENCE = 30.0  # chi squared with 3 degrees of freedom: once in a million where there is none
_MISFIT = 5.0
_WEAKEST = 1e-4  # scaled information of a direction of which an epoch says something
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


def misalignment(epochs: Sequence[Epoch], graph: Graph, sigma_bias: float) -> Misalignment:
    """From the epochs of a settled window.  LinAlgError where the motion does not tell."""
    own = [
        _information(epoch, graph.c, graph.nodes[epoch.a].bias) for epoch in epochs if epoch.turned
    ]
    if not own:
        raise np.linalg.LinAlgError("no epoch with motion")
    H, g = np.sum([h for h, _ in own], axis=0), np.sum([k for _, k in own], axis=0)
    mean, information = graph.anchor
    H[:9, :9] += graph.temper * information + graph.hold
    g[:9] += (graph.temper * information + graph.hold) @ (graph.c - mean)
    H[9:12, 9:12] += np.eye(3) / sigma_bias**2
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
    covariance = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
    step = -covariance @ g
    theta = step[_TURN]
    misfit = max(1.0, _disagreement(own, step))
    spread = misfit * covariance[_TURN, _TURN]
    c = moved(graph.c, step[:9], graph.moments)
    C = so3.exp(-theta[None])[0] @ np.linalg.inv(chain.symmetric(c[:6]))
    full = Affine(C / np.cbrt(np.linalg.det(C)), c[6:9].copy())
    chi2 = float(theta @ np.linalg.solve(spread, theta))
    return Misalignment(theta, spread, chi2, misfit, full)


def _disagreement(own: Sequence[tuple[Array, Array]], step: Array) -> float:
    """Mean square per degree of freedom of what each epoch still asks for after the step."""
    total, count = 0.0, 0
    for H, g in own:
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
        values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
        good = values > _WEAKEST
        asked = (vectors.T @ (scale * (g + H @ step)))[good]
        total += float(np.sum(asked**2 / values[good]))
        count += int(np.count_nonzero(good))
    return total / max(count - _SIZE, 0.2 * count)


def _information(epoch: Epoch, c: Array, bias: Array) -> tuple[Array, Array]:
    """H (15, 15) and gradient on [M (6), b (3), w_b (3), theta (3)], all directions eliminated."""
    data, u = epoch.data, epoch.u
    field, motion = chain.parts(data, u, c, bias, epoch.used, epoch.weights)
    dt = data.dt_s[1:, None, None]
    turn = motion.J_bias / dt @ so3.skew(data.angle_b_rad[1:])
    diag, upper, border = chain.interior(field, motion)
    columns = np.zeros((len(u), 2, _SIZE + 1))
    columns[:, :, :12], columns[:, :, _SIZE] = border[:, :, :12], border[:, :, 12]
    columns[1:, :, _TURN] -= motion.scale[:, None, None] * turn
    columns[:-1, :, _TURN] += np.swapaxes(motion.J_prev, 1, 2) @ turn
    H, g = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE)
    Jx = field.J_x.reshape(-1, chain.SHARED)
    Jw = np.concatenate([motion.J_bias, turn], axis=2).reshape(-1, 6)
    H[:9, :9], g[:9] = Jx.T @ Jx, Jx.T @ field.r.ravel()
    H[9:, 9:], g[9:] = Jw.T @ Jw, Jw.T @ motion.q.ravel()
    flat = columns.reshape(-1, _SIZE + 1)
    S = flat.T @ solveh_banded(chain.band(diag, upper), flat, lower=True)
    return H - S[:_SIZE, :_SIZE], g - S[:_SIZE, _SIZE]
