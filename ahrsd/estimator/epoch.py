"""An epoch in the window: what it measured, where it was linearised, and the factor it became.

And what it says beyond that factor: of the noise, of the model's misfit, of an instrument's turned
axes, lag and scale, and whether it contradicts a calibration that is sure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ahrsd.estimator import chain, locked, noise
from ahrsd.estimator.chain import halfway
from ahrsd.estimator.epoch_data import rates, spread
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

_SHORTEST_GAP_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class EpochContent:
    """What an epoch is, wherever it is linearised: from node a to the next.

    walk: information of the gyro bias's random walk over it; turned: whether it calibrates.
    """

    data: chain.EpochData
    a: int
    walk: float
    has_motion: bool
    typical: noise.Typical


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentInformation:
    """Quadratic of an epoch in iron, gyro's bias and instrument (see `instrument`): H (28, 28), and
    g (28,) at c (9,) and bias (3,), where the epoch was linearised."""

    H: Array
    g: Array
    c: Array
    bias: Array

    def at(self, c: Array, bias: Array) -> Array:
        """Gradient (28,) there."""
        return np.asarray(self.g + self.H[:, :12] @ np.r_[c - self.c, bias - self.bias])


@dataclass(frozen=True, slots=True, eq=False)
class LockedInformation:
    """An epoch's quadratic in what is in `InstrumentInformation` and in what is `locked` besides,
    in units of its ordinary sizes (`LOCKED` says where): `told`.

    roots: by what each of `LOCKED` is whitened, (n, n); freedom: and how many directions of it the
    epoch tells; noise: that it was linearised with
    """

    information: InstrumentInformation
    roots: dict[str, Array]
    freedom: dict[str, int]
    noise: chain.Noise


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPlan:
    """Where one is to be linearised: directions, noise, weights of the fields (None for 1)."""

    piece: EpochContent
    u: Array
    used: chain.Noise
    weights: Array | None = None


@dataclass(slots=True, eq=False)
class WindowEpoch:
    """One epoch in the window: what it is, directions, noise, and its factor.

    used: the noise that it was linearised with; usual: that of the window then; instrument, locked:
    set by `linearise_instrument` and `linearise_locked`.
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
        """What it measured."""
        return self.piece.data

    @property
    def a(self) -> int:
        """The node at its beginning; the next one is at its end."""
        return self.piece.a

    @property
    def has_motion(self) -> bool:
        """Whether it calibrates."""
        return self.piece.has_motion

    @property
    def weights(self) -> Array:
        """Of its fields."""
        return self.quadratic.weights

    @property
    def cells(self) -> DirectionCells:
        """Where its directions were."""
        if self._cells is None:
            self._cells = DirectionCells.of(self.u, self.data.count)
        return self._cells

    @property
    def residuals(self) -> noise.Residuals:
        """What it says about the noise, at its linearisation point."""
        if self._residuals is None:
            self._residuals = noise.residuals(
                self.quadratic, self.data, self.used, self.piece.typical
            )
        return self._residuals

    @property
    def cost(self) -> float:
        """Half the sum of squares with the interior directions at their best."""
        return self.quadratic.cost


def epoch_scores(epochs: Sequence[WindowEpoch]) -> list[MisfitScore]:
    """What epochs ask for, found once where each was linearised."""
    new = [e for e in epochs if e.score is None]
    for epoch, score in zip(
        new, misfit_scores([e.factor for e in new]) if new else [], strict=True
    ):
        epoch.score = score
    return [e.score for e in epochs if e.score is not None]


def begin_epoch(
    graph: Graph, data: chain.EpochData, walk: float, *, has_motion: bool
) -> tuple[EpochContent, Array]:
    """A new epoch, with the nodes that it needs in the graph, and directions to start from.

    walk: of the gyro's bias, rad/s/sqrt(s).
    """
    a = graph.last
    u = chain.start_directions(chain.symmetric(graph.c[:6]), graph.c[6:], data.field_b_gauss)
    if data.measures_first and graph.until_s is not None:
        gap_s = max(float(data.time_s[0]) - graph.until_s, _SHORTEST_GAP_S)
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
    """Put borders that are at directions of single fields to where their epochs alone want them.

    Until then a chain is bent towards the noise of one field and seems that noisy itself; for an
    epoch at rest, whose borders only a token moves, for long.
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
    """A window's calibration c (9,), nodes by index, epochs and factors at one moment.

    damping: of the next step
    """

    damping: float
    c: Array
    nodes: dict[int, Node]
    epochs: list[WindowEpoch]
    factors: list[Factor]


# -- Misfit ----------------------------------------------------------------------------------------
#
# How much more the epochs disagree than their covariances allow: 1 for a perfect model.
#
# At the optimum an epoch's gradient r_i on (c, bias) has the covariance S_i (its information) if
# the model is right, so r_i^T S_i^-1 r_i averages to its rank, less what the fit used up. Coloured
# noise, a wandering field or a lag make it larger, and the covariance of the estimate is multiplied
# by it.

_CALIBRATION_AND_BIAS = np.r_[0:12]
_FITTED_PARAMETERS = 12.0  # parameters that the fit took from the misfit_scores
_MEMORY = 0.98  # per epoch that left the window


@dataclass(frozen=True, slots=True, eq=False)
class MisfitScore:
    """What an epoch asks of z = [c, bias] (12,) from where it was linearised, its borders at best.

    The whitened gradient is `asked` (12,) there and `turning` (12, 12) z more elsewhere.

    freedom: degrees of freedom; directions of which the epoch says nothing ask for nothing.
    """

    whitened_gradient: Array
    root: Array
    freedom: float

    @property
    def information(self) -> Array:
        """On z (12, 12)."""
        return np.asarray(self.root.T @ self.root)


def misfit_scores(factors: Sequence[Factor]) -> list[MisfitScore]:
    """Of several epochs' factors."""
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
    """Scores of the epochs that left the window, and the figure with those that are in it."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0.0

    @property
    def epochs(self) -> float:
        """How many whole epochs are remembered."""
        return self._count / _FITTED_PARAMETERS

    def remember(self, factor: Factor, score: MisfitScore, graph: Graph) -> None:
        """An epoch leaves the window: keep its score."""
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
        """Mean square of the scores per degree of freedom, where `step` leads, and its sigma by
        chance were the model right.

        At the joint optimum, not at the present values: what all epochs ask for together is not
        disagreement.
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
    """Sum of squares of what is asked for at c and the biases (N, 3), and degrees of freedom."""
    z = np.empty((len(factors), 12))
    z[:, :9] = c - np.array([f.point.c for f in factors])
    z[:, 9:] = biases - np.array([f.point.a.bias for f in factors])
    roots = np.array([s.root for s in scores])
    whitened = np.array([s.whitened_gradient for s in scores]) + (roots @ z[:, :, None])[:, :, 0]
    return float(np.sum(whitened * whitened)), sum(s.freedom for s in scores)


# -- Instrument ------------------------------------------------------------------------------------
#
# What an instrument may have besides iron and bias: turned axes, a lag, a wrong scale of angles.
#
# Turn: the magnetometer's axes are taken to be the gyro's. If they are not, the rate in the
# magnetometer's frame is R w with R = Exp(theta), and a step's rotation is R phi, phi without the
# bias: what rests tell of the bias in the readings is then nothing of the gyro's matrix, and the
# bias is in the gyro's own axes. Derivative: dq/dtheta = dq/dphi dphi/dtheta = (dq/dw_b / dt)
# [phi]x.
#
# Lag: a reading of the field that is tau late is that of the direction u(t - tau). With du/dt = -w
# x u its derivative is dr/dtau = -M (w x u) / s_m.
#
# Scale: the gyro's angles are (1 + s) times too small if its unit or the time between samples is
# wrong: a host's clock, messages lost without a trace. Whoever turns a full circle sees it; what is
# estimated with it means nothing. dq/ds = -(dq/dw_b / dt) phi.
#
# Shape: the gyro's axes have scales of their own and are not at right angles: its angles are (1 +
# E) times too small, E symmetric and traceless (5). It is not asked for, only considered: what it
# may do to the answer widens the answer.
#
# Place: the field in the world differs by place, and a vehicle that circles is at another place on
# each heading: dh = G e, e the heading's cosine and sine, G (3, 2) in the world's axes. A part of
# that is the same on all headings in the sensor and passes for hard iron, another for soft iron: no
# fit shows them. dr/dG = -M R (axis) e / s_m / |h|, R from the field's direction and gravity. It is
# only considered too, and of one of `parameters.PLACES`, as likely as what does show makes it.
#
# One Gauss-Newton step from the answer gives them beside M, b and the bias. On fast motion one
# looks like another, so they are asked for together. Every epoch stands alone here, its borders
# free.

# What the data ask for is taken out of them (`TakenOut`): the field is taken to be late, the gyro's
# angles are multiplied by a matrix. The step is then one more from there.

TURN, LAG, SCALE = slice(12, 15), 15, 16
_ESTIMATED = 17  # what an instrument is asked for; its shape (5) is only considered
PLACE = slice(22, 28)  # of how the field differs with where the sensor heads
_SIZE = 28
_CALIBRATION, _BIAS, _IMPERFECT = slice(0, 12), slice(9, 12), slice(12, _SIZE + 3)
_ANGLE_COLUMNS = np.r_[12:15, 16:22]
_SCALES = np.r_[SCALE:22]
_FIELD_COLUMNS, _MOTION_COLUMNS = np.r_[0:9, LAG, PLACE], np.r_[9:15, SCALE:22]
_PRIOR_TURN_RAD, _PRIOR_LAG_S, _PRIOR_SCALE = 0.2, 0.05, 0.5
IMPERFECTIONS = ("axes", "lag", "scales", "place", "bias")
_PLACE = np.r_[10:16]
_IMPERFECTION_ROWS = (
    np.r_[0:3],
    np.r_[3:4],
    np.r_[4:10],
    _PLACE,
    np.r_[16:19],
)  # of what is considered
_MISSCALED, _MISSCALED_SIGMAS = 0.03, 3.0  # more than any gyro of the kind; beyond chance
_GYRO = np.r_[TURN, SCALE:22]  # what turns or scales the gyro's angles
GYRO_AMONG_IMPERFECTIONS = _GYRO - 12  # the same among what is considered
REQUIRED_NATS = 5.0  # nats by which an instrument with imperfections must be likelier
_WORTH_SIGMAS = 0.3  # of what is known of them: less is not worth another step
_CONSTANT = np.r_[0:9, 12:_SIZE]  # all but the gyro's bias
_LEAST_HORIZONTAL = 0.05  # sine of an angle: less tells no heading
_WEAKEST = 1e-4  # scaled information of a direction of which an epoch says something


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentCorrection:
    """What of an instrument is taken out of the epochs' data already.

    lag_s: by which the field is late; gyro: (3, 3) by which the gyro's angles are multiplied
    walk: by which its bias is let go, besides what every gyro's does, rad/s/sqrt(s)
    """

    lag_s: float
    gyro: Array
    walk: float = 0.0

    @staticmethod
    def identity() -> InstrumentCorrection:
        """Of a perfect instrument."""
        return InstrumentCorrection(0.0, np.eye(3))

    @property
    def is_nonzero(self) -> bool:
        """Whether there is any."""
        return self.lag_s != 0.0 or self.walk > 0.0 or not np.array_equal(self.gyro, np.eye(3))

    @property
    def gyro_parameters(self) -> Array:
        """Turn (3), scale and shape (5) of the matrix."""
        E = self.gyro - np.eye(3)
        scale = float(np.trace(E)) / 3
        S = (E + E.T) / 2 - scale * np.eye(3)
        turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
        apart = [(S[0, 0] - S[1, 1]) / 2, -S[2, 2] * np.sqrt(3.0) / 2]
        return np.array([*turn, scale, *apart, S[1, 2], S[0, 2], S[0, 1]])

    def with_gyro(self, parameters: Array) -> InstrumentCorrection:
        """With this much more of turn (3), scale and shape (5)."""
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


#: (9, 3, 3) matrices of one of each of turn, scale and shape, on the gyro's angles
GYRO_BASIS = np.array(
    [InstrumentCorrection.identity().with_gyro(one).gyro - np.eye(3) for one in np.eye(9)]
)


@dataclass(frozen=True, slots=True, eq=False)
class Instrument:
    """Step (17,) from the answer in [M (6), b (3), w_b (3), theta (3), tau, s], and its covariance.

    misfit: how much the epochs still disagree after the step; it is in the covariance
    scaled: by how much the gyro's angles were scaled before
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
        """Share of themselves by which the gyro's angles are too small; 0: they may be right."""
        scale, sigma = self._of(SCALE)
        scale += self.scaled
        return scale if abs(scale) > max(_MISSCALED, _MISSCALED_SIGMAS * sigma) else 0.0

    def _of(self, row: int) -> tuple[float, float]:
        return float(self.step[row]), float(np.sqrt(self.covariance[row, row]))


InformationStack = tuple[Array, Array]
"""H (N, 17, 17) and gradient (N, 17) of epochs, all directions eliminated."""


def instrument_quadratics(epochs: Sequence[WindowEpoch], graph: Graph) -> InformationStack:
    """Quadratics of the epochs with motion around the present estimate.

    LinAlgError where none has motion, or its directions are not determined.
    """
    H, g = full_instrument_quadratics(epochs, graph)
    return H[:, :_ESTIMATED, :_ESTIMATED], g[:, :_ESTIMATED]


def full_instrument_quadratics(epochs: Sequence[WindowEpoch], graph: Graph) -> InformationStack:
    """The same with the gyro's shape and the place: H (N, 28, 28) and gradient (N, 28).

    Each as it was where the epoch was linearised, so that it is computed once for each.
    """
    linearise_instrument(epochs)
    moving = [(e.instrument, graph.nodes[e.a].bias) for e in epochs if e.has_motion]
    if not moving:
        raise np.linalg.LinAlgError("no epoch with motion")
    known = [(one, bias) for one, bias in moving if one is not None]
    H = np.array([one.H for one, _ in known])
    return H, np.array([one.at(graph.c, bias) for one, bias in known])


def rest_quadratics(epochs: Sequence[WindowEpoch], graph: Graph) -> InformationStack:
    """Quadratics (R, 28, 28) and gradients (R, 28) of the epochs without motion: of the gyro's bias
    alone, around that of their nodes."""
    resting = [e for e in epochs if not e.has_motion]
    H, g = np.zeros((len(resting), _SIZE, _SIZE)), np.zeros((len(resting), _SIZE))
    for k, epoch in enumerate(resting):
        factor = epoch.factor
        H[k, _BIAS, _BIAS] = factor.H[_BIAS, _BIAS]
        moved = graph.nodes[epoch.a].bias - factor.point.a.bias
        g[k, _BIAS] = factor.g[_BIAS] + factor.H[_BIAS, _BIAS] @ moved
    return H, g


class FoldedInformation:
    """Information on iron, turn, lag and scale from epochs that left the window, as one Gaussian.

    The gyro's bias walks, so each epoch had its own, which is eliminated.
    """

    def __init__(self) -> None:
        self._H: Array = np.zeros((_SIZE, _SIZE))
        self._eta: Array = np.zeros(_SIZE)  # H x - gradient, x as `_place`

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
        """A lag is known, and nothing of the iron."""
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
        """With one epoch more, which was linearised with this taken out; sigma_bias in rad/s."""
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
        """H (28, 28) and gradient (28,) there."""
        return self._H, self._H @ _instrument_point(c, correction) - self._eta


def _instrument_point(c: Array, correction: InstrumentCorrection) -> Array:
    x = np.zeros(_SIZE)
    x[:9], x[LAG], x[_GYRO] = c, correction.lag_s, correction.gyro_parameters
    return x


def linearise_instrument(epochs: Sequence[WindowEpoch]) -> None:
    """Compute `WindowEpoch.instrument` of the epochs with motion that do not have it yet, together
    those that were linearised at one calibration."""
    missing = [epoch for epoch in epochs if epoch.has_motion and epoch.instrument is None]
    for point in {id(epoch.factor.point.c): epoch.factor.point.c for epoch in missing}.values():
        _set_instrument_information(
            [epoch for epoch in missing if epoch.factor.point.c is point], point
        )


def lag_uncertainty(
    epochs: Sequence[WindowEpoch], graph: Graph, past: FoldedInformation, sigma_bias: float
) -> Lag:
    """Sigma of the lag that is taken out of the field, from all data.  LinAlgError: unobservable.

    The iron is estimated with that lag. Its errors at the true lag do not correlate with that of
    the lag, so what both make adds up.
    """
    linearise_instrument(epochs)
    H = past.at(graph.c, InstrumentCorrection.identity())[0]
    H = H + sum(epoch.instrument.H for epoch in epochs if epoch.instrument is not None)
    H = prior_quadratic(graph, sigma_bias)[0] + H[:_ESTIMATED, :_ESTIMATED]
    sigma = float(np.sqrt(graph.temper * _inverse(H)[LAG, LAG]))
    return Lag(sigma, -sigma * (_inverse(H[:12, :12]) @ H[:12, LAG]))


@dataclass(frozen=True, slots=True, eq=False)
class Lag:
    """1-sigma of a lag, and by how much [M, b, w_b] (12,) would be wrong were it one sigma off."""

    sigma_s: float
    spread: Array


def _inverses(H: Array) -> Array:
    """Of each (..., n, n), as `_inverse`."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=-2, axis2=-1), 1e-30))
    sizes = scale[..., :, None] * scale[..., None, :]
    return np.asarray(np.linalg.inv(H * sizes) * sizes)


def _inverse(H: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
    return np.asarray(np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale))


def estimate_instrument(
    epochs: InformationStack,
    graph: Graph,
    sigma_bias: float,
    before: tuple[Array, Array] | None = None,
    scaled: float = 0.0,
) -> Instrument:
    """Misalignment, lag and scale from the epochs of a settled window and those before it.

    LinAlgError where the motion does not tell.
    """
    H, g = prior_quadratic(graph, sigma_bias)
    if before is not None:
        H, g = H + before[0][:_ESTIMATED, :_ESTIMATED], g + before[1][:_ESTIMATED]
    H, g = H + epochs[0].sum(axis=0), g + epochs[1].sum(axis=0)
    covariance = _inverse(H)
    step = -covariance @ g
    misfit = max(1.0, disagreement(*epochs, step))
    return Instrument(step, misfit * covariance, misfit, scaled)


@dataclass(frozen=True, slots=True, eq=False)
class ImperfectionLikelihood:
    """What is known of an instrument's imperfections (`_REST`, 19), and what they do to the answer.

    alone (12, 12) covariance of [M, b, w_b] were it perfect; by_rest (12, 19): what one of each
    does to them; own (12,) their gradient; known (19, 19) and asked (19,): information and gradient
    of the imperfections from the data, the answer following them; already (19,): what of them is
    taken out of the data
    disagree: how much the epochs disagree after a step (31,) of all
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
        """Of epochs (of these times, (N,)) and those before.  LinAlgError: the motion tells not."""
        epochs = add_bias_drift(epochs, times_s)
        H, g = epochs[0].sum(axis=0), epochs[1].sum(axis=0)
        H[:_SIZE, :_SIZE] += before[0]
        g[:_SIZE] += before[1]
        own_H, own_g = prior_quadratic(graph, sigma_bias)
        covariance = _inverse(H[_CALIBRATION, _CALIBRATION] + own_H[_CALIBRATION, _CALIBRATION])
        response, gradient = (
            -covariance @ H[_CALIBRATION, _IMPERFECT],
            g[_CALIBRATION] + own_g[_CALIBRATION],
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
        """Spread (..., 19, 19) over the temper, and what they are beyond what is taken out
        (..., 19), of instruments like that (..., 19)."""
        pull = temper / sigmas**2
        spread = _inverses(self.information + pull[..., None] * np.eye(pull.shape[-1]))
        return spread, -(spread @ (self.imperfection_gradient + pull * self.corrected)[..., None])[
            ..., 0
        ]

    def temper(self, sigmas: Array, most: float) -> float:
        """By how much the epochs disagree once what they say of the imperfections is in."""
        mean = self.posterior(sigmas, most)[1]
        step = np.r_[-self.covariance @ self.gradient + self.response @ mean, mean]
        return min(most, max(1.0, self.misfit_after(step)))

    def log_evidence(self, sigmas: Array, mean: Array, temper: float) -> Array:
        """Log of how likely the data are of instruments like that (..., 19), up to a constant.

        rest: what they were found to be
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
    """All instruments that may be, at all places, against what the data say of them.

    every (K, 19) their sigmas; prior (K,) log of how likely they are without the data; evidence
    (K,); spread (K, 19, 19) and rest (K, 19) what the data leave open of each and say that it is,
    beyond what is taken out already
    """

    likelihood: ImperfectionLikelihood
    sigmas: Array
    log_prior: Array
    log_evidence: Array
    spread: Array
    means: Array

    @staticmethod
    def of(likelihood: ImperfectionLikelihood, graph: Graph, kinds: Kinds) -> InstrumentPosterior:
        """What an imperfection makes the epochs disagree is no noise."""
        may_be = possible_instruments(*kinds)
        sigmas = may_be.sigmas
        temper = likelihood.temper(sigmas.max(axis=0), graph.temper)
        spread, means = likelihood.posterior(sigmas, temper)
        log_evidence = likelihood.log_evidence(sigmas, means, temper)
        return InstrumentPosterior(
            likelihood, sigmas, may_be.log_prior, log_evidence, temper * spread, means
        )

    def probabilities(self) -> Array:
        """How likely each is (K,), the data and all else taken together."""
        log_weights = self.log_evidence + self.log_prior
        shares = np.exp(log_weights - log_weights.max())
        return np.asarray(shares / shares.sum())

    def most_probable(
        self, which: Array | slice, required_nats: float = REQUIRED_NATS
    ) -> int | None:
        """The likeliest of those in which some of `which` are larger than need be; None where it is
        not likelier than the others by `told` nats."""
        found, gain = self.log_odds_against_smallest(which)
        return None if gain < required_nats else found

    def log_odds_against_smallest(self, which: Array | slice) -> tuple[int, float]:
        """The likeliest of those in which some of `which` are larger than need be, and by how many
        nats it is likelier than the likeliest of those in which all are as small as may be.

        Whatever else is wrong with either is free: a field that differs by place may be what looks
        like a gyro.
        """
        sizes = self.sigmas[:, which]
        smallest = np.all(sizes == sizes.min(axis=0), axis=1)
        if smallest.all():
            return 0, -np.inf
        others = np.where(smallest, -np.inf, self.log_evidence)
        return int(np.argmax(others)), float(others.max() - self.log_evidence[smallest].max())


@dataclass(frozen=True, slots=True, eq=False)
class Widening:
    """What imperfections of the instrument and the place do to an answer.

    added: to the covariance (12, 12) of [M, b, w_b]; parts: what each of `IMPERFECTIONS` alone
    adds, which together may be more or less; place_gauss: by how much the field differs with the
    heading, rms of what is expected of its six numbers; gyro (9, 9): covariance of turn, scale and
    shape of the gyro's angles beyond what is taken out; with_gyro (12, 9): and with [M, b, w_b]
    """

    added: Array
    parts: dict[str, Array]
    place_gauss: float
    gyro: Array
    with_gyro: Array

    def joint(self, covariance: Array, K: Array) -> Array:
        """(21, 21) of K (12, 12) times [M, b, w_b], whose covariance is given, and the gyro's."""
        cross = K @ self.with_gyro
        return np.block([[covariance, cross], [cross.T, self.gyro]])

    @staticmethod
    def zero() -> Widening:
        """Of a perfect instrument, or where nobody can tell."""
        return Widening(np.zeros((12, 12)), {}, float("nan"), np.zeros((9, 9)), np.zeros((12, 9)))


def widening_by_imperfections(posterior: InstrumentPosterior) -> Widening:
    """What imperfections of the instrument do to the answer.

    The answer takes the instrument to be perfect. It is one of `instruments`, each as likely as
    the data make it. Of each, what the data leave open of the imperfections spreads the answer, and
    what they say that they are is an error of it. So their sizes, which a few numbers tell badly,
    count as far as they are not known: the mean of the variances, not that of the likeliest.
    """
    response, means, probabilities = (
        posterior.likelihood.response,
        posterior.means,
        posterior.probabilities(),
    )
    mean = np.tensordot(probabilities, posterior.spread, 1) + (probabilities * means.T) @ means
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
    """Walk of the gyro's bias (rad/s/sqrt(s)) by which it would drift as far as it did in span_s.

    0 where an instrument that does not drift is as likely.
    """
    found = posterior.most_probable(slice(-3, None))
    drift = np.zeros(3) if found is None else posterior.means[found][-3:]
    return float(np.sqrt(np.mean(np.square(drift)) / max(span_s, 1.0)))


def required_gyro_correction(posterior: InstrumentPosterior, required_nats: float) -> Array | None:
    """Turn (3), scale and shape (5) that the gyro's angles are to be corrected by, once more.

    None where an instrument like that is not likelier than its maker's by `told` nats, unless some
    of it is taken out already, or where the step is not worth it.
    """
    found = posterior.most_probable(
        GYRO_AMONG_IMPERFECTIONS, -np.inf if posterior.likelihood.corrected.any() else required_nats
    )
    if found is None:
        return None
    step = posterior.means[found][GYRO_AMONG_IMPERFECTIONS]
    known = posterior.spread[found][np.ix_(GYRO_AMONG_IMPERFECTIONS, GYRO_AMONG_IMPERFECTIONS)]
    worth = float(np.sqrt(step @ np.linalg.solve(known, step) / len(step)))
    return step if worth > _WORTH_SIGMAS else None


def add_bias_drift(epochs: InformationStack, times_s: Array) -> InformationStack:
    """H (N, 31, 31) and g (N, 31): and by how much the gyro's bias came to be in all the epochs.

    It moved at one rate; w_b is that of the newest epoch.
    """
    H, g = epochs
    span_s = max(float(np.ptp(times_s)), 1e-9)
    until = (times_s - float(np.max(times_s)))[:, None] / span_s
    with_bias = np.concatenate([H, until[:, None] * H[:, _BIAS]], axis=1)
    both = np.concatenate([with_bias, until[:, None] * with_bias[:, :, _BIAS]], axis=2)
    return both, np.concatenate([g, until * g[:, _BIAS]], axis=1)


def prior_quadratic(graph: Graph, sigma_bias: float) -> tuple[Array, Array]:
    """H (17, 17) and gradient (17,) of what is known without the epochs."""
    H, g = np.zeros((_ESTIMATED, _ESTIMATED)), np.zeros(_ESTIMATED)
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
    gradients = scale * (g + (H @ np.broadcast_to(steps, g.shape)[:, :, None])[:, :, 0])
    projected = (np.swapaxes(vectors, 1, 2) @ gradients[:, :, None])[:, :, 0]
    count = int(np.count_nonzero(good))
    return float(np.sum(projected[good] ** 2 / values[good]) / max(count - H.shape[1], 0.2 * count))


def _set_instrument_information(epochs: Sequence[WindowEpoch], c: Array) -> None:
    """`WindowEpoch.instrument` of epochs that were linearised at c."""
    for epoch, own in zip(epochs, _quadratics(epochs, c), strict=True):
        at = c, epoch.factor.point.a.bias
        epoch.instrument = InstrumentInformation(own[:_SIZE, :_SIZE], own[:_SIZE, _SIZE], *at)


def _quadratics(
    epochs: Sequence[WindowEpoch], c: Array, further: Callable[..., _Columns] | None = None
) -> Array:
    """H (E, n, n) with the gradient as its last column, of epochs that were linearised at c.

    further: makes of both parts, directions, rates and rows more columns, whose numbers come after
    those of the instrument, the field's before the motion's
    """
    rows = chain.Rows.of(
        [chain.Chain(e.data, e.u, e.factor.point.a.bias, e.used, e.weights) for e in epochs]
    )
    field, motion = chain.parts(rows, c)
    turned = rows.angle_b_rad - rows.bias * rows.dt_s
    turn = _gyro_matrix_columns(motion.by_bias / rows.dt_s, turned)
    seen = np.concatenate([e.data.seen(e.u) for e in epochs])
    rate = np.concatenate([rates(e.data) for e in epochs])
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
    diag, upper, border = chain.interior(field, motion)
    columns = np.zeros((2, size + 1, len(rate)))
    columns[:, :12], columns[:, size] = border[:, :12], border[:, 12]
    angles = np.r_[_ANGLE_COLUMNS, split:size]
    by_angle = K[:, 3:-1]
    columns[:, angles] = -motion.scale * by_angle
    columns[:, angles, :-1] += np.einsum("rin,rjn->ijn", motion.prev[:, :, 1:], by_angle[:, :, 1:])
    columns[:, LAG] = np.einsum("rn,rin->in", late, field.own)
    columns[:, PLACE] = np.einsum("rjn,rin->ijn", place, field.own)
    columns[:, _SIZE:split] = np.einsum("rjn,rin->ijn", of_field, field.own)
    _, half = halfway(diag, upper, np.ascontiguousarray(columns.transpose(1, 2, 0)))
    fields = np.r_[_FIELD_COLUMNS, _SIZE:split, size]
    motions = np.r_[_MOTION_COLUMNS, split:size, size]
    H = np.zeros((len(epochs), size + 1, size + 1))
    for k, (a, b) in enumerate(zip(rows.first.tolist(), (rows.last + 1).tolist(), strict=True)):
        Y = half[2 * a : 2 * b]
        H[k] = -(Y.T @ Y)
        H[k][np.ix_(fields, fields)] += chain.squares(J[:, :, a:b])
        H[k][np.ix_(motions, motions)] += chain.squares(K[:, :, a:b])
    for epoch, own in zip(epochs, H, strict=True):
        own[_SCALES, size] -= _gyro_noise_gradient(epoch)
    return H


_Columns = tuple[Array, Array]
"""Of the field's residuals (3, n, N) and of the motion's (2, m, N)."""


def _place_columns(field: chain.FieldPart, seen: Array, down: Array, c: Array) -> Array:
    """Residuals (3, 6, N) by a field that differs with the heading, gauss: north, east and down of
    it, each with the heading's cosine and sine.

    seen, down (N, 3): directions of the field and to the earth. Nothing where they do not tell.
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
    """What the gyro's own noise seems to ask of scale (1) and shape (5): the gradient that it has.

    Angles that are made smaller have less noise. A step's noise (1 + E) n is seen across the field,
    so half its square grows by n' (1 - u u') E n, of which a half is in each direction.
    """
    uu = epoch.u.T @ epoch.u / len(epoch.u)
    along = [uu[0, 0] - uu[1, 1], (uu[0, 0] + uu[1, 1] - 2 * uu[2, 2]) / np.sqrt(3.0)]
    along += [2 * uu[1, 2], 2 * uu[0, 2], 2 * uu[0, 1]]
    # of squares beyond what noise makes, the gyro is not the cause
    squares = min(epoch.quadratic.sum_gyro, epoch.residuals.gyro_freedom)
    return np.asarray(squares * np.array([1.0, *(-0.5 * x for x in along)]))


def _gyro_matrix_columns(by_angle: Array, angle: Array) -> Array:
    """dq/dtheta, dq/ds and dq/dE, (2, 9, N), of dq/dphi (2, 3, N) and phi (3, N).

    E: x and y apart, z against both, then the three shears.
    """
    (x, y, z), (p, q, r) = by_angle.transpose(1, 0, 2), angle
    turn = [y * r - z * q, z * p - x * r, x * q - y * p]  # by_angle [phi]x
    shape = [y * q - x * p, (2 * z * r - x * p - y * q) / np.sqrt(3.0)]
    shape += [-(y * r + z * q), -(x * r + z * p), -(x * q + y * p)]
    return np.array([*turn, -(x * p + y * q + z * r), *shape]).transpose(1, 0, 2)


# -- What is locked to attitude, rate and time -----------------------------------------------------
#
# What real instruments and places leave over besides (`locked`): harmonics of the field's direction
# on each axis of the sensor; the field by the rate, and its change by axes that are late by
# different times; products of the gyro's rates. They are not asked for, only watched
# (`model_checks`). What follows time is a hard iron of each epoch's own, and needs no columns.

_FIRST_LOCKED = _SIZE
_SAME_CALIBRATION = (
    1e-2  # of the field: a calibration that moved by less leaves 1e-4 of it to second order
)
_SAME_NOISE = 0.1  # of a noise level, by which another makes another epoch
LOCKED = {
    "attitude": np.arange(_FIRST_LOCKED, _FIRST_LOCKED + 36),
    "rate": np.arange(_FIRST_LOCKED + 36, _FIRST_LOCKED + 36 + 9 + 8 + 18),
    "time": np.arange(6, 9),
}


def linearise_locked(epochs: Sequence[WindowEpoch]) -> None:
    """Compute `WindowEpoch.locked` of the epochs with motion that do not have it yet, as
    `linearise_instrument`."""
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
    """What is locked in an epoch that was linearised again, where that is as good as before."""
    known = old.locked
    if known is None or old.data is not new.data:
        return None
    c, moved = new.factor.point.c, new.factor.point.c - known.information.c
    far = float(np.linalg.norm(moved)) > _SAME_CALIBRATION * float(
        np.cbrt(np.linalg.det(chain.symmetric(c[:6])))
    )
    other = max(
        abs(new.used.mag_gauss / known.noise.mag_gauss - 1.0),
        abs(new.used.gyro_rad_s / known.noise.gyro_rad_s - 1.0),
    )
    return None if far or other > _SAME_NOISE else known


def _locked_columns(
    field: chain.FieldPart,
    motion: chain.MotionPart,
    seen: Array,
    rate: Array,
    step_rate: Array,
    *,
    c: Array,
) -> _Columns:
    """Of directions seen and rates (N, 3) at the rows, and of the step to each (3, N)."""
    change = np.cross(seen, rate) @ chain.symmetric(c[:6])
    by_field = np.concatenate(
        [
            locked.BY_DIRECTION * locked.on_each_axis(locked.harmonics(seen)),
            locked.FIELD_BY_RATE * locked.on_each_axis(rate),
            locked.BY_CHANGE * locked.of_change(change),
        ],
        axis=2,
    )
    products = locked.BY_RATE_SQUARED * locked.squares(step_rate.T)
    by_motion = np.einsum("rin,nk->rkin", motion.by_bias, products)
    weight = field.by_x[0, 6]  # - sqrt(weight) / s_m
    return weight * by_field.transpose(1, 2, 0), by_motion.reshape(2, -1, len(seen))


def _whitening(H: Array) -> tuple[Array, Array]:
    """Roots (E, n, n) by which gradients of H (E, n, n) are whitened, and how many directions each
    tells (E,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-30))
    values, vectors = np.linalg.eigh(H * scale[:, :, None] * scale[:, None, :])
    good = values > _WEAKEST
    root = np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0)
    whiten = root[:, :, None] * np.swapaxes(vectors, 1, 2) * scale[:, None, :]
    return whiten, np.count_nonzero(good, axis=1)


# -- A contradiction -------------------------------------------------------------------------------
#
# A magnet that passes disturbs some rows; one that stays with the sensor disturbs them all, and
# another hard iron explains what it does (`model_checks.py`).

_MOST_ROWS = 0.6
_LEAST_SPREAD_RAD = 0.1  # rad, spread of the field's direction over the rows that contradict
_EXPLAINED = 0.9  # share of the epoch's cost that another hard iron alone must take away
_IRON_AND_BORDERS = np.r_[
    6:9, 12:16
]  # hard iron and borders among the numbers of `chain.Quadratic`


def contradicts(
    epoch: WindowEpoch, c: Array, covariance: Array, usual: chain.Noise, limit_sigma: float
) -> bool:
    """Most of its rows are beyond what noise and the covariance (9, 9) of c allow, and b mends it.

    They must be of more than one attitude: in one, another iron and another place are the same.

    Its directions must still be where the epoch was linearised, at c.
    """
    u = chain.move(epoch.u, epoch.quadratic, np.zeros(chain.WIDTH))
    jacobian = chain.symmetric_columns(epoch.data.seen(u))
    jacobian = np.concatenate([jacobian, np.broadcast_to(np.eye(3), (len(u), 3, 3))], axis=2)
    known = np.sum((jacobian @ covariance) * jacobian, axis=(1, 2))
    error = np.sum(epoch.data.field_error(u, c) ** 2, axis=1)
    beyond = error > limit_sigma**2 * (usual.mag_gauss**2 / epoch.data.count + known)
    if not epoch.has_motion or float(np.mean(beyond)) <= _MOST_ROWS:
        return False
    if spread(u[beyond]) < _LEAST_SPREAD_RAD:
        return False
    q = epoch.quadratic
    H, g = q.H[np.ix_(_IRON_AND_BORDERS, _IRON_AND_BORDERS)], q.g[_IRON_AND_BORDERS]
    explained = 0.5 * g @ np.linalg.lstsq(H, g, rcond=1e-12)[0]
    return bool(explained > _EXPLAINED * q.cost)
