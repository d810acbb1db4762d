"""The factor graph of epochs on GTSAM: solve, marginals, and folding of what is old.

Keys: `c` for the calibration, `y j` for node j. Every factor is a HessianFactor around the present
values, in a LinearContainerFactor, so one Gauss-Newton step of the graph is one linear solve, and
its cost depends on the number of factors only. The oldest node is folded away by GTSAM's own
elimination, which leaves one factor on (c, y 1) that holds all that the past said.

Traps of the wrapper that shaped this file: HessianFactor's linear term is minus the gradient; views
that it returns die with their owner, so they are copied at once; a rank-deficient system raises
RuntimeError; and a block counts as rank-deficient where its last two pivots differ by more than
2^12 (choleskyPartial), as they do where little is known. So nodes are eliminated before c, while c
counts as known, and the block of c ends in two idle coordinates with pivots of 1.
"""

from __future__ import annotations

import gtsam
import numpy as np

from ahrsd.estimator.factors import NODE, SIZE, Factor, Node, Point
from ahrsd.samples import Array


class SingularError(ValueError):
    """The graph has a direction that neither data nor prior determine."""


_C = gtsam.symbol("c", 0)
_IDLE = 2
_WIDE = 9 + _IDLE
_USED = np.r_[0:9, _WIDE : SIZE + _IDLE]  # where a factor's rows go, the idle ones left out
_HOLD = 1e4  # a held direction is this much stiffer than the prior


def _y(j: int) -> int:
    return int(gtsam.symbol("y", j))


def _hessian(factor: Factor, H: Array, g: Array) -> gtsam.HessianFactor:
    if not (np.isfinite(H).all() and np.isfinite(g).all()):
        raise SingularError("a factor is not finite")
    G, linear = np.zeros((SIZE + _IDLE, SIZE + _IDLE)), np.zeros(SIZE + _IDLE)
    G[np.ix_(_USED, _USED)] = H
    linear[_USED] = -g
    c, a, b = slice(0, _WIDE), slice(_WIDE, _WIDE + NODE), slice(_WIDE + NODE, _WIDE + 2 * NODE)
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

    `anchor` is what is believed of c without data, (mean, sigma); it is never folded, because its
    weight against the data changes: `temper` multiplies its information (see `misfit`), and `hold`
    (9, 9) is added to it, which keeps the directions of c that nothing determines at the mean.
    """

    def __init__(self, c: Array, sigma_c: Array, first: Node, prior: Factor) -> None:
        self.c = c.copy()
        self.anchor = (c.copy(), sigma_c.copy())
        self.temper = 1.0
        self.hold: Array = np.zeros((9, 9))
        self.nodes: dict[int, Node] = {prior.a: first}
        self.prior = prior
        self.factors: list[Factor] = []

    @property
    def first(self) -> int:
        """Index of the oldest node."""
        return self.prior.a

    @property
    def last(self) -> int:
        """Index of the newest node."""
        return max(self.nodes)

    def _linear(self, factors: list[Factor]) -> gtsam.NonlinearFactorGraph:
        values = self._values(factors)
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            H, g = factor.at(self.c, self.nodes[factor.a], self.nodes[factor.b])
            graph.add(gtsam.LinearContainerFactor(_hessian(factor, H, g), values))
        return graph

    def _anchored(
        self, factors: list[Factor], extra: Array, damping: float = 0.0
    ) -> gtsam.NonlinearFactorGraph:
        """All factors and the anchor; `extra` (9, 9) is information that pulls to the anchor."""
        graph = self._linear(factors)
        information = self._belief() + extra
        linear = information @ (self.anchor[0] - self.c)
        if not np.isfinite(linear).all():
            raise SingularError("the calibration is not finite")
        block, vector = np.eye(_WIDE), np.zeros(_WIDE)
        block[:9, :9] = information + np.diag(damping / self.anchor[1] ** 2)
        vector[:9] = linear
        hessian = gtsam.HessianFactor(_C, block, vector, 0.0)
        graph.add(gtsam.LinearContainerFactor(hessian, self._values(factors)))
        return graph

    def _belief(self) -> Array:
        return np.asarray(np.diag(self.temper / self.anchor[1] ** 2))

    def anchor_cost(self) -> float:
        """What departing from the anchor costs, as a negative log likelihood."""
        d = self.c - self.anchor[0]
        return float(0.5 * d @ (self._belief() + self.hold) @ d)

    def hold_blind(self, limit: float, covariance: Array) -> None:
        """Hold the directions whose sigma stays above `limit` of the prior's at the prior's mean.

        covariance (9+, 9+) of c first, tempered. In the eigenbasis of the posterior, whitened by
        the prior, both are diagonal: holding one direction moves no other.
        """
        sigma = self.anchor[1]
        scaled = covariance[:9, :9] / np.outer(sigma, sigma)
        values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
        blind = vectors[:, values > limit**2] / sigma[:, None]
        self.hold = np.asarray(_HOLD * self.temper * blind @ blind.T)

    @staticmethod
    def _values(factors: list[Factor]) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(_C, np.zeros(_WIDE))
        for j in sorted({k for f in factors for k in (f.a, f.b)}):
            values.insert(_y(j), np.zeros(NODE))
        return values

    def _all(self) -> list[Factor]:
        return [self.prior, *self.factors]

    def step(self, damping: float = 0.0) -> Step:
        """One Gauss-Newton step: dc (9,) and dy (5,) per node.

        `damping` holds c back by that multiple of the anchor's information (Levenberg-Marquardt).

        Raises SingularError where the graph does not determine all of it.
        """
        factors = self._all()
        graph = self._anchored(factors, self.hold, damping)
        try:
            delta = graph.linearize(self._values(factors)).optimize(self._order(with_all=True))
        except RuntimeError as error:
            raise _singular(error) from error
        dy = {j: np.array(delta.at(_y(j))) for j in self.nodes}
        return np.array(delta.at(_C), dtype=np.float64)[:9], dy

    def move(self, dc: Array, dy: dict[int, Array]) -> None:
        """Move all values by a step."""
        self.c = self.c + dc
        self.nodes = {j: node.moved(dy[j]) for j, node in self.nodes.items()}

    def covariance(self) -> Array:
        """Joint covariance (12, 12) of c and the newest node's gyro bias, noise as assumed.

        As if nothing were held: what is not determined has the sigma of the prior.
        """
        factors = self._all()
        linear = self._anchored(factors, np.zeros((9, 9))).linearize(self._values(factors))
        rest = _eliminated(linear, self._order(with_all=False))
        H, _ = _information(rest)
        try:
            joint = np.linalg.inv(H[:14, :14])
        except np.linalg.LinAlgError as error:
            raise SingularError(str(error)) from error
        return np.asarray(joint[:12, :12], dtype=np.float64)

    def _order(self, *, with_all: bool) -> gtsam.Ordering:
        """Nodes from old to new, then c; without the newest node and c unless `with_all`."""
        ordering = gtsam.Ordering()
        nodes = sorted(self.nodes)
        for j in nodes if with_all else nodes[:-1]:
            ordering.push_back(_y(j))
        if with_all:
            ordering.push_back(_C)
        return ordering

    def fold_oldest(self) -> None:
        """Eliminate the oldest node: prior and the factors on it become the prior of the next."""
        old = self.first
        touching = [f for f in self.factors if old in (f.a, f.b)]
        new = next(k for f in touching for k in (f.a, f.b) if k != old)
        factors = [self.prior, *touching]
        linear = self._linear(factors).linearize(self._values(factors))
        ordering = gtsam.Ordering()
        ordering.push_back(_y(old))
        H, g = _information(_eliminated(linear, ordering))
        node = self.nodes[new]
        self.prior = Factor(new, new, H, g, Point(self.c.copy(), node.copy(), node.copy()))
        self.factors = [f for f in self.factors if old not in (f.a, f.b)]
        del self.nodes[old]


def _eliminated(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> gtsam.GaussianFactorGraph:
    """What is left of a graph without the variables of `ordering`."""
    try:
        return linear.eliminatePartialSequential(ordering)[1]
    except RuntimeError as error:
        raise _singular(error) from error


def _information(rest: gtsam.GaussianFactorGraph) -> tuple[Array, Array]:
    """H and gradient (SIZE) on [c, one node] of what an elimination left."""
    hessian = gtsam.HessianFactor(rest)
    augmented = np.array(hessian.augmentedInformation())
    rows, kept, at = [], [], 0
    keys: list[int] = list(hessian.keys())
    for key in keys:
        first, size, idle = (0, 9, _IDLE) if key == _C else (9, NODE, 0)
        rows.append(np.arange(first, first + size))
        kept.append(np.arange(at, at + size))
        at += size + idle
    into, of = np.concatenate(rows), np.concatenate(kept)
    H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    H[np.ix_(into, into)] = augmented[np.ix_(of, of)]
    g[into] = -augmented[of, -1]
    return H, g
