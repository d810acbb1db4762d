"""An epoch in the window: its measurements, its linearisation point and the factor made from them.

Besides the factor, an epoch gives its noise residuals, its misfit score, its information on the
instrument's imperfections (turned axes, lag, gyro scales), and a test whether it contradicts a
calibration that is already well known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd.estimator import chain, locked, noise
from ahrsd.estimator.chain import factor_and_solve_lower
from ahrsd.estimator.epoch_data import SHORTEST_GAP_S, principal_deviation, row_rates
from ahrsd.estimator.graph import (
    BORDERS,
    Y_A,
    C,
    Factor,
    Graph,
    Node,
    Stack,
    Step,
    border_step,
    gap_factor,
)
from ahrsd.estimator.noise import DirectionCells
from ahrsd.estimator.parameters import Kinds, possible_instruments
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class EpochContent:
    """What of an epoch, from node a to a + 1, does not depend on the linearisation point.

    walk: information of the random walk of the gyro bias over the epoch, 1/(rad/s)^2; has_motion:
    whether the epoch carries information on the calibration; typical: medians of its rows.
    """

    data: chain.EpochData
    a: int
    walk: float
    has_motion: bool
    typical: noise.Typical


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentInformation:
    """Quadratic of an epoch in iron, gyro bias and imperfections of the instrument.

    H (28, 28), and the gradient g (28,) at the linearisation point c (9,) and bias (3,).
    """

    H: Array
    g: Array
    c: Array
    bias: Array

    def at(self, c: Array, bias: Array) -> Array:
        """Gradient (28,) at another calibration and bias."""
        return np.asarray(self.g + self.H[:, :12] @ np.r_[c - self.c, bias - self.bias])


@dataclass(frozen=True, slots=True, eq=False)
class LockedInformation:
    """Quadratic of an epoch in the columns of the instrument and in those of `locked`.

    The latter are in units of their ordinary sizes; `LOCKED` has their indices.

    roots (n, n): by component of `LOCKED`, the matrix that whitens its gradient; freedom: by
    component, the number of directions that the epoch determines; noise: the levels at the
    linearisation.
    """

    information: InstrumentInformation
    roots: dict[str, Array]
    freedom: dict[str, int]
    noise: chain.Noise


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPlan:
    """Where to linearise an epoch: directions u, noise levels, field weights (None for 1)."""

    piece: EpochContent
    u: Array
    used: chain.Noise
    weights: Array | None = None


@dataclass(slots=True, eq=False)
class WindowEpoch:
    """One epoch in the window: content, directions, noise and factor.

    used: noise levels at its linearisation; usual: those of the window at that time; instrument,
    locked: set by `linearise_instrument` and `linearise_locked`.
    """

    piece: EpochContent
    u: Array
    used: chain.Noise
    usual: chain.Noise
    quadratic: chain.Quadratic
    factor: Factor
    score: MisfitScore | None = None
    instrument: InstrumentInformation | None = None
    locked: LockedInformation | None = None
    _residuals: noise.Residuals | None = None
    _cells: DirectionCells | None = None

    @property
    def data(self) -> chain.EpochData:
        """The measurements."""
        return self.piece.data

    @property
    def a(self) -> int:
        """Index of the node at its beginning; the node at its end is a + 1."""
        return self.piece.a

    @property
    def has_motion(self) -> bool:
        """Whether it carries information on the calibration."""
        return self.piece.has_motion

    @property
    def weights(self) -> Array:
        """Weights of its field residuals."""
        return self.quadratic.weights

    @property
    def cells(self) -> DirectionCells:
        """Cells of the sphere that its directions visited."""
        if self._cells is None:
            self._cells = DirectionCells.of(self.u, self.data.count)
        return self._cells

    @property
    def residuals(self) -> noise.Residuals:
        """Sums of squares of its residuals at the linearisation point."""
        if self._residuals is None:
            self._residuals = noise.residual_sums(
                self.quadratic, self.data, self.used, self.piece.typical
            )
        return self._residuals

    @property
    def cost(self) -> float:
        """Half the sum of squared whitened residuals, minimised over the interior directions."""
        return self.quadratic.cost


def epoch_scores(epochs: Sequence[WindowEpoch]) -> list[MisfitScore]:
    """Misfit scores of epochs; each is computed once per linearisation."""
    new = [e for e in epochs if e.score is None]
    for epoch, score in zip(
        new, misfit_scores([e.factor for e in new]) if new else [], strict=True
    ):
        epoch.score = score
    return [e.score for e in epochs if e.score is not None]


def begin_epoch(
    graph: Graph, data: chain.EpochData, walk: float, *, has_motion: bool
) -> tuple[EpochContent, Array]:
    """Add the nodes of a new epoch to the graph; returns its content and directions to start from.

    walk: random walk of the gyro bias, rad/s/sqrt(s).
    """
    a = graph.last
    u = chain.start_directions(chain.symmetric(graph.c[:6]), graph.c[6:], data.field_b_gauss)
    if data.measures_first and graph.until_s is not None:
        gap_s = max(float(data.time_s[0]) - graph.until_s, SHORTEST_GAP_S)
        node = graph.nodes[a + 1] = Node.at(graph.nodes[a].bias, u[0])
        graph.factors.append(gap_factor(a, graph.c, graph.nodes[a], node, 1 / (walk**2 * gap_s)))
        a += 1
    elif data.measures_first:
        graph.nodes[a] = Node.at(graph.nodes[a].bias, u[0])
    graph.nodes[a + 1] = Node.at(graph.nodes[a].bias, u[-1])
    graph.until_s = float(data.time_s[-1])
    information = 1.0 / (walk**2 * float(np.sum(data.dt_s[1:])))
    return EpochContent(data, a, information, has_motion, noise.Typical.of(data)), u


def place_borders(graph: Graph, new_epochs: Sequence[WindowEpoch]) -> None:
    """Move border directions that come from single fields to the optimum of their epochs.

    Until then each chain is bent towards the noise of one field, which inflates the noise estimate.
    The borders of an epoch at rest have only a token of information, so they would stay wrong for
    long.
    """
    for epoch in new_epochs:
        step = border_step(epoch.quadratic)
        own = [(epoch.a + 1, step[2:])]
        if epoch.data.measures_first:
            own.append((epoch.a, step[:2]))
        for j, tangent in own:
            graph.nodes[j] = graph.nodes[j].moved_by(np.r_[np.zeros(3), tangent])


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Calibration c (9,), nodes, epochs and factors of a window, and damping of its next step."""

    damping: float
    c: Array
    nodes: dict[int, Node]
    epochs: list[WindowEpoch]
    factors: list[Factor]


# -- Misfit ----------------------------------------------------------------------------------------
#
# Ratio of the disagreement of the epochs to what their covariances allow: 1 for a perfect model.
#
# At the optimum the gradient r_i of an epoch with respect to (c, bias) has the covariance S_i,
# which is its information, if the model is right. So r_i^T S_i^-1 r_i has the mean of its rank,
# less the degrees of freedom that the fit used. Coloured noise, a field that is not uniform or a
# lag make it larger, and the covariance of the estimate is multiplied by the ratio.

_CALIBRATION_AND_BIAS = np.r_[0:12]
_FITTED_PARAMETERS = 12.0  # degrees of freedom that the fit used
_MEMORY = 0.98  # factor on remembered scores, per epoch that leaves the window


@dataclass(frozen=True, slots=True, eq=False)
class MisfitScore:
    """Whitened gradient of an epoch by z = [c, bias] (12,), minimised over its borders.

    The gradient is `whitened_gradient` (12,) at the linearisation point and changes by `root` (12,
    12) z away from it.

    freedom: degrees of freedom. Directions that the epoch does not determine have a zero gradient.
    """

    whitened_gradient: Array
    root: Array
    freedom: float

    @property
    def information(self) -> Array:
        """Information on z (12, 12)."""
        return np.asarray(self.root.T @ self.root)


def misfit_scores(factors: Sequence[Factor]) -> list[MisfitScore]:
    """Scores of the factors of several epochs."""
    H, g = np.array([f.H for f in factors]), np.array([f.g for f in factors])
    cross = H[:, _CALIBRATION_AND_BIAS[:, None], BORDERS]
    gain = cross @ np.linalg.pinv(H[:, BORDERS[:, None], BORDERS], rcond=1e-12, hermitian=True)
    S = H[:, _CALIBRATION_AND_BIAS[:, None], _CALIBRATION_AND_BIAS] - gain @ np.swapaxes(
        cross, 1, 2
    )
    r = g[:, _CALIBRATION_AND_BIAS] - (gain @ g[:, BORDERS, None])[:, :, 0]
    whiten, count = _whitening(S)
    whitened = (whiten @ r[:, :, None])[:, :, 0]
    freedom = count.astype(float)
    return [MisfitScore(*each) for each in zip(whitened, whiten @ S, freedom, strict=True)]


class Misfit:
    """Misfit of all epochs: those in the window, and the remembered sums of those that left it."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0.0

    @property
    def epochs(self) -> float:
        """Effective number of remembered epochs."""
        return self._count / _FITTED_PARAMETERS

    def remember(self, factor: Factor, score: MisfitScore, graph: Graph) -> None:
        """Keep the score of an epoch that leaves the window."""
        bias = graph.nodes[factor.a].bias
        s, n = _sum_of_squares([factor], [score], graph.c, bias[None])
        self._sum, self._count = _MEMORY * self._sum + s, _MEMORY * self._count + n

    def value(
        self,
        factors: Sequence[Factor],
        scores: Sequence[MisfitScore],
        graph: Graph,
        step: Step,
    ) -> tuple[float, float]:
        """Mean square of the scores per degree of freedom after `step`, and its 1-sigma by chance
        if the model is right.

        It is evaluated at the joint optimum, not at the present values: a gradient that all epochs
        share is no disagreement.
        """
        dc, dy = step
        biases = np.array([graph.nodes[f.a].bias + dy[f.a][:3] for f in factors])
        s, n = _sum_of_squares(factors, scores, graph.c + dc, biases)
        total, count = self._sum + s, self._count + n
        freedom = max(count - _FITTED_PARAMETERS, 0.2 * count, 1.0)
        return total / freedom, float(np.sqrt(2.0 / freedom))


def _sum_of_squares(
    factors: Sequence[Factor], scores: Sequence[MisfitScore], c: Array, biases: Array
) -> tuple[float, float]:
    """Sum of squared whitened gradients at c and biases (N, 3), and their degrees of freedom."""
    z = np.empty((len(factors), 12))
    z[:, :9] = c - np.array([f.point.c for f in factors])
    z[:, 9:] = biases - np.array([f.point.a.bias for f in factors])
    roots = np.array([s.root for s in scores])
    whitened = np.array([s.whitened_gradient for s in scores]) + (roots @ z[:, :, None])[:, :, 0]
    return float(np.sum(whitened * whitened)), sum(s.freedom for s in scores)


# -- Instrument ------------------------------------------------------------------------------------
#
# Imperfections of an instrument besides iron and bias: turned axes, a lag, a gyro scale, and more.
#
# Turn: the model assumes that the magnetometer's axes are those of the gyro. If they are turned,
# the rate in the magnetometer's frame is R w with R = Exp(theta), and the rotation of a step is R
# phi. Here phi is without the bias: the bias acts in the gyro's own axes, so what epochs at rest
# determine of it says nothing about the gyro's matrix. Derivative: dq/dtheta = dq/dphi dphi/dtheta
# = (dq/dw_b / dt) [phi]x.
#
# Lag: a field reading that is late by tau belongs to the direction u(t - tau). With du/dt = -w x u
# its derivative is dr/dtau = -M (w x u) / s_m.
#
# Scale: the gyro's angles are too small by the factor 1 + s if its unit or the sampling interval is
# wrong (the clock of a host, messages lost without a trace). A full turn shows it; the estimate is
# void with it. dq/ds = -(dq/dw_b / dt) phi.
#
# Shape: the gyro's axes have different scales and are not orthogonal: its angles are too small by I
# + E, E symmetric and traceless (5 numbers). It is not estimated but considered: it widens the
# covariance of the answer.
#
# Place: the field in the world differs with position, and a circling vehicle has another position
# on each heading: dh = G e, where e is the cosine and sine of the heading and G (3, 2) is in world
# axes. A part of it is constant in the sensor frame and looks like hard iron, another part looks
# like soft iron: no fit shows them. dr/dG = -M R (axis) e / s_m / |h|, with R from gravity and the
# field's direction. Place is considered too: its size is one of `parameters.PLACES`, each with the
# posterior probability that the visible part of the effect gives it.
#
# One Gauss-Newton step from the answer estimates them together with M, b and the bias. In fast
# motion their effects resemble each other, so they are estimated jointly. Each epoch is taken on
# its own here, with free borders.

# Imperfections that the data support are removed from the data (`InstrumentCorrection`): the field
# is taken to be late, and the gyro's angles are multiplied by a matrix. The next step starts from
# the corrected data.

TURN, LAG, SCALE = slice(12, 15), 15, 16
_ESTIMATED = 17  # numbers that are estimated; shape (5) and place (6) are only considered
PLACE = slice(22, 28)  # dependence of the field on the heading
_SIZE = 28
_CALIBRATION, _BIAS, _IMPERFECT = slice(0, 12), slice(9, 12), slice(12, _SIZE + 3)
_ANGLE_COLUMNS = np.r_[12:15, 16:22]
_SCALES = np.r_[SCALE:22]
_FIELD_COLUMNS, _MOTION_COLUMNS = np.r_[0:9, LAG, PLACE], np.r_[9:15, SCALE:22]
_PRIOR_TURN_RAD, _PRIOR_LAG_S, _PRIOR_SCALE = 0.2, 0.05, 0.5
IMPERFECTIONS = ("axes", "lag", "scales", "place", "bias")
_PLACE = np.r_[10:16]
# among the 19 imperfections
_IMPERFECTION_ROWS = (np.r_[0:3], np.r_[3:4], np.r_[4:10], _PLACE, np.r_[16:19])
_MISSCALED, _MISSCALED_SIGMAS = 0.03, 3.0  # beyond any gyro's tolerance; and significant
_GYRO = np.r_[TURN, SCALE:22]  # turn, scale and shape of the gyro's angles
GYRO_AMONG_IMPERFECTIONS = _GYRO - 12  # the same among the 19 imperfections
REQUIRED_NATS = 5.0  # log odds from which imperfections are removed from the data
_WORTH_SIGMAS = 0.3  # posterior sigmas of a correction that is worth another step
_CONSTANT = np.r_[0:9, 12:_SIZE]  # everything but the gyro bias, which walks
_LEAST_HORIZONTAL = 0.05  # sine of the angle between field and gravity: less gives no heading
_WEAKEST = 1e-4  # scaled information from which an epoch determines a direction


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentCorrection:
    """Imperfections that are already removed from the data of the epochs.

    lag_s: lag of the field; gyro (3, 3): matrix on the gyro's angles; walk: random walk of the gyro
    bias besides that of every gyro, rad/s/sqrt(s).
    """

    lag_s: float
    gyro: Array
    walk: float = 0.0

    @staticmethod
    def identity() -> InstrumentCorrection:
        """No correction: a perfect instrument."""
        return InstrumentCorrection(0.0, np.eye(3))

    @property
    def is_nonzero(self) -> bool:
        """Whether anything is corrected."""
        return self.lag_s != 0.0 or self.walk > 0.0 or not np.array_equal(self.gyro, np.eye(3))

    @property
    def gyro_parameters(self) -> Array:
        """Turn (3), scale and shape (5) of the gyro's matrix."""
        E = self.gyro - np.eye(3)
        scale = float(np.trace(E)) / 3
        S = (E + E.T) / 2 - scale * np.eye(3)
        turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
        apart = [(S[0, 0] - S[1, 1]) / 2, -S[2, 2] * np.sqrt(3.0) / 2]
        return np.array([*turn, scale, *apart, S[1, 2], S[0, 2], S[0, 1]])

    def with_gyro(self, parameters: Array) -> InstrumentCorrection:
        """The correction with a further turn (3), scale and shape (5) of the gyro."""
        (x, y, z), scale, (apart, against, yz, xz, xy) = (
            parameters[:3],
            parameters[3],
            parameters[4:],
        )
        third = against / np.sqrt(3.0)
        diagonal = np.array([apart + third, third - apart, -2 * third]) + scale
        sides = np.array([[0.0, xy - z, xz + y], [xy + z, 0.0, yz - x], [xz - y, yz + x, 0.0]])
        more = np.diag(diagonal) + sides
        return replace(self, gyro=(np.eye(3) + more) @ self.gyro)


#: (9, 3, 3) matrices on the gyro's angles for a unit turn, scale and shape
GYRO_BASIS = np.array(
    [InstrumentCorrection.identity().with_gyro(one).gyro - np.eye(3) for one in np.eye(9)]
)


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """Step (17,) from the answer in [M (6), b (3), w_b (3), theta (3), tau, s], and its covariance.

    misfit: misfit of the epochs after the step; the covariance includes it. scaled: scale of the
    gyro's angles that was corrected before.
    """

    step: Array
    covariance: Array
    misfit: float
    scaled: float = 0.0

    @property
    def lag_s(self) -> tuple[float, float]:
        """Further lag of the field, and its sigma."""
        return self._of(LAG)

    @property
    def misscaled(self) -> float:
        """Relative amount by which the gyro's angles are too small; 0 if they may be right."""
        scale, sigma = self._of(SCALE)
        scale += self.scaled
        return scale if abs(scale) > max(_MISSCALED, _MISSCALED_SIGMAS * sigma) else 0.0

    def _of(self, row: int) -> tuple[float, float]:
        return float(self.step[row]), float(np.sqrt(self.covariance[row, row]))


InformationStack = tuple[Array, Array]
"""H (N, 17, 17) and gradient (N, 17) of epochs, all directions eliminated."""


def instrument_quadratics(epochs: Sequence[WindowEpoch], graph: Graph) -> InformationStack:
    """Quadratics of the epochs with motion at the present estimate.

    LinAlgError if there is no motion or the directions are not determined.
    """
    H, g = full_instrument_quadratics(epochs, graph)
    return H[:, :_ESTIMATED, :_ESTIMATED], g[:, :_ESTIMATED]


def full_instrument_quadratics(epochs: Sequence[WindowEpoch], graph: Graph) -> InformationStack:
    """The same with the gyro's shape and the place: H (N, 28, 28) and gradient (N, 28).

    H is computed once, where each epoch was linearised; the gradient is moved to the present
    values.
    """
    linearise_instrument(epochs)
    moving = [(e.instrument, graph.nodes[e.a].bias) for e in epochs if e.has_motion]
    if not moving:
        raise np.linalg.LinAlgError("no epoch with motion")
    known = [(one, bias) for one, bias in moving if one is not None]
    H = np.array([one.H for one, _ in known])
    return H, np.array([one.at(graph.c, bias) for one, bias in known])


def rest_quadratics(epochs: Sequence[WindowEpoch], graph: Graph) -> InformationStack:
    """Quadratics (R, 28, 28) and gradients (R, 28) of the epochs at rest.

    They are in the gyro bias only, at the bias of their nodes.
    """
    resting = [e for e in epochs if not e.has_motion]
    H, g = np.zeros((len(resting), _SIZE, _SIZE)), np.zeros((len(resting), _SIZE))
    for k, epoch in enumerate(resting):
        factor = epoch.factor
        H[k, _BIAS, _BIAS] = factor.H[_BIAS, _BIAS]
        bias_change = graph.nodes[epoch.a].bias - factor.point.a.bias
        g[k, _BIAS] = factor.g[_BIAS] + factor.H[_BIAS, _BIAS] @ bias_change
    return H, g


class FoldedInformation:
    """Information on iron, turn, lag and scale from epochs that left the window, as one Gaussian.

    The gyro bias walks, so each epoch has its own, which is marginalised.
    """

    def __init__(self) -> None:
        self._H: Array = np.zeros((_SIZE, _SIZE))
        self._eta: Array = np.zeros(_SIZE)  # H x - gradient, x of `_instrument_point`

    @staticmethod
    def of_iron(graph: Graph, correction: InstrumentCorrection) -> FoldedInformation:
        """Information on the iron from the epochs folded into the graph; none on a lag."""
        H, g = (each[0] for each in Stack([graph.prior], graph.c, graph.nodes).quadratics())
        gain = H[C, Y_A] @ np.linalg.pinv(H[Y_A, Y_A], rcond=1e-12, hermitian=True)
        own_H, own_g = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE)
        own_H[C, C], own_g[C] = H[C, C] - gain @ H[Y_A, C], g[C] - gain @ g[Y_A]
        past = FoldedInformation()
        past._add(own_H, own_g, graph.c, correction)
        return past

    @staticmethod
    def of_lag(lag_s: float, sigma_s: float) -> FoldedInformation:
        """A known lag, and no information on the iron."""
        past = FoldedInformation()
        past._H[LAG, LAG] = 1.0 / sigma_s**2
        past._eta[LAG] = lag_s / sigma_s**2
        return past

    def with_epoch(
        self,
        information: InstrumentInformation,
        correction: InstrumentCorrection,
        sigma_bias: float,
    ) -> FoldedInformation:
        """The same with one epoch added, which was linearised with this correction; sigma_bias in
        rad/s.
        """
        bias = slice(9, 12)
        own = information.H[bias, bias] + np.eye(3) / sigma_bias**2
        gain = np.linalg.solve(own, information.H[bias]).T
        H, g = (
            information.H - gain @ information.H[bias],
            information.g - gain @ information.g[bias],
        )
        keep = np.zeros(_SIZE)
        keep[_CONSTANT] = 1.0
        past = FoldedInformation()
        past._H, past._eta = self._H.copy(), self._eta.copy()
        past._add(H * np.outer(keep, keep), g * keep, information.c, correction)
        return past

    def _add(self, H: Array, g: Array, c: Array, correction: InstrumentCorrection) -> None:
        self._H = self._H + H
        self._eta = self._eta + H @ _instrument_point(c, correction) - g

    def at(self, c: Array, correction: InstrumentCorrection) -> tuple[Array, Array]:
        """H (28, 28) and gradient (28,) at a calibration and correction."""
        return self._H, self._H @ _instrument_point(c, correction) - self._eta


def _instrument_point(c: Array, correction: InstrumentCorrection) -> Array:
    x = np.zeros(_SIZE)
    x[:9], x[LAG], x[_GYRO] = c, correction.lag_s, correction.gyro_parameters
    return x


def linearise_instrument(epochs: Sequence[WindowEpoch]) -> None:
    """Compute `WindowEpoch.instrument` of the epochs with motion that lack it.

    Epochs that were linearised at the same calibration are handled together.
    """
    missing = [epoch for epoch in epochs if epoch.has_motion and epoch.instrument is None]
    for point in {id(epoch.factor.point.c): epoch.factor.point.c for epoch in missing}.values():
        _set_instrument_information(
            [epoch for epoch in missing if epoch.factor.point.c is point], point
        )


def lag_uncertainty(
    epochs: Sequence[WindowEpoch], graph: Graph, past: FoldedInformation, sigma_bias: float
) -> Lag:
    """Sigma of the lag that is removed from the field, from all data; LinAlgError if unobservable.

    The iron is estimated at that lag. The errors of the iron at the true lag are not correlated
    with the error of the lag, so the two contributions add up.
    """
    linearise_instrument(epochs)
    H = past.at(graph.c, InstrumentCorrection.identity())[0]
    H = H + sum(epoch.instrument.H for epoch in epochs if epoch.instrument is not None)
    H = prior_quadratic(graph, sigma_bias)[0] + H[:_ESTIMATED, :_ESTIMATED]
    sigma = float(np.sqrt(graph.temper * _scaled_inverse(H)[LAG, LAG]))
    return Lag(sigma, -sigma * (_scaled_inverse(H[:12, :12]) @ H[:12, LAG]))


@dataclass(frozen=True, slots=True, eq=False)
class Lag:
    """1-sigma of a lag, and the error of [M, b, w_b] (12,) if the lag is one sigma off."""

    sigma_s: float
    spread: Array


def _scaled_inverse(H: Array) -> Array:
    """Inverse of each positive definite matrix (..., n, n), whose rows may have any units."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=-2, axis2=-1), 1e-30))
    sizes = scale[..., :, None] * scale[..., None, :]
    return np.asarray(np.linalg.inv(H * sizes) * sizes)


def estimate_instrument(
    epochs: InformationStack,
    graph: Graph,
    sigma_bias: float,
    before: tuple[Array, Array] | None = None,
    scaled: float = 0.0,
) -> Instrument:
    """Misalignment, lag and scale from the epochs of a settled window and those before it.

    LinAlgError if the motion does not determine them.
    """
    H, g = prior_quadratic(graph, sigma_bias)
    if before is not None:
        H, g = H + before[0][:_ESTIMATED, :_ESTIMATED], g + before[1][:_ESTIMATED]
    H, g = H + epochs[0].sum(axis=0), g + epochs[1].sum(axis=0)
    covariance = _scaled_inverse(H)
    step = -covariance @ g
    misfit = max(1.0, disagreement(*epochs, step))
    return Instrument(step, misfit * covariance, misfit, scaled)


@dataclass(frozen=True, slots=True, eq=False)
class ImperfectionLikelihood:
    """Likelihood of the imperfections (19, `_IMPERFECT`), and their effect on the answer.

    covariance (12, 12): of [M, b, w_b] for a perfect instrument; response (12, 19): change of [M,
    b, w_b] per unit of each imperfection; gradient (12,): of [M, b, w_b]; information (19, 19) and
    imperfection_gradient (19,): of the imperfections, marginalised over [M, b, w_b]; corrected
    (19,): what is removed from the data already; misfit_after: misfit of the epochs after a step
    (31,) of all
    """

    covariance: Array
    response: Array
    gradient: Array
    information: Array
    imperfection_gradient: Array
    corrected: Array
    misfit_after: Callable[[Array], float]

    @staticmethod
    def of(
        epochs: InformationStack,
        times_s: Array,
        graph: Graph,
        sigma_bias: float,
        before: tuple[Array, Array],
        correction: InstrumentCorrection,
    ) -> ImperfectionLikelihood:
        """From epochs at times_s (N,) and the folded ones.

        LinAlgError if the motion does not determine the answer.
        """
        epochs = add_bias_drift(epochs, times_s)
        H, g = epochs[0].sum(axis=0), epochs[1].sum(axis=0)
        H[:_SIZE, :_SIZE] += before[0]
        g[:_SIZE] += before[1]
        prior_H, prior_g = prior_quadratic(graph, sigma_bias)
        covariance = _scaled_inverse(
            H[_CALIBRATION, _CALIBRATION] + prior_H[_CALIBRATION, _CALIBRATION]
        )
        response, gradient = (
            -covariance @ H[_CALIBRATION, _IMPERFECT],
            g[_CALIBRATION] + prior_g[_CALIBRATION],
        )
        information = H[_IMPERFECT, _IMPERFECT] + H[_IMPERFECT, _CALIBRATION] @ response
        corrected = np.zeros(len(information))
        corrected[GYRO_AMONG_IMPERFECTIONS] = correction.gyro_parameters
        imperfection_gradient = g[_IMPERFECT] + response.T @ gradient
        return ImperfectionLikelihood(
            covariance,
            response,
            gradient,
            information,
            imperfection_gradient,
            corrected,
            partial(disagreement, *epochs),
        )

    def posterior(self, sigmas: Array, temper: float) -> tuple[Array, Array]:
        """Covariance (..., 19, 19) over the temper, and mean (..., 19) beyond the present
        correction.

        sigmas (..., 19): prior sigmas.
        """
        prior_information = temper / sigmas**2
        covariance = _scaled_inverse(
            self.information + prior_information[..., None] * np.eye(prior_information.shape[-1])
        )
        return covariance, -(
            covariance
            @ (self.imperfection_gradient + prior_information * self.corrected)[..., None]
        )[..., 0]

    def temper(self, sigmas: Array, most: float) -> float:
        """Misfit of the epochs after the maximum a posteriori step, between 1 and `most`."""
        mean = self.posterior(sigmas, most)[1]
        step = np.r_[-self.covariance @ self.gradient + self.response @ mean, mean]
        return min(most, max(1.0, self.misfit_after(step)))

    def log_evidence(self, sigmas: Array, mean: Array, temper: float) -> Array:
        """Log evidence (...) for prior sigmas (..., 19) with their posterior mean, up to a
        constant.
        """
        outer = sigmas[..., :, None] * sigmas[..., None, :]
        log_determinant = np.linalg.slogdet(
            np.eye(sigmas.shape[-1]) + self.information / temper * outer
        )[1]
        penalty = (
            np.sum((mean @ self.information + 2.0 * self.imperfection_gradient) * mean, axis=-1)
            / temper
        )
        penalty = penalty + np.sum(np.square((self.corrected + mean) / sigmas), axis=-1)
        return np.asarray(-0.5 * (penalty + log_determinant))


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentPosterior:
    """All possible instruments at all places, with their evidence.

    sigmas (K, 19): prior sigmas; log_prior (K,); log_evidence (K,); covariances (K, 19, 19) and
    means (K, 19): posterior of the imperfections of each, beyond the present correction
    """

    likelihood: ImperfectionLikelihood
    sigmas: Array
    log_prior: Array
    log_evidence: Array
    covariances: Array
    means: Array

    @staticmethod
    def of(likelihood: ImperfectionLikelihood, graph: Graph, kinds: Kinds) -> InstrumentPosterior:
        """The posterior at the temper that remains after the imperfections are fitted.

        Disagreement that they explain is no noise.
        """
        instruments = possible_instruments(*kinds)
        sigmas = instruments.sigmas
        temper = likelihood.temper(sigmas.max(axis=0), graph.temper)
        covariances, means = likelihood.posterior(sigmas, temper)
        log_evidence = likelihood.log_evidence(sigmas, means, temper)
        return InstrumentPosterior(
            likelihood, sigmas, instruments.log_prior, log_evidence, temper * covariances, means
        )

    def probabilities(self) -> Array:
        """Posterior probabilities (K,)."""
        log_weights = self.log_evidence + self.log_prior
        shares = np.exp(log_weights - log_weights.max())
        return np.asarray(shares / shares.sum())

    def most_probable(
        self, which: Array | slice, required_nats: float = REQUIRED_NATS
    ) -> int | None:
        """The instrument of the largest evidence among those in which some of `which` exceed their
        least size. None if its evidence exceeds that of the others by less than `required_nats`.
        """
        found, gain = self.log_odds_against_smallest(which)
        return None if gain < required_nats else found

    def log_odds_against_smallest(self, which: Array | slice) -> tuple[int, float]:
        """The instrument of the largest evidence among those in which some of `which` exceed their
        least size, and its log odds against the best of those in which all have their least size.

        The other imperfections are free in both: a field that differs by place may look like a gyro
        error.
        """
        sizes = self.sigmas[:, which]
        smallest = np.all(sizes == sizes.min(axis=0), axis=1)
        if smallest.all():
            return 0, -np.inf
        others = np.where(smallest, -np.inf, self.log_evidence)
        return int(np.argmax(others)), float(others.max() - self.log_evidence[smallest].max())


@dataclass(frozen=True, slots=True, eq=False)
class Widening:
    """Effect of the imperfections and of the place on the covariance of an answer.

    added (12, 12): to the covariance of [M, b, w_b]; parts: the part of each of `IMPERFECTIONS`
    alone (they need not add up to `added`); place_gauss: rms of the six numbers of the field's
    dependence on the heading; gyro (9, 9): covariance of turn, scale and shape of the gyro's angles
    beyond the correction; with_gyro (12, 9): cross covariance with [M, b, w_b]
    """

    added: Array
    parts: dict[str, Array]
    place_gauss: float
    gyro: Array
    with_gyro: Array

    def joint(self, covariance: Array, K: Array) -> Array:
        """(21, 21) covariance of K (12, 12) [M, b, w_b], whose covariance is given, and of the
        gyro.
        """
        cross = K @ self.with_gyro
        return np.block([[covariance, cross], [cross.T, self.gyro]])

    @staticmethod
    def zero() -> Widening:
        """For a perfect instrument, or if the imperfections are unknown."""
        return Widening(np.zeros((12, 12)), {}, float("nan"), np.zeros((9, 9)), np.zeros((12, 9)))


def widening_by_imperfections(posterior: InstrumentPosterior) -> Widening:
    """Effect of the imperfections on the answer, which assumes a perfect instrument.

    The instrument is one of `possible_instruments`, with their posterior probabilities. For each of
    them, the posterior covariance of the imperfections spreads the answer, and their posterior mean
    is an error of it. The sizes of the imperfections are poorly determined by a few numbers, so the
    result is the mean of the variances over the instruments, not the variance of the most probable
    one.
    """
    response, means, probabilities = (
        posterior.likelihood.response,
        posterior.means,
        posterior.probabilities(),
    )
    mean = np.tensordot(probabilities, posterior.covariances, 1) + (probabilities * means.T) @ means
    added = response @ mean @ response.T
    each = [response[:, i] @ mean[np.ix_(i, i)] @ response[:, i].T for i in _IMPERFECTION_ROWS]
    return Widening(
        (added + added.T) / 2,
        dict(zip(IMPERFECTIONS, each, strict=True)),
        float(np.sqrt(np.mean(np.diag(mean)[_PLACE]))),
        mean[np.ix_(GYRO_AMONG_IMPERFECTIONS, GYRO_AMONG_IMPERFECTIONS)],
        response @ mean[:, GYRO_AMONG_IMPERFECTIONS],
    )


def required_bias_walk(posterior: InstrumentPosterior, span_s: float) -> float:
    """Walk of the gyro bias (rad/s/sqrt(s)) that would produce the drift found over span_s.

    0 if an instrument without drift is as probable.
    """
    found = posterior.most_probable(slice(-3, None))
    drift = np.zeros(3) if found is None else posterior.means[found][-3:]
    return float(np.sqrt(np.mean(np.square(drift)) / max(span_s, 1.0)))


def required_gyro_correction(posterior: InstrumentPosterior, required_nats: float) -> Array | None:
    """Further turn (3), scale and shape (5) by which to correct the gyro's angles.

    None if the log odds against an instrument within its specification are below `required_nats`
    and nothing is corrected yet, or if the step is not worth it.
    """
    found = posterior.most_probable(
        GYRO_AMONG_IMPERFECTIONS, -np.inf if posterior.likelihood.corrected.any() else required_nats
    )
    if found is None:
        return None
    step = posterior.means[found][GYRO_AMONG_IMPERFECTIONS]
    known = posterior.covariances[found][np.ix_(GYRO_AMONG_IMPERFECTIONS, GYRO_AMONG_IMPERFECTIONS)]
    worth = float(np.sqrt(step @ np.linalg.solve(known, step) / len(step)))
    return step if worth > _WORTH_SIGMAS else None


def add_bias_drift(epochs: InformationStack, times_s: Array) -> InformationStack:
    """H (N, 31, 31) and g (N, 31) with three more columns: the total drift of the gyro bias over
    all epochs.

    The drift has a constant rate; w_b is the bias in the newest epoch.
    """
    H, g = epochs
    span_s = max(float(np.ptp(times_s)), 1e-9)
    until = (times_s - float(np.max(times_s)))[:, None] / span_s
    with_bias = np.concatenate([H, until[:, None] * H[:, _BIAS]], axis=1)
    both = np.concatenate([with_bias, until[:, None] * with_bias[:, :, _BIAS]], axis=2)
    return both, np.concatenate([g, until * g[:, _BIAS]], axis=1)


def prior_quadratic(graph: Graph, sigma_bias: float) -> tuple[Array, Array]:
    """H (17, 17) and gradient (17,) of the prior, without the epochs."""
    H, g = np.zeros((_ESTIMATED, _ESTIMATED)), np.zeros(_ESTIMATED)
    pull = graph.temper * graph.anchor[1] + graph.hold
    H[:9, :9], g[:9] = pull, pull @ (graph.c - graph.anchor[0])
    prior = [*[sigma_bias] * 3, *[_PRIOR_TURN_RAD] * 3, _PRIOR_LAG_S, _PRIOR_SCALE]
    H[9:, 9:] = np.diag(graph.temper / np.square(prior))
    return H, g


def disagreement(H: Array, g: Array, steps: Array) -> float:
    """Mean square per degree of freedom of the gradients of epochs (N, n, n), (N, n) after steps.

    steps (n,), or (N, n) with one for each epoch.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-30))
    values, vectors = np.linalg.eigh(H * scale[:, :, None] * scale[:, None, :])
    good = values > _WEAKEST
    gradients = scale * (g + (H @ np.broadcast_to(steps, g.shape)[:, :, None])[:, :, 0])
    projected = (np.swapaxes(vectors, 1, 2) @ gradients[:, :, None])[:, :, 0]
    count = int(np.count_nonzero(good))
    return float(np.sum(projected[good] ** 2 / values[good]) / max(count - H.shape[1], 0.2 * count))


def _set_instrument_information(epochs: Sequence[WindowEpoch], c: Array) -> None:
    """Set `WindowEpoch.instrument` of epochs that were linearised at c."""
    for epoch, own in zip(epochs, _quadratics(epochs, c), strict=True):
        at = c, epoch.factor.point.a.bias
        epoch.instrument = InstrumentInformation(own[:_SIZE, :_SIZE], own[:_SIZE, _SIZE], *at)


def _quadratics(
    epochs: Sequence[WindowEpoch], c: Array, further: Callable[..., _Columns] | None = None
) -> Array:
    """H (E, n, n) with the gradient as its last column, of epochs that were linearised at c.

    further: returns more columns for given field and motion parts, directions, rates and rows.
    Their indices follow those of the instrument, the field's columns before the motion's.
    """
    rows = chain.Rows.of(
        [chain.Chain(e.data, e.u, e.factor.point.a.bias, e.used, e.weights) for e in epochs]
    )
    field, motion = chain.field_and_motion(rows, c)
    turned = rows.angle_b_rad - rows.bias * rows.dt_s
    turn = _gyro_matrix_columns(motion.by_bias / rows.dt_s, turned)
    seen = np.concatenate([e.data.field_directions(e.u) for e in epochs])
    rate = np.concatenate([row_rates(e.data) for e in epochs])
    swept = chain.symmetric(c[:6]) @ np.cross(rate, seen).T
    late = field.by_x[0, 6] * swept  # by_x holds - sqrt(weight) / s_m in that place
    place = _place_columns(field, seen, np.concatenate([e.data.down_b for e in epochs]), c)
    of_field, of_motion = np.zeros((3, 0, len(rate))), np.zeros((2, 0, len(rate)))
    if further is not None:
        of_field, of_motion = further(field, motion, seen, rate - rows.bias.T, turned / rows.dt_s)
    split = _SIZE + of_field.shape[1]
    size = split + of_motion.shape[1]
    J = np.concatenate([field.by_x, late[:, None], place, of_field, field.r[:, None]], axis=1)
    K = np.concatenate([motion.by_bias, turn, of_motion, motion.q[:, None]], axis=1)
    diag, upper, border = chain.interior_blocks(field, motion)
    columns = np.zeros((2, size + 1, len(rate)))
    columns[:, :12], columns[:, size] = border[:, :12], border[:, 12]
    angles = np.r_[_ANGLE_COLUMNS, split:size]
    by_angle = K[:, 3:-1]
    columns[:, angles] = -motion.scale * by_angle
    columns[:, angles, :-1] += np.einsum(
        "rin,rjn->ijn", motion.by_previous[:, :, 1:], by_angle[:, :, 1:]
    )
    columns[:, LAG] = np.einsum("rn,rin->in", late, field.by_direction)
    columns[:, PLACE] = np.einsum("rjn,rin->ijn", place, field.by_direction)
    columns[:, _SIZE:split] = np.einsum("rjn,rin->ijn", of_field, field.by_direction)
    _, half = factor_and_solve_lower(diag, upper, np.ascontiguousarray(columns.transpose(1, 2, 0)))
    fields = np.r_[_FIELD_COLUMNS, _SIZE:split, size]
    motions = np.r_[_MOTION_COLUMNS, split:size, size]
    H = np.zeros((len(epochs), size + 1, size + 1))
    for k, (a, b) in enumerate(zip(rows.first.tolist(), (rows.last + 1).tolist(), strict=True)):
        Y = half[2 * a : 2 * b]
        H[k] = -(Y.T @ Y)
        H[k][np.ix_(fields, fields)] += chain.outer_sum(J[:, :, a:b])
        H[k][np.ix_(motions, motions)] += chain.outer_sum(K[:, :, a:b])
    for epoch, own in zip(epochs, H, strict=True):
        own[_SCALES, size] -= _gyro_noise_gradient(epoch)
    return H


_Columns = tuple[Array, Array]
"""Of the field's residuals (3, n, N) and of the motion's (2, m, N)."""


def _place_columns(field: chain.FieldPart, seen: Array, down: Array, c: Array) -> Array:
    """Derivatives (3, 6, N) of the residuals by a field that depends on the heading, in gauss: its
    north, east and down components, each with the cosine and the sine of the heading.

    seen, down (N, 3): directions of the field and towards the earth. Zero where they give no
    heading.
    """
    down = np.nan_to_num(down)
    east = np.cross(down, seen)
    flat = np.linalg.norm(east, axis=1)[:, None]
    determined = flat > _LEAST_HORIZONTAL
    east, down = (
        np.where(determined, east / np.maximum(flat, _LEAST_HORIZONTAL), 0.0),
        np.where(determined, down, 0.0),
    )
    north = np.cross(east, down)
    heading = np.column_stack([north[:, 0], east[:, 0]])
    heading /= np.maximum(np.linalg.norm(heading, axis=1), _LEAST_HORIZONTAL)[:, None]
    M = chain.symmetric(c[:6]) / np.cbrt(np.linalg.det(chain.symmetric(c[:6])))
    heading = (field.by_x[0, 6] * heading.T)[None]  # by_x holds - sqrt(weight) / s_m in that place
    in_sensor = np.stack([M @ axis.T for axis in (north, east, down)], axis=1)
    return np.asarray(
        (in_sensor[:, :, None] * heading[:, None]).reshape(3, 6, -1), dtype=np.float64
    )


def _gyro_noise_gradient(epoch: WindowEpoch) -> Array:
    """Gradient by scale (1) and shape (5) that the gyro's noise alone produces.

    Smaller angles have less noise, so noise alone favours them. The noise (1 + E) n of a step is
    seen across the field, so half its square grows by n' (1 - u u') E n, of which one half is in
    each direction.
    """
    uu = epoch.u.T @ epoch.u / len(epoch.u)
    along = [uu[0, 0] - uu[1, 1], (uu[0, 0] + uu[1, 1] - 2 * uu[2, 2]) / np.sqrt(3.0)]
    along += [2 * uu[1, 2], 2 * uu[0, 2], 2 * uu[0, 1]]
    # more squares than noise makes are not due to the gyro
    squares = min(epoch.quadratic.sum_gyro, epoch.residuals.gyro_freedom)
    return np.asarray(squares * np.array([1.0, *(-0.5 * x for x in along)]))


def _gyro_matrix_columns(by_angle: Array, angle: Array) -> Array:
    """dq/dtheta, dq/ds and dq/dE, (2, 9, N), from dq/dphi (2, 3, N) and phi (3, N).

    E: x against y, both against z, then the three shears.
    """
    (x, y, z), (p, q, r) = by_angle.transpose(1, 0, 2), angle
    turn = [y * r - z * q, z * p - x * r, x * q - y * p]  # by_angle [phi]x
    shape = [y * q - x * p, (2 * z * r - x * p - y * q) / np.sqrt(3.0)]
    shape += [-(y * r + z * q), -(x * r + z * p), -(x * q + y * p)]
    return np.array([*turn, -(x * p + y * q + z * r), *shape]).transpose(1, 0, 2)


# -- Residuals that follow attitude, rate or time --------------------------------------------------
#
# What real instruments and places leave in the residuals besides (`locked`): harmonics of the
# field's direction on each axis of the sensor; terms in the rate, and in the field's change with a
# different delay on each axis; products of the gyro's rates. They are not estimated, only tested
# (`model_checks`). What follows time is a hard iron of its own in each epoch and needs no columns.

_FIRST_LOCKED = _SIZE
_SAME_CALIBRATION = 1e-2  # of the field: a smaller move changes the result by 1e-4 (second order)
_SAME_NOISE = 0.1  # relative change of a noise level up to which the result is kept
LOCKED = {
    "attitude": np.arange(_FIRST_LOCKED, _FIRST_LOCKED + 36),
    "rate": np.arange(_FIRST_LOCKED + 36, _FIRST_LOCKED + 36 + 9 + 8 + 18),
    "time": np.arange(6, 9),
}


def linearise_locked(epochs: Sequence[WindowEpoch]) -> None:
    """Compute `WindowEpoch.locked` of the epochs with motion that lack it, as
    `linearise_instrument`.
    """
    missing = [epoch for epoch in epochs if epoch.has_motion and epoch.locked is None]
    for point in {id(epoch.factor.point.c): epoch.factor.point.c for epoch in missing}.values():
        here = [epoch for epoch in missing if epoch.factor.point.c is point]
        found = _quadratics(here, point, partial(_locked_columns, c=point))
        H, g = found[:, :-1, :-1], found[:, :-1, -1]
        roots = {key: _whitening(H[:, at[:, None], at]) for key, at in LOCKED.items()}
        for k, epoch in enumerate(here):
            information = InstrumentInformation(H[k], g[k], point, epoch.factor.point.a.bias)
            own = {key: root[k] for key, (root, _) in roots.items()}
            freedom = {key: int(count[k]) for key, (_, count) in roots.items()}
            epoch.locked = LockedInformation(information, own, freedom, epoch.used)


def reusable_locked(old: WindowEpoch, new: WindowEpoch) -> LockedInformation | None:
    """The `locked` information of an epoch that was linearised again, if it is still accurate."""
    known = old.locked
    if known is None or old.data is not new.data:
        return None
    c, change = new.factor.point.c, new.factor.point.c - known.information.c
    has_moved = float(np.linalg.norm(change)) > _SAME_CALIBRATION * float(
        np.cbrt(np.linalg.det(chain.symmetric(c[:6])))
    )
    noise_change = max(
        abs(new.used.mag_gauss / known.noise.mag_gauss - 1.0),
        abs(new.used.gyro_rad_s / known.noise.gyro_rad_s - 1.0),
    )
    return None if has_moved or noise_change > _SAME_NOISE else known


def _locked_columns(
    field: chain.FieldPart,
    motion: chain.MotionPart,
    seen: Array,
    rate: Array,
    step_rate: Array,
    *,
    c: Array,
) -> _Columns:
    """Columns for directions and rates (N, 3) at the rows, and rates of the step to each (3, N)."""
    change = np.cross(seen, rate) @ chain.symmetric(c[:6])
    by_field = np.concatenate(
        [
            locked.BY_DIRECTION * locked.on_each_axis(locked.harmonics(seen)),
            locked.FIELD_BY_RATE * locked.on_each_axis(rate),
            locked.BY_CHANGE * locked.change_columns(change),
        ],
        axis=2,
    )
    products = locked.BY_RATE_SQUARED * locked.rate_products(step_rate.T)
    by_motion = np.einsum("rin,nk->rkin", motion.by_bias, products)
    weight = field.by_x[0, 6]  # - sqrt(weight) / s_m
    return weight * by_field.transpose(1, 2, 0), by_motion.reshape(2, -1, len(seen))


def _whitening(H: Array) -> tuple[Array, Array]:
    """Roots (E, n, n) that whiten gradients of H (E, n, n), and the number of determined directions
    (E,).
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-30))
    values, vectors = np.linalg.eigh(H * scale[:, :, None] * scale[:, None, :])
    good = values > _WEAKEST
    root = np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0)
    whiten = root[:, :, None] * np.swapaxes(vectors, 1, 2) * scale[:, None, :]
    return whiten, np.count_nonzero(good, axis=1)


# -- A contradiction -------------------------------------------------------------------------------
#
# A passing magnet disturbs some rows. A magnet that stays with the sensor disturbs all of them, and
# another hard iron explains the residuals (`model_checks.py`).

_MOST_ROWS = 0.6  # share of the rows that must contradict
_LEAST_SPREAD_RAD = 0.1  # spread of the field's direction over the rows that contradict
_EXPLAINED = 0.9  # share of the epoch's cost that another hard iron alone must take away
# hard iron and borders among the numbers of `chain.Quadratic`
_IRON_AND_BORDERS = np.r_[6:9, 12:16]


def contradicts(
    epoch: WindowEpoch, c: Array, covariance: Array, usual: chain.Noise, limit_sigma: float
) -> bool:
    """Whether most rows are beyond what noise and the covariance (9, 9) of c allow, and another
    hard iron explains the epoch.

    The rows must have more than one attitude: at a single attitude, a change of the iron and a
    change of place look the same.

    The directions must still be where the epoch was linearised, at c.
    """
    u = chain.move_directions(epoch.u, epoch.quadratic, np.zeros(chain.WIDTH))
    jacobian = chain.symmetric_columns(epoch.data.field_directions(u))
    jacobian = np.concatenate([jacobian, np.broadcast_to(np.eye(3), (len(u), 3, 3))], axis=2)
    known = np.sum((jacobian @ covariance) * jacobian, axis=(1, 2))
    error = np.sum(epoch.data.field_error(u, c) ** 2, axis=1)
    beyond = error > limit_sigma**2 * (usual.mag_gauss**2 / epoch.data.count + known)
    if not epoch.has_motion or float(np.mean(beyond)) <= _MOST_ROWS:
        return False
    if principal_deviation(u[beyond]) < _LEAST_SPREAD_RAD:
        return False
    q = epoch.quadratic
    H, g = q.H[np.ix_(_IRON_AND_BORDERS, _IRON_AND_BORDERS)], q.g[_IRON_AND_BORDERS]
    explained = 0.5 * g @ np.linalg.lstsq(H, g, rcond=1e-12)[0]
    return bool(explained > _EXPLAINED * q.cost)
