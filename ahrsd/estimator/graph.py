"""The factor graph of epochs on GTSAM: solve, marginals, and folding of what is old.

Keys: `c` for the calibration, `y j` for node j. Every factor is a HessianFactor around the present
values, in a LinearContainerFactor, so one Gauss-Newton step of the graph is one linear solve, and
its cost depends on the number of factors only. The oldest node is folded away by GTSAM's own
elimination, which leaves one factor on (c, y 1) that holds all that the past said.

Traps of the wrapper that shaped this file: HessianFactor's linear term is minus the gradient; views
that it returns die with their owner, so they are copied at once; a rank-deficient system raises
RuntimeError.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from ahrsd.estimator.factors import NODE, SIZE, Y_A, Y_B, C, Factor, Node, Point
from ahrsd.samples import Array


class SingularError(ValueError):
    """The graph has a direction that neither data nor prior determine."""


_C = gtsam.symbol("c", 0)
_HOLD = 1e4  # a held direction is this much stiffer than the prior


def _y(j: int) -> int:
    return int(gtsam.symbol("y", j))


def _hessian(factor: Factor, H: Array, g: Array) -> gtsam.HessianFactor:
    if not (np.isfinite(H).all() and np.isfinite(g).all()):
        raise SingularError("a factor is not finite")
    if factor.a == factor.b:
        return gtsam.HessianFactor(
            _C, _y(factor.a), H[C, C], H[C, Y_A], -g[C], H[Y_A, Y_A], -g[Y_A], 0.0
        )
    return gtsam.HessianFactor(
        _C,
        _y(factor.a),
        _y(factor.b),
        H[C, C],
        H[C, Y_A],
        H[C, Y_B],
        -g[C],
        H[Y_A, Y_A],
        H[Y_A, Y_B],
        -g[Y_A],
        H[Y_B, Y_B],
        -g[Y_B],
        0.0,
    )


def _singular(error: RuntimeError) -> SingularError:
    return SingularError(str(error).strip().split("\n", maxsplit=1)[0])


def _unary(mean: Array, sigma: Array) -> gtsam.PriorFactorVector:
    return gtsam.PriorFactorVector(_C, mean, gtsam.noiseModel.Diagonal.Sigmas(sigma))


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

    def _anchored(self, factors: list[Factor], extra: Array) -> gtsam.NonlinearFactorGraph:
        """All factors and the anchor; `extra` (9, 9) is information that pulls to the anchor."""
        graph = self._linear(factors)
        information = self._belief() + extra
        linear = information @ (self.anchor[0] - self.c)
        if not np.isfinite(linear).all():
            raise SingularError("the calibration is not finite")
        hessian = gtsam.HessianFactor(_C, information, linear, 0.0)
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
        values.insert(_C, np.zeros(9))
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
        damped = damping / self.anchor[1] ** 2
        graph = self._anchored(factors, self.hold)
        if damping > 0:
            graph.add(_unary(np.zeros(9), 1.0 / np.sqrt(damped)))
        try:
            delta = graph.linearize(self._values(factors)).optimize()
        except RuntimeError as error:
            raise _singular(error) from error
        dy = {j: np.array(delta.at(_y(j))) for j in self.nodes}
        return np.array(delta.at(_C)), dy

    def move(self, dc: Array, dy: dict[int, Array]) -> None:
        """Move all values by a step."""
        self.c = self.c + dc
        self.nodes = {j: node.moved(dy[j]) for j, node in self.nodes.items()}

    def covariance(self) -> Array:
        """Joint covariance (12, 12) of c and the newest node's gyro bias, noise as assumed.

        As if nothing were held: what is not determined has the sigma of the prior.
        """
        factors = self._all()
        values = self._values(factors)
        graph = self._anchored(factors, np.zeros((9, 9)))
        try:
            joint = gtsam.Marginals(graph, values).jointMarginalCovariance(
                gtsam.KeyVector([_C, _y(self.last)])
            )
        except RuntimeError as error:
            raise _singular(error) from error
        return np.array(joint.fullMatrix())[:12, :12]

    def fold_oldest(self) -> None:
        """Eliminate the oldest node: prior and the factors on it become the prior of the next."""
        old = self.first
        touching = [f for f in self.factors if old in (f.a, f.b)]
        new = next(k for f in touching for k in (f.a, f.b) if k != old)
        factors = [self.prior, *touching]
        linear = self._linear(factors).linearize(self._values(factors))
        ordering = gtsam.Ordering()
        ordering.push_back(_y(old))
        try:
            _, rest = linear.eliminatePartialSequential(ordering)
        except RuntimeError as error:
            raise _singular(error) from error
        hessian = gtsam.HessianFactor(rest)
        augmented = np.array(hessian.augmentedInformation())
        H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
        rows = _rows(list(hessian.keys()))
        H[np.ix_(rows, rows)] = augmented[:-1, :-1]
        g[rows] = -augmented[:-1, -1]
        node = self.nodes[new]
        self.prior = Factor(new, new, H, g, Point(self.c.copy(), node.copy(), node.copy()))
        self.factors = [f for f in self.factors if old not in (f.a, f.b)]
        del self.nodes[old]


def _rows(keys: list[int]) -> NDArray[np.intp]:
    """Rows of [c, y_a] for a factor's keys in GTSAM's order."""
    parts = [np.arange(9) if key == _C else np.arange(9, 14) for key in keys]
    return np.asarray(np.concatenate(parts))
