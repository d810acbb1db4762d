"""The factor graph of epochs on GTSAM: solve, marginals, and folding of what is old.

Keys: `c` for the calibration, `y j` for node j. Every factor is a HessianFactor around the present
values, so one Gauss-Newton step of the graph is one linear solve, and its cost depends on the
number of factors only. The oldest node is folded away by GTSAM's own
elimination, which leaves one factor on (c, y 1) that holds all that the past said.

Traps of the wrapper that shaped this file: HessianFactor's linear term is minus the gradient; views
that it returns die with their owner, so they are copied at once; a rank-deficient system raises
RuntimeError; and a block counts as rank-deficient where its last pivot is 2^12 below the others, as
it is where little is known. So GTSAM eliminates the nodes but the newest, in units in which their
pivots are alike, and what is left on c and the newest node (14 numbers) is solved here.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from operator import is_not

import gtsam
import numpy as np

from ahrsd.estimator.factors import (
    NODE,
    SIZE,
    Y_A,
    Y_B,
    C,
    Factor,
    LinearisationPoint,
    Node,
    Stack,
    retract_nodes,
)
from ahrsd.estimator.retraction import Moments, retract
from ahrsd.samples import Array


class SingularError(ValueError):
    """The graph has a direction that neither data nor prior determine."""


_C = gtsam.symbol("c", 0)
# Unit of the gyro bias inside GTSAM: (rad/s) / 100, which brings its pivots near the directions'.
_UNITS = np.r_[np.ones(9), np.full(3, 1e-2), 1.0, 1.0, np.full(3, 1e-2), 1.0, 1.0]
_BADLY = 0.1
_HOLD = 1e4  # a held direction is this much stiffer than the prior


_FIRST_Y = gtsam.symbol("y", 0)


def _y(j: int) -> int:
    return int(_FIRST_Y + j)


def _hessian(factor: Factor, G: Array, linear: Array) -> gtsam.HessianFactor:
    c, a, b = C, Y_A, Y_B
    if factor.a == factor.b:
        return gtsam.HessianFactor(
            _C, _y(factor.a), G[c, c], G[c, a], linear[c], G[a, a], linear[a], 0.0
        )
    return gtsam.HessianFactor(
        _C,
        _y(factor.a),
        _y(factor.b),
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


def _singular(error: RuntimeError) -> SingularError:
    return SingularError(str(error).strip().split("\n", maxsplit=1)[0])


Step = tuple[Array, dict[int, Array]]
"""Moves dc (9,) of the calibration and dy (5,) per node."""


class Graph:
    """Calibration c (9,), nodes and factors; all values are the present linearisation point.

    `anchor` is what is believed of c without data, its mean (9,) and information (9, 9); it is
    never folded, because its weight against the data changes: `temper` multiplies its information
    (see `misfit`), and `hold` (9, 9) is added to it, which keeps the directions of c that nothing
    determines at the mean.
    """

    def __init__(self, c: Array, belief: Array, first: Node, prior: Factor) -> None:
        """`belief` is the covariance (9, 9) of the anchor, whose mean is c."""
        self.c = c.copy()
        self.anchor = (c.copy(), np.asarray(np.linalg.inv(belief), dtype=np.float64))
        self._whitening = whitening(belief)
        self._blind: Array = np.zeros((9, 0))
        self.temper = 1.0
        self.hold: Array = np.zeros((9, 9))
        self.moments = Moments()
        self.nodes: dict[int, Node] = {prior.a: first}
        self.prior = prior
        self.until_s: float | None = None  # when the newest node is
        self.factors: list[Factor] = []
        self._kept: tuple[list[object], tuple[gtsam.GaussianBayesNet, Array, Array]] | None = None

    def copy(self) -> Graph:
        """A copy that goes its own way; nodes and factors are shared, they never change."""
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

    def _belief(self) -> Array:
        return np.asarray(self.temper * self.anchor[1])

    def anchor_cost(self) -> float:
        """What departing from the anchor costs, as a negative log likelihood."""
        d = self.c - self.anchor[0]
        return float(0.5 * d @ (self._belief() + self.hold) @ d)

    def distance_from_prior(self, covariance: Array) -> float:
        """Mean square in sigmas of the prior of where c is in the directions that are badly known.

        covariance (9, 9) of c, tempered; badly: to no more than _BADLY of the prior's sigma. Beyond
        1 belief and data disagree by more than either allows. In planar motion directions that fit
        the noise lead up a valley to any size; this holds them back.
        """
        values, vectors = self._against_belief(covariance)
        badly = vectors[:, values > _BADLY**2]
        away = badly.T @ self._whitening @ (self.c - self.anchor[0])
        return float(np.mean(away * away)) if len(away) else 0.0

    def hold_blind(self, limit: float, covariance: Array) -> None:
        """Hold the directions whose sigma stays above `limit` of the prior's at the prior's mean.

        covariance (9, 9) of c, tempered. In the eigenbasis of the posterior, whitened by
        the prior, both are diagonal: holding one direction moves no other.
        """
        values, vectors = self._against_belief(covariance)
        self._blind = vectors[:, values > limit**2]
        blind = self._whitening.T @ self._blind
        self.hold = np.asarray(_HOLD * self.temper * blind @ blind.T)

    def _against_belief(self, covariance: Array) -> tuple[Array, Array]:
        """Variances (9,) over the prior's and their directions, columns, whitened by the prior."""
        W = self._whitening
        scaled = W @ covariance @ W.T
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
        return values, vectors

    def _all(self) -> list[Factor]:
        return [self.prior, *self.factors]

    def step(self, damping: float = 0.0) -> Step:
        """One Gauss-Newton step: dc (9,) and dy (5,) per node.

        `damping` holds c back by that multiple of the anchor's information (Levenberg-Marquardt).

        Raises SingularError where the graph does not determine all of it.
        """
        net, H, g = self._reduced()
        H, g = H[:14, :14].copy(), g[:14].copy()
        pull = self._belief() + self.hold
        H[C, C] += pull + damping * self.anchor[1]
        g[C] += pull @ (self.c - self.anchor[0])
        if not np.isfinite(g).all():
            raise SingularError("the calibration is not finite")
        solved = -_inverse(H) @ g
        given = gtsam.VectorValues()
        given.insert(_C, solved[C])
        given.insert(_y(self.last), solved[Y_A] / _UNITS[Y_A])
        delta = net.optimize(given)
        dy = {j: np.array(delta.at(_y(j))) * _UNITS[Y_A] for j in self.nodes}
        return np.asarray(solved[C], dtype=np.float64), dy

    def ahead(self) -> tuple[Array, Array]:
        """Where an undamped step would take c, dc (9,), and the information (9, 9) of c.

        Raises SingularError as `step` does.
        """
        _, H, g = self._reduced()
        H, g = H[:14, :14].copy(), g[:14].copy()
        pull = self._belief() + self.hold
        H[C, C] += pull
        g[C] += pull @ (self.c - self.anchor[0])
        covariance = _inverse(H)
        information = np.asarray(np.linalg.inv(covariance[C, C]), dtype=np.float64)
        return -(covariance @ g)[C], information

    def move(self, dc: Array, dy: dict[int, Array]) -> None:
        """Move all values by a step, the calibration along its valley (`retraction.py`)."""
        self.c = retract(self.c, dc, self.moments)
        steps = np.array([dy[j] for j in self.nodes])
        self.nodes = dict(
            zip(self.nodes, retract_nodes(list(self.nodes.values()), steps), strict=True)
        )

    def turn_first(self, R: Array) -> None:
        """Turn the oldest node's direction by R (3, 3), and with it what was folded about it."""
        prior = self.prior
        point = replace(prior.point, a=prior.point.a.turned(R), b=prior.point.b.turned(R))
        self.prior = replace(prior, point=point)
        self.nodes[self.first] = self.nodes[self.first].turned(R)

    def covariance(self) -> Array:
        """Joint covariance (12, 12) of c and the newest node's gyro bias, noise as assumed.

        As if nothing were held: what is not determined has the sigma of the prior.
        """
        H = self._reduced()[1][:14, :14].copy()
        H[C, C] += self._belief()
        return _inverse(H)[:12, :12]

    def with_held(self, c: Array) -> Array:
        """c with the directions that are held put where they are held."""
        W = self._whitening
        beside = self._blind @ self._blind.T @ W @ (c - self.anchor[0])
        return np.asarray(c - np.linalg.solve(W, beside))

    def _reduced(self) -> tuple[gtsam.GaussianBayesNet, Array, Array]:
        """All nodes but the newest eliminated, without anchor and hold, which are on c alone.

        Kept until a factor or a value is replaced: anchor, hold and damping change more often.
        """
        factors = self._all()
        used: list[object] = [self.c, *factors, *self.nodes.values()]
        kept = self._kept
        if kept is None or len(kept[0]) != len(used) or any(map(is_not, kept[0], used)):
            net, rest = _eliminated(self._linear(factors), self._older())
            kept = self._kept = (used, (net, *_information(rest)))
        return kept[1]

    def _linear(self, factors: list[Factor]) -> gtsam.GaussianFactorGraph:
        graph = gtsam.GaussianFactorGraph()
        H, g = Stack(factors, self.c, self.nodes).here()
        if not (np.isfinite(H).all() and np.isfinite(g).all()):
            raise SingularError("a factor is not finite")
        H, linear = H * np.outer(_UNITS, _UNITS), -g * _UNITS
        for k, factor in enumerate(factors):
            graph.add(_hessian(factor, H[k], linear[k]))
        return graph

    def _older(self) -> gtsam.Ordering:
        """All nodes but the newest, from old to new."""
        ordering = gtsam.Ordering()
        for j in sorted(self.nodes)[:-1]:
            ordering.push_back(_y(j))
        return ordering

    def fold_oldest(self) -> None:
        """Eliminate the oldest node: prior and the factors on it become the prior of the next."""
        old = self.first
        touching = [f for f in self.factors if old in (f.a, f.b)]
        new = next(k for f in touching for k in (f.a, f.b) if k != old)
        factors = [self.prior, *touching]
        ordering = gtsam.Ordering()
        ordering.push_back(_y(old))
        H, g = _information(_eliminated(self._linear(factors), ordering)[1])
        node = self.nodes[new]
        self.prior = Factor(new, new, H, g, LinearisationPoint(self.c.copy(), node, node))
        self.factors = [f for f in self.factors if old not in (f.a, f.b)]
        del self.nodes[old]


def _eliminated(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> tuple[gtsam.GaussianBayesNet, gtsam.GaussianFactorGraph]:
    """The variables of `ordering` as conditionals, and what is left of the graph without them."""
    try:
        net, rest = linear.eliminatePartialSequential(ordering)
    except RuntimeError as error:
        raise _singular(error) from error
    return net, rest


def _information(rest: gtsam.GaussianFactorGraph) -> tuple[Array, Array]:
    """H and gradient (SIZE) on [c, one node] of what an elimination left."""
    hessian = gtsam.HessianFactor(rest)
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
    """W with W P W^T = I that mixes the numbers as little as it can: R^(-1/2) D^-1 of P = D R D."""
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
