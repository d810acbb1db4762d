"""What an instrument may have besides iron and bias: turned axes, a lag, a wrong scale of angles.

Turn: the magnetometer's axes are taken to be the gyro's. If they are not, the rate in the
magnetometer's frame is R w with R = Exp(theta), and a step's rotation is R phi. Derivative:
dq/dtheta = dq/dphi dphi/dtheta = (dq/dw_b / dt) [phi]x.

Lag: a reading of the field that is tau late is that of the direction u(t - tau). With
du/dt = -w x u its derivative is dr/dtau = -M (w x u) / s_m.

Scale: the gyro's angles are (1 + s) times too small if its unit or the time between samples is
wrong: a host's clock, messages lost without a trace. Whoever turns a full circle sees it; what is
estimated with it means nothing. dq/ds = -(dq/dw_b / dt) phi.

One Gauss-Newton step from the answer gives them beside M, b and the bias. On fast motion one looks
like another, so they are asked for together. Every epoch stands alone here, its borders free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.epoch import Epoch
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.lag import rates
from ahrsd.samples import Array

TURN, LAG, SCALE = slice(12, 15), 15, 16
_SIZE = 17
_OF_ANGLE = np.r_[12:15, 16]
_PRIOR_TURN_RAD, _PRIOR_LAG_S, _PRIOR_SCALE = 0.2, 0.05, 0.5
_MISSCALED, _MISSCALED_SIGMAS = 0.03, 3.0  # more than any gyro of the kind; beyond chance
_WEAKEST = 1e-4  # scaled information of a direction of which an epoch says something


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """Step (17,) from the answer in [M (6), b (3), w_b (3), theta (3), tau, s], and its covariance.

    misfit: how much the epochs still disagree after the step; it is in the covariance
    """

    step: Array
    covariance: Array
    misfit: float

    @property
    def lag_s(self) -> tuple[float, float]:
        """Further lag of the field, and its sigma."""
        return self._of(LAG)

    @property
    def misscaled(self) -> float:
        """Share of themselves by which the gyro's angles are too small; 0: they may be right."""
        scale, sigma = self._of(SCALE)
        return scale if abs(scale) > max(_MISSCALED, _MISSCALED_SIGMAS * sigma) else 0.0

    def _of(self, row: int) -> tuple[float, float]:
        return float(self.step[row]), float(np.sqrt(self.covariance[row, row]))


def instrument(epochs: Sequence[Epoch], graph: Graph, sigma_bias: float) -> Instrument:
    """From the epochs of a settled window.  LinAlgError where the motion does not tell."""
    own = [
        information(epoch, graph.c, graph.nodes[epoch.a].bias) for epoch in epochs if epoch.turned
    ]
    if not own:
        raise np.linalg.LinAlgError("no epoch with motion")
    H, g = np.sum([h for h, _ in own], axis=0), np.sum([k for _, k in own], axis=0)
    pull, mean = graph.temper * graph.anchor[1] + graph.hold, graph.anchor[0]
    H[:9, :9] += pull
    g[:9] += pull @ (graph.c - mean)
    prior = [*[sigma_bias] * 3, *[_PRIOR_TURN_RAD] * 3, _PRIOR_LAG_S, _PRIOR_SCALE]
    H[9:, 9:] += np.diag(graph.temper / np.square(prior))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
    covariance = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
    step = -covariance @ g
    misfit = max(1.0, disagreement(own, [step] * len(own)))
    return Instrument(step, misfit * covariance, misfit)


def disagreement(own: Sequence[tuple[Array, Array]], steps: Sequence[Array]) -> float:
    """Mean square per degree of freedom of what each epoch (H, g) still asks for after its step."""
    total, count = 0.0, 0
    for (H, g), step in zip(own, steps, strict=True):
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
        values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
        good = values > _WEAKEST
        asked = (vectors.T @ (scale * (g + H @ step)))[good]
        total += float(np.sum(asked**2 / values[good]))
        count += int(np.count_nonzero(good))
    return total / max(count - len(steps[0]), 0.2 * count)


def information(epoch: Epoch, c: Array, bias: Array) -> tuple[Array, Array]:
    """H (17, 17) and gradient, all directions eliminated."""
    data, u = epoch.data, epoch.u
    field, motion = chain.parts(data, u, c, bias, epoch.used, epoch.weights)
    dt = data.dt_s[1:, None, None]
    by_angle = motion.J_bias / dt
    angle = data.angle_b_rad[1:]
    turn = np.concatenate([by_angle @ so3.skew(angle), -by_angle @ angle[:, :, None]], axis=2)
    swept = np.cross(rates(data), data.seen(u)) @ chain.symmetric(c[:6])
    late = field.J_x[:, 0, 6, None] * swept  # J_x holds - sqrt(weight) / s_m in that place
    diag, upper, border = chain.interior(field, motion)
    columns = np.zeros((len(u), 2, _SIZE + 1))
    columns[:, :, :12], columns[:, :, _SIZE] = border[:, :, :12], border[:, :, 12]
    columns[1:, :, _OF_ANGLE] -= motion.scale[:, None, None] * turn
    columns[:-1, :, _OF_ANGLE] += np.swapaxes(motion.J_prev, 1, 2) @ turn
    columns[:, :, LAG] = (late[:, None, :] @ field.J_own)[:, 0]
    H, g = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE)
    from_field, from_motion = np.r_[0:9, LAG], np.r_[9:15, SCALE]
    Jx = np.concatenate([field.J_x, late[:, :, None]], axis=2).reshape(-1, len(from_field))
    Jw = np.concatenate([motion.J_bias, turn], axis=2).reshape(-1, len(from_motion))
    H[np.ix_(from_field, from_field)], g[from_field] = Jx.T @ Jx, Jx.T @ field.r.ravel()
    H[np.ix_(from_motion, from_motion)], g[from_motion] = Jw.T @ Jw, Jw.T @ motion.q.ravel()
    flat = columns.reshape(-1, _SIZE + 1)
    S = flat.T @ solveh_banded(chain.band(diag, upper), flat, lower=True)
    return H - S[:_SIZE, :_SIZE], g - S[:_SIZE, _SIZE]
