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
from operator import is_not

import numpy as np

from ahrsd.estimator import chain
from ahrsd.estimator.elimination import halfway
from ahrsd.estimator.epoch import InstrumentInformation, WindowEpoch
from ahrsd.estimator.factors import Y_A, C, Stack
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.lag import rates
from ahrsd.samples import Array

TURN, LAG, SCALE = slice(12, 15), 15, 16
_SIZE = 17
_OF_ANGLE = np.r_[12:15, 16]
_FIELD = np.ix_(np.r_[0:9, LAG, _SIZE], np.r_[0:9, LAG, _SIZE])  # gradient last
_MOTION = np.ix_(np.r_[9:15, SCALE, _SIZE], np.r_[9:15, SCALE, _SIZE])
_PRIOR_TURN_RAD, _PRIOR_LAG_S, _PRIOR_SCALE = 0.2, 0.05, 0.5
_MISSCALED, _MISSCALED_SIGMAS = 0.03, 3.0  # more than any gyro of the kind; beyond chance
_LASTING = np.r_[0:9, 12:_SIZE]  # all but the gyro's bias
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


Said = tuple[Array, Array]
"""H (N, 17, 17) and gradient (N, 17) of epochs, all directions eliminated."""


class InstrumentInformations:
    """Quadratics of the epochs with motion around the present estimate, computed once."""

    def __init__(self) -> None:
        self._kept: tuple[list[object], Said] | None = None

    def of(self, epochs: Sequence[WindowEpoch], graph: Graph) -> Said:
        """LinAlgError where none has motion, or its directions are not determined."""
        at: list[object] = [graph.c, *epochs, *graph.nodes.values()]
        kept = self._kept
        if kept is None or len(kept[0]) != len(at) or any(map(is_not, kept[0], at)):
            moving = [epoch for epoch in epochs if epoch.turned]
            if not moving:
                raise np.linalg.LinAlgError("no epoch with motion")
            kept = self._kept = (at, _informations(moving, graph))
        return kept[1]


class FoldedInformation:
    """Information on iron, turn, lag and scale from epochs that left the window, as one Gaussian.

    The gyro's bias walks, so each epoch had its own, which is eliminated.
    """

    def __init__(self) -> None:
        self._H: Array = np.zeros((_SIZE, _SIZE))
        self._eta: Array = np.zeros(_SIZE)  # H x - gradient, x = [M, b, 0, 0, lag, 0]

    @staticmethod
    def of_iron(graph: Graph, lag_s: float) -> FoldedInformation:
        """Information on the iron from the epochs folded into the graph; none on a lag."""
        H, g = (each[0] for each in Stack([graph.prior], graph.c, graph.nodes).here())
        gain = H[C, Y_A] @ np.linalg.pinv(H[Y_A, Y_A], rcond=1e-12, hermitian=True)
        own_H, own_g = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE)
        own_H[C, C], own_g[C] = H[C, C] - gain @ H[Y_A, C], g[C] - gain @ g[Y_A]
        past = FoldedInformation()
        past._add(own_H, own_g, graph.c, lag_s)
        return past

    @staticmethod
    def of_lag(lag_s: float, sigma_s: float) -> FoldedInformation:
        """A lag is known, and nothing of the iron."""
        past = FoldedInformation()
        past._H[LAG, LAG] = 1.0 / sigma_s**2
        past._eta[LAG] = lag_s / sigma_s**2
        return past

    def with_epoch(
        self, told: InstrumentInformation, lag_s: float, sigma_bias: float
    ) -> FoldedInformation:
        """With one epoch more, which was linearised at this lag; sigma_bias in rad/s."""
        bias = slice(9, 12)
        own = told.H[bias, bias] + np.eye(3) / sigma_bias**2
        gain = np.linalg.solve(own, told.H[bias]).T
        H, g = told.H - gain @ told.H[bias], told.g - gain @ told.g[bias]
        keep = np.zeros(_SIZE)
        keep[_LASTING] = 1.0
        past = FoldedInformation()
        past._H, past._eta = self._H.copy(), self._eta.copy()
        past._add(H * np.outer(keep, keep), g * keep, told.c, lag_s)
        return past

    def _add(self, H: Array, g: Array, c: Array, lag_s: float) -> None:
        self._H = self._H + H
        self._eta = self._eta + H @ _place(c, lag_s) - g

    def at(self, c: Array, lag_s: float) -> tuple[Array, Array]:
        """H (17, 17) and gradient (17,) there."""
        return self._H, self._H @ _place(c, lag_s) - self._eta


def _place(c: Array, lag_s: float) -> Array:
    x = np.zeros(_SIZE)
    x[:9], x[LAG] = c, lag_s
    return x


def linearise_instrument(epochs: Sequence[WindowEpoch], graph: Graph) -> None:
    """Compute `WindowEpoch.instrument` of the epochs with motion that do not have it yet."""
    silent = [epoch for epoch in epochs if epoch.turned and epoch.instrument is None]
    if silent:
        _informations(silent, graph)


def lag_known(
    epochs: Sequence[WindowEpoch], graph: Graph, past: FoldedInformation, sigma_bias: float
) -> Lag:
    """Sigma of the lag that is taken out of the field, from all data.  LinAlgError: unobservable.

    The iron is estimated with that lag. Its errors at the true lag do not correlate with that of
    the lag, so what both make adds up.
    """
    linearise_instrument(epochs, graph)
    H = believed(graph, sigma_bias)[0] + past.at(graph.c, 0.0)[0]
    H = H + sum(epoch.instrument.H for epoch in epochs if epoch.instrument is not None)
    sigma = float(np.sqrt(graph.temper * _inverse(H)[LAG, LAG]))
    return Lag(sigma, -sigma * (_inverse(H[:12, :12]) @ H[:12, LAG]))


@dataclass(frozen=True, slots=True, eq=False)
class Lag:
    """1-sigma of a lag, and by how much [M, b, w_b] (12,) would be wrong were it one sigma off."""

    sigma_s: float
    spread: Array


def _inverse(H: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
    return np.asarray(np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale))


def instrument(
    said: Said, graph: Graph, sigma_bias: float, before: tuple[Array, Array] | None = None
) -> Instrument:
    """Misalignment, lag and scale from the epochs of a settled window and those before it.

    LinAlgError where the motion does not tell.
    """
    H, g = believed(graph, sigma_bias)
    if before is not None:
        H, g = H + before[0], g + before[1]
    H, g = H + said[0].sum(axis=0), g + said[1].sum(axis=0)
    covariance = _inverse(H)
    step = -covariance @ g
    misfit = max(1.0, disagreement(*said, step))
    return Instrument(step, misfit * covariance, misfit)


def believed(graph: Graph, sigma_bias: float) -> tuple[Array, Array]:
    """H (17, 17) and gradient (17,) of what is known without the epochs."""
    H, g = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE)
    pull = graph.temper * graph.anchor[1] + graph.hold
    H[:9, :9], g[:9] = pull, pull @ (graph.c - graph.anchor[0])
    prior = [*[sigma_bias] * 3, *[_PRIOR_TURN_RAD] * 3, _PRIOR_LAG_S, _PRIOR_SCALE]
    H[9:, 9:] = np.diag(graph.temper / np.square(prior))
    return H, g


def disagreement(H: Array, g: Array, steps: Array) -> float:
    """Mean square per degree of freedom of the gradients of epochs (N, n, n), (N, n) after steps.

    steps (n,), or (N, n) where each takes its own.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-30))
    values, vectors = np.linalg.eigh(H * scale[:, :, None] * scale[:, None, :])
    good = values > _WEAKEST
    left = scale * (g + (H @ np.broadcast_to(steps, g.shape)[:, :, None])[:, :, 0])
    asked = (np.swapaxes(vectors, 1, 2) @ left[:, :, None])[:, :, 0]
    count = int(np.count_nonzero(good))
    return float(np.sum(asked[good] ** 2 / values[good]) / max(count - H.shape[1], 0.2 * count))


def _informations(epochs: Sequence[WindowEpoch], graph: Graph) -> Said:
    rows = chain.Rows.of(
        [chain.Chain(e.data, e.u, graph.nodes[e.a].bias, e.used, e.weights) for e in epochs]
    )
    field, motion = chain.parts(rows, graph.c)
    turn = _of_angle(motion.by_bias / rows.dt_s, rows.angle_b_rad)
    seen = np.concatenate([e.data.seen(e.u) for e in epochs])
    rate = np.concatenate([rates(e.data) for e in epochs])
    swept = chain.symmetric(graph.c[:6]) @ np.cross(rate, seen).T
    late = field.by_x[0, 6] * swept  # by_x holds - sqrt(weight) / s_m in that place
    diag, upper, border = chain.interior(field, motion)
    columns = np.zeros((2, _SIZE + 1, len(rate)))
    columns[:, :12], columns[:, _SIZE] = border[:, :12], border[:, 12]
    columns[:, _OF_ANGLE] = -motion.scale * turn
    columns[:, _OF_ANGLE, :-1] += np.einsum("rin,rjn->ijn", motion.prev[:, :, 1:], turn[:, :, 1:])
    columns[:, LAG] = np.einsum("rn,rin->in", late, field.own)
    _, half = halfway(diag, upper, np.ascontiguousarray(columns.transpose(1, 2, 0)))
    J = np.concatenate([field.by_x, late[:, None], field.r[:, None]], axis=1)
    K = np.concatenate([motion.by_bias, turn, motion.q[:, None]], axis=1)
    H = np.zeros((len(epochs), _SIZE + 1, _SIZE + 1))
    for k, (a, b) in enumerate(zip(rows.first.tolist(), (rows.last + 1).tolist(), strict=True)):
        Y = half[2 * a : 2 * b]
        H[k] = -(Y.T @ Y)
        H[k][_FIELD] += chain.squares(J[:, :, a:b])
        H[k][_MOTION] += chain.squares(K[:, :, a:b])
    for epoch, own in zip(epochs, H, strict=True):
        epoch.instrument = InstrumentInformation(own[:_SIZE, :_SIZE], own[:_SIZE, _SIZE], graph.c)
    return H[:, :_SIZE, :_SIZE], H[:, :_SIZE, _SIZE]


def _of_angle(by_angle: Array, angle: Array) -> Array:
    """dq/dtheta and dq/ds, (2, 4, N), of dq/dphi (2, 3, N) and phi (3, N)."""
    (x, y, z), (p, q, r) = by_angle.transpose(1, 0, 2), angle
    turn = [y * r - z * q, z * p - x * r, x * q - y * p]  # by_angle [phi]x
    return np.array([*turn, -(x * p + y * q + z * r)]).transpose(1, 0, 2)
