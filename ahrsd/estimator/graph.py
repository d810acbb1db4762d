"""The factor graph of epochs on GTSAM: solution, marginals, and folding of old epochs.

Keys: `c` for the calibration, `y j` for node j. Every factor is a HessianFactor around the present
values, so one Gauss-Newton step of the graph is one linear solution, whose cost depends only on the
number of factors. The oldest node is folded away by GTSAM's own elimination, which leaves one
factor on (c, y 1) with all information of the past.

Traps of the wrapper that shaped this file: the linear term of HessianFactor is minus the gradient;
the views that it returns die with their owner, so they are copied at once; a rank-deficient system
raises RuntimeError; and a block counts as rank-deficient if its last pivot is 2^12 below the
others, as happens where little is known. So GTSAM eliminates all nodes but the newest, in units in
which their pivots are similar, and the remaining system in c and the newest node (14 numbers) is
solved here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from operator import is_not

import gtsam
import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.samples import Array

# -- Nodes and factors -----------------------------------------------------------------------------
#
# Quadratic factors between the calibration and the nodes between epochs, and their re-basing.
#
# Variables: c = [M (6), b (3)] and, per node between epochs, y = [gyro bias (3), border direction
# (2, in the node's tangent plane)]. A factor remembers where it was linearised; `Stack` expresses
# factors around the present values: the calibration and the bias move additively, a direction moved
# from u0 to u is T0^T (u - u0) away in the old tangent plane, and T0^T T turns the new tangents
# into the old ones.

C = slice(0, 9)
NODE = 5
Y_A = slice(9, 14)
Y_B = slice(14, 19)
SIZE = 19
_BIAS = slice(9, 12)
BORDERS = np.r_[12:14, 17:19]
_CHAIN_BORDERS = np.r_[chain.FIRST, chain.LAST]
_TOKEN = 1.0  # information on a direction, 1/rad^2
# where chain.Quadratic's 16 numbers go among the factor's 19
_FROM_CHAIN = np.r_[0:9, 9:12, 12:14, 17:19]
_CHAIN_BLOCK = np.ix_(_FROM_CHAIN, _FROM_CHAIN)


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """Border between two epochs: the gyro bias from here on (rad/s) and the field's direction.

    Its arrays are never written to: nodes are shared, and replaced as a whole.
    """

    bias: Array
    direction: Array
    tangent: Array

    @staticmethod
    def at(bias: Array, direction: Array) -> Node:
        """A node with a tangent basis of its direction."""
        return Node(bias.copy(), direction.copy(), so3.tangent_basis(direction[None])[0])

    def moved_by(self, step: Array) -> Node:
        """The node after a step (5,), on the sphere."""
        return retract_nodes([self], step[None])[0]

    def rotated(self, R: Array) -> Node:
        """The node with its direction and tangents turned by R (3, 3)."""
        return Node(self.bias, R @ self.direction, R @ self.tangent)


def retract_nodes(nodes: Sequence[Node], steps: Array) -> list[Node]:
    """Nodes after their steps (N, 5), all at once."""
    bias = np.array([n.bias for n in nodes]) + steps[:, :3]
    T = np.array([n.tangent for n in nodes])
    direction = np.array([n.direction for n in nodes]) + (T @ steps[:, 3:, None])[:, :, 0]
    direction /= np.sqrt(np.sum(direction * direction, axis=1, keepdims=True))
    return [Node(*each) for each in zip(bias, direction, so3.tangent_basis(direction), strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class LinearisationPoint:
    """Where a factor was linearised."""

    c: Array
    a: Node
    b: Node


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """cost + g^T z + z^T H z / 2 with z = [c (9), y_a (5), y_b (5)] around `point`.

    Factors on c and one node leave the other node's rows zero. `walk` is the information of the
    random walk of the gyro bias between the nodes, 1/(rad/s)^2, 0 for none.
    """

    a: int
    b: int
    H: Array
    g: Array
    point: LinearisationPoint
    walk: float = 0.0


class Stack:
    """Factors around the present values, all at once: z (F, 19), the displacement of each from its
    `point`.

    `nodes` are the present ones by index.
    """

    def __init__(self, factors: Sequence[Factor], c: Array, nodes: Mapping[int, Node]) -> None:
        self._H = np.array([f.H for f in factors])
        self._g = np.array([f.g for f in factors])
        self._walk = np.array([f.walk for f in factors])
        self._tilt = np.empty((2, len(factors), 2, 2))
        self.z = np.empty((len(factors), SIZE))
        self.z[:, C] = c - np.array([f.point.c for f in factors])
        sides = (
            (9, [nodes[f.a] for f in factors], [f.point.a for f in factors]),
            (14, [nodes[f.b] for f in factors], [f.point.b for f in factors]),
        )
        for k, (at, now, old) in enumerate(sides):
            moved = np.array([n.direction for n in now]) - np.array([n.direction for n in old])
            back = np.swapaxes(np.array([n.tangent for n in old]), 1, 2)
            self.z[:, at : at + 3] = np.array([n.bias for n in now]) - [n.bias for n in old]
            self.z[:, at + 3 : at + 5] = (back @ moved[:, :, None])[:, :, 0]
            self._tilt[k] = back @ np.array([n.tangent for n in now])
        self._bias_change = np.array([nodes[f.b].bias - nodes[f.a].bias for f in factors])

    def cost_increases(self) -> Array:
        """Costs (F,) above those at the `point` of each factor, including the walk of the bias."""
        pulled = (self._H @ self.z[:, :, None])[:, :, 0]
        walks = 0.5 * self._walk * np.sum(self._bias_change**2, axis=1)
        return np.asarray(np.sum((self._g + 0.5 * pulled) * self.z, axis=1) + walks)

    def quadratics(self) -> tuple[Array, Array]:
        """H (F, 19, 19) and gradients (F, 19) around the present values."""
        J = np.tile(np.eye(SIZE), (len(self.z), 1, 1))
        J[:, 12:14, 12:14], J[:, 17:19, 17:19] = self._tilt
        Jt = np.swapaxes(J, 1, 2)
        H = Jt @ self._H @ J
        g = (Jt @ (self._g[:, :, None] + self._H @ self.z[:, :, None]))[:, :, 0]
        i, j = np.arange(9, 12), np.arange(14, 17)
        H[:, i, i] += self._walk[:, None]
        H[:, j, j] += self._walk[:, None]
        H[:, i, j] -= self._walk[:, None]
        H[:, j, i] -= self._walk[:, None]
        g[:, i] -= self._walk[:, None] * self._bias_change
        g[:, j] += self._walk[:, None] * self._bias_change
        return H, g


def epoch_factor(
    q: chain.Quadratic,
    a: int,
    point: LinearisationPoint,
    walk: float,
    *,
    rest: Array | None = None,
    drawn: tuple[bool, bool] = (False, False),
) -> Factor:
    """The factor of one epoch, between nodes a and a + 1, from its eliminated chain.

    An epoch at rest has no information on the calibration, only on the gyro bias, whatever c is:
    the rate that was read is the bias, across the field's direction `rest` (3,), a mean over the
    epoch. Apparent information along the field comes from the noise of the directions and is
    projected out. Its borders keep a token of information, so that they stay determined. `drawn`
    says whether the first and the last border are drawn to the epoch's own optimum; a border shared
    with an epoch with motion is not.
    """
    H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    H[_CHAIN_BLOCK] = q.H
    g[_FROM_CHAIN] = q.g
    if rest is not None:
        gain = np.linalg.solve(H[BORDERS][:, BORDERS], np.c_[H[BORDERS][:, _BIAS], g[BORDERS]])
        cross = H[_BIAS][:, BORDERS]
        wanted = border_step(q) * np.repeat(drawn, 2)
        H_bias, g_bias = H[_BIAS, _BIAS] - cross @ gain[:, :3], g[_BIAS] - cross @ gain[:, 3]
        across = np.eye(3) - np.outer(rest, rest)
        H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
        H[_BIAS, _BIAS], g[_BIAS] = across @ H_bias @ across, across @ g_bias
        H[BORDERS, BORDERS], g[BORDERS] = _TOKEN, -_TOKEN * wanted
    return Factor(a, a + 1, H, g, point, walk)


def border_step(q: chain.Quadratic) -> Array:
    """Step (4,) from the present borders, first and last, to the optimum of the epoch alone.

    A direction that it does not determine stays: a prior of 1 rad, which is negligible otherwise.
    """
    H, g = q.H[_CHAIN_BORDERS][:, _CHAIN_BORDERS], q.g[_CHAIN_BORDERS]
    return np.asarray(-np.linalg.solve(H + np.eye(len(g)), g), dtype=np.float64)


def chain_step(z: Array, *, calibrates: bool = True) -> Array:
    """The 16 numbers of `chain.move` from the 19 of a factor; only the bias if not `calibrates`."""
    step = np.array(z[_FROM_CHAIN])
    if not calibrates:
        step[C], step[12:] = 0.0, 0.0
    return step


def gap_factor(a: int, c: Array, node_a: Node, node_b: Node, walk: float) -> Factor:
    """Factor across a gap, between nodes a and a + 1: it links only the gyro bias."""
    point = LinearisationPoint(c.copy(), node_a, node_b)
    return Factor(a, a + 1, np.zeros((SIZE, SIZE)), np.zeros(SIZE), point, walk)


def bias_prior(node: int, c: Array, at: Node, sigma_bias: float) -> Factor:
    """Prior on the first node's gyro bias (rad/s)."""
    H = np.zeros((SIZE, SIZE))
    H[9:12, 9:12] = np.eye(3) / sigma_bias**2
    return Factor(node, node, H, np.zeros(SIZE), LinearisationPoint(c.copy(), at, at))


# -- The calibration's retraction ------------------------------------------------------------------
#
# How the calibration moves by a finite step: along the valley of the likelihood, not straight.
#
# If motion is nearly planar, the data determine the field's directions u_k up to a common shift
# along the axis of the turn. With C = M^-1 and d = C b, u_k = (C m_k - d) / r, and that family is
# linear in (C, d) up to the common scale r. In (M, b) it is strongly curved, and a Gauss-Newton
# step leaves it at once. So a step dc of [M (6), b (3)] is taken in (C, d), and the scale is
# restored from the moments of the field. To first order nothing changes: derivatives, sigmas and
# the optimum are those of [M, b].


class Moments:
    """First and second moments of the field that the calibration was estimated from."""

    def __init__(self) -> None:
        self._count = 0.0
        self._sum: Array = np.zeros(3)
        self._squares: Array = np.zeros((3, 3))

    def add(self, field: Array) -> None:
        """Add rows (n, 3) in gauss."""
        self._count += len(field)
        self._sum = self._sum + field.sum(axis=0)
        self._squares = self._squares + field.T @ field

    def mean_square(self, C: Array, d: Array) -> float:
        """Mean of |C m - d|^2, 0 before the first row."""
        if self._count == 0:
            return 0.0
        total = np.sum((C @ self._squares) * C) - 2 * d @ C @ self._sum + self._count * d @ d
        return float(total / self._count)


def retract(c: Array, dc: Array, moments: Moments) -> Array:
    """c = [M (6), b (3)] after a step dc; plain c + dc if C would not stay positive definite."""
    found = retract_in_valley(c, dc, moments)
    return np.asarray(c + dc) if found is None else found


def retract_in_valley(c: Array, dc: Array, moments: Moments) -> Array | None:
    """c after a step dc; None if C would not stay positive definite."""
    M, dM = chain.symmetric(c[:6]), chain.symmetric(dc[:6])
    C = np.linalg.inv(M)
    dC = -C @ dM @ C
    d, dd = C @ c[6:], dC @ c[6:] + C @ dc[6:]
    if np.linalg.eigvalsh(C + dC)[0] <= 0:
        return None
    scale = np.sqrt(1.0 + moments.mean_square(dC, dd))
    new = np.linalg.inv((C + dC) / scale)
    return np.concatenate([chain.upper_triangle(new), new @ (d + dd) / scale])


def valley_step(c: Array, to: Array, moments: Moments) -> Array:
    """The step dc (9,) by which `retract` leads to another calibration; to - c if there is none.

    With v = C m - d of each and the restored scale s, s^2 = 1 + mean |s v' - v|^2.
    """
    M = chain.symmetric(c[:6])
    C = np.asarray(np.linalg.inv(M), dtype=np.float64)
    other = np.asarray(np.linalg.inv(chain.symmetric(to[:6])), dtype=np.float64)
    d, other_d = C @ c[6:], other @ to[6:]
    own_square, other_square = moments.mean_square(C, d), moments.mean_square(other, other_d)
    cross = (moments.mean_square(C + other, d + other_d) - own_square - other_square) / 2
    discriminant = cross**2 + (1.0 + own_square) * (1.0 - other_square)
    if cross <= 0.0 or discriminant <= 0.0:
        return np.asarray(to - c)
    scale = (1.0 + own_square) / (cross + np.sqrt(discriminant))
    dC, dd = np.asarray(scale * other - C), np.asarray(scale * other_d - d)
    return np.concatenate([chain.upper_triangle(-M @ dC @ M), M @ (dd - dC @ c[6:])])


def curvature_covariance(c: Array, covariance: Array, moments: Moments) -> Array:
    """Addition to the covariance (9, 9) of c by the curvature of the valley.

    One sigma along a principal direction ends at q from the straight line, t sigmas at t^2 q. For a
    standard normal t the mean square is 3 q q^T.
    """
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    added = np.zeros((9, 9))
    for value, vector in zip(values, vectors.T, strict=True):
        step = np.sqrt(max(float(value), 0.0)) * scale * vector
        q = (retract(c, step, moments) + retract(c, -step, moments)) / 2 - c
        added += 3 * np.outer(q, q)
    return added


# -- The graph -------------------------------------------------------------------------------------


class SingularError(ValueError):
    """The graph has a direction that neither data nor prior determine."""


_C = gtsam.symbol("c", 0)
# Unit of the gyro bias inside GTSAM: (rad/s) / 100, which brings its pivots near the directions'.
_UNITS = np.r_[np.ones(9), np.full(3, 1e-2), 1.0, 1.0, np.full(3, 1e-2), 1.0, 1.0]
_BADLY_KNOWN = 0.1
UNDETERMINED_RATIO = 0.5  # posterior over prior sigma of an undetermined direction
_HOLD = 1e4  # information on a held direction over that of the prior


_FIRST_Y = gtsam.symbol("y", 0)


def _node_key(j: int) -> int:
    return int(_FIRST_Y + j)


def _hessian_factor(factor: Factor, G: Array, linear: Array) -> gtsam.HessianFactor:
    c, a, b = C, Y_A, Y_B
    if factor.a == factor.b:
        return gtsam.HessianFactor(
            _C, _node_key(factor.a), G[c, c], G[c, a], linear[c], G[a, a], linear[a], 0.0
        )
    return gtsam.HessianFactor(
        _C,
        _node_key(factor.a),
        _node_key(factor.b),
        G[c, c],
        G[c, a],
        G[c, b],
        linear[c],
        G[a, a],
        G[a, b],
        linear[a],
        G[b, b],
        linear[b],
        0.0,
    )


def _singular_error(error: RuntimeError) -> SingularError:
    return SingularError(str(error).strip().split("\n", maxsplit=1)[0])


Step = tuple[Array, dict[int, Array]]
"""Moves dc (9,) of the calibration and dy (5,) per node."""


class Graph:
    """Calibration c (9,), nodes and factors; all values are the present linearisation point.

    `anchor` is the prior of c, its mean (9,) and information (9, 9). It is never folded, because
    its weight relative to the data changes: `temper` multiplies its information (see
    `epoch.Misfit`), and `hold` (9, 9) is added to it, which keeps undetermined directions of c at
    the mean.
    """

    def __init__(self, c: Array, belief: Array, first: Node, prior: Factor) -> None:
        """`belief` is the covariance (9, 9) of the anchor, whose mean is c."""
        self.c = c.copy()
        self.anchor = (c.copy(), np.asarray(np.linalg.inv(belief), dtype=np.float64))
        self._whitening = whitening(belief)
        self._held_directions: Array = np.zeros((9, 0))
        self.temper = 1.0
        self.hold: Array = np.zeros((9, 9))
        self.moments = Moments()
        self.nodes: dict[int, Node] = {prior.a: first}
        self.prior = prior
        self.until_s: float | None = None  # time of the newest node
        self.factors: list[Factor] = []
        self._cached: tuple[list[object], tuple[gtsam.GaussianBayesNet, Array, Array]] | None = None

    def copy(self) -> Graph:
        """An independent copy; nodes and factors are shared, since they never change."""
        other = copy(self)
        other.nodes, other.factors = dict(self.nodes), list(self.factors)
        other.moments = copy(self.moments)
        return other

    @property
    def first(self) -> int:
        """Index of the oldest node."""
        return self.prior.a

    @property
    def last(self) -> int:
        """Index of the newest node."""
        return max(self.nodes)

    def _anchor_information(self) -> Array:
        return np.asarray(self.temper * self.anchor[1])

    def anchor_cost(self) -> float:
        """Negative log density of the prior at c, up to a constant."""
        d = self.c - self.anchor[0]
        return float(0.5 * d @ (self._anchor_information() + self.hold) @ d)

    def distance_from_prior(self, covariance: Array) -> float:
        """Mean square, in prior sigmas, of the distance of c from the prior in poorly known
        directions.

        covariance (9, 9) of c, tempered. Poorly known: sigma above _BADLY_KNOWN of the prior's.
        Above 1, prior and data disagree by more than either allows. In planar motion, directions
        that fit the noise lead along the valley to a calibration of any size; this limits them.
        """
        values, vectors = self._variance_over_prior(covariance)
        badly_known = vectors[:, values > _BADLY_KNOWN**2]
        away = badly_known.T @ self._whitening @ (self.c - self.anchor[0])
        return float(np.mean(away * away)) if len(away) else 0.0

    def hold_undetermined(self, limit: float, covariance: Array) -> None:
        """Hold directions whose sigma exceeds `limit` of the prior's at the prior's mean.

        covariance (9, 9) of c, tempered. In the eigenbasis of the posterior, whitened by the prior,
        both are diagonal, so holding one direction moves no other.
        """
        values, vectors = self._variance_over_prior(covariance)
        self._held_directions = vectors[:, values > limit**2]
        blind = self._whitening.T @ self._held_directions
        self.hold = np.asarray(_HOLD * self.temper * blind @ blind.T)

    def _variance_over_prior(self, covariance: Array) -> tuple[Array, Array]:
        """Variances (9,) over those of the prior, and their directions (columns), whitened by the
        prior.
        """
        W = self._whitening
        scaled = W @ covariance @ W.T
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
        return values, vectors

    def _all_factors(self) -> list[Factor]:
        return [self.prior, *self.factors]

    def step(self, damping: float = 0.0) -> Step:
        """One Gauss-Newton step: dc (9,) and dy (5,) per node.

        `damping` adds that multiple of the anchor's information (Levenberg-Marquardt).

        Raises SingularError if the graph does not determine all variables.
        """
        net, H, g = self._reduced_system()
        H, g = H[:14, :14].copy(), g[:14].copy()
        pull = self._anchor_information() + self.hold
        H[C, C] += pull + damping * self.anchor[1]
        g[C] += pull @ (self.c - self.anchor[0])
        if not np.isfinite(g).all():
            raise SingularError("the calibration is not finite")
        solution = -_inverse(H) @ g
        given = gtsam.VectorValues()
        given.insert(_C, solution[C])
        given.insert(_node_key(self.last), solution[Y_A] / _UNITS[Y_A])
        delta = net.optimize(given)
        dy = {j: np.array(delta.at(_node_key(j))) * _UNITS[Y_A] for j in self.nodes}
        return np.asarray(solution[C], dtype=np.float64), dy

    def predict_step(self) -> tuple[Array, Array]:
        """The undamped step dc (9,), and the information (9, 9) of c.

        Raises SingularError as `step` does.
        """
        _, H, g = self._reduced_system()
        H, g = H[:14, :14].copy(), g[:14].copy()
        pull = self._anchor_information() + self.hold
        H[C, C] += pull
        g[C] += pull @ (self.c - self.anchor[0])
        covariance = _inverse(H)
        information = np.asarray(np.linalg.inv(covariance[C, C]), dtype=np.float64)
        return -(covariance @ g)[C], information

    def move(self, dc: Array, dy: dict[int, Array]) -> None:
        """Move all values by a step, the calibration along its valley (`retract`)."""
        self.c = retract(self.c, dc, self.moments)
        steps = np.array([dy[j] for j in self.nodes])
        self.nodes = dict(
            zip(self.nodes, retract_nodes(list(self.nodes.values()), steps), strict=True)
        )

    def rotate_first(self, R: Array) -> None:
        """Rotate the direction of the oldest node by R (3, 3), together with the folded factor on
        it.
        """
        prior = self.prior
        point = replace(prior.point, a=prior.point.a.rotated(R), b=prior.point.b.rotated(R))
        self.prior = replace(prior, point=point)
        self.nodes[self.first] = self.nodes[self.first].rotated(R)

    def covariance(self) -> Array:
        """Joint covariance (12, 12) of c and the newest node's gyro bias, for the assumed noise.

        Without `hold`: an undetermined direction has the sigma of the prior.
        """
        H = self._reduced_system()[1][:14, :14].copy()
        H[C, C] += self._anchor_information()
        return _inverse(H)[:12, :12]

    def project_held(self, c: Array) -> Array:
        """c with the held directions set to the values at which they are held."""
        W = self._whitening
        moved = self._held_directions @ self._held_directions.T @ W @ (c - self.anchor[0])
        return np.asarray(c - np.linalg.solve(W, moved))

    def _reduced_system(self) -> tuple[gtsam.GaussianBayesNet, Array, Array]:
        """All nodes but the newest eliminated, without anchor and hold, which are on c alone.

        Cached until a factor or a value is replaced: anchor, hold and damping change more often.
        """
        factors = self._all_factors()
        used: list[object] = [self.c, *factors, *self.nodes.values()]
        cached = self._cached
        if cached is None or len(cached[0]) != len(used) or any(map(is_not, cached[0], used)):
            net, remaining = _eliminate(self._linear_graph(factors), self._older_nodes())
            cached = self._cached = (used, (net, *_information_of(remaining)))
        return cached[1]

    def _linear_graph(self, factors: list[Factor]) -> gtsam.GaussianFactorGraph:
        graph = gtsam.GaussianFactorGraph()
        H, g = Stack(factors, self.c, self.nodes).quadratics()
        if not (np.isfinite(H).all() and np.isfinite(g).all()):
            raise SingularError("a factor is not finite")
        H, linear = H * np.outer(_UNITS, _UNITS), -g * _UNITS
        for k, factor in enumerate(factors):
            graph.add(_hessian_factor(factor, H[k], linear[k]))
        return graph

    def _older_nodes(self) -> gtsam.Ordering:
        """Ordering of all nodes but the newest, from old to new."""
        ordering = gtsam.Ordering()
        for j in sorted(self.nodes)[:-1]:
            ordering.push_back(_node_key(j))
        return ordering

    def fold_oldest(self) -> None:
        """Eliminate the oldest node: prior and the factors on it become the prior of the next."""
        old = self.first
        touching = [f for f in self.factors if old in (f.a, f.b)]
        new = next(k for f in touching for k in (f.a, f.b) if k != old)
        factors = [self.prior, *touching]
        ordering = gtsam.Ordering()
        ordering.push_back(_node_key(old))
        H, g = _information_of(_eliminate(self._linear_graph(factors), ordering)[1])
        node = self.nodes[new]
        self.prior = Factor(new, new, H, g, LinearisationPoint(self.c.copy(), node, node))
        self.factors = [f for f in self.factors if old not in (f.a, f.b)]
        del self.nodes[old]


def _eliminate(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> tuple[gtsam.GaussianBayesNet, gtsam.GaussianFactorGraph]:
    """The variables of `ordering` as conditionals, and the remaining graph without them."""
    try:
        net, remaining = linear.eliminatePartialSequential(ordering)
    except RuntimeError as error:
        raise _singular_error(error) from error
    return net, remaining


def _information_of(remaining: gtsam.GaussianFactorGraph) -> tuple[Array, Array]:
    """H and gradient (SIZE) on [c, one node] of the graph that an elimination left."""
    hessian = gtsam.HessianFactor(remaining)
    augmented = np.array(hessian.augmentedInformation())
    keys: list[int] = list(hessian.keys())
    rows = np.concatenate([np.arange(9) if k == _C else np.arange(9, 9 + NODE) for k in keys])
    H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    H[np.ix_(rows, rows)] = augmented[:-1, :-1]
    g[rows] = -augmented[:-1, -1]
    return H / np.outer(_UNITS, _UNITS), g / _UNITS


def sigmas(step: Array, information: Array) -> float:
    """Length of a step in standard deviations, per square root of its dimension."""
    squared = float(step @ information @ step)
    return float(np.sqrt(max(squared, 0.0) / len(step)))


def whitening(covariance: Array) -> Array:
    """W with W P W^T = I that mixes the numbers as little as possible: R^(-1/2) D^-1 of
    P = D R D.
    """
    sigma = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T / sigma)


def _inverse(H: Array) -> Array:
    """Inverse of a positive definite matrix whose rows may have very different units."""
    diagonal = np.diag(H)
    if not np.all(diagonal > 0.0):
        raise SingularError("a direction is determined by neither data nor prior")
    scale = 1.0 / np.sqrt(diagonal)
    try:
        root = np.linalg.inv(np.linalg.cholesky(H * np.outer(scale, scale)))
    except np.linalg.LinAlgError as error:
        raise SingularError("calibration and newest node are not determined") from error
    return np.asarray(root.T @ root * np.outer(scale, scale), dtype=np.float64)
