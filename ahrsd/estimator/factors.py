"""Quadratic factors between the calibration and the nodes between epochs, and their re-basing.

Variables: c = [M (6), b (3)] and, per node between epochs, y = [gyro bias (3), border direction
(2, in the node's tangent plane)]. A factor remembers where it was linearised; `Stack` expresses
factors around the present values: the calibration and the bias move additively, a direction moved
from u0 to u is T0^T (u - u0) away in the old tangent plane, and T0^T T turns the new tangents into
the old ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.samples import Array

C = slice(0, 9)
NODE = 5
Y_A = slice(9, 14)
Y_B = slice(14, 19)
SIZE = 19
_BIAS = slice(9, 12)
_BORDERS = np.r_[12:14, 17:19]
_CHAIN_BORDERS = np.r_[chain.FIRST, chain.LAST]
_TOKEN = 1.0  # information on a direction, 1/rad^2
# where chain.Quadratic's 16 numbers go among the factor's 19
_FROM_CHAIN = np.r_[0:9, 9:12, 12:14, 17:19]
_AMONG = np.ix_(_FROM_CHAIN, _FROM_CHAIN)


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """Border between two epochs: the gyro bias from here on (rad/s) and the field's direction.

    Its arrays are never written to: nodes are replaced, and shared until then.
    """

    bias: Array
    direction: Array
    tangent: Array

    @staticmethod
    def at(bias: Array, direction: Array) -> Node:
        """A node with a tangent basis of its direction."""
        return Node(bias.copy(), direction.copy(), so3.tangent_basis(direction[None])[0])

    def retracted(self, step: Array) -> Node:
        """The node after a step (5,), on the sphere."""
        return retract_nodes([self], step[None])[0]

    def turned(self, R: Array) -> Node:
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
    """Factors around the present values, all at once: z (F, 19), how far each is from its `point`.

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
        self._walked = np.array([nodes[f.b].bias - nodes[f.a].bias for f in factors])

    def rises(self) -> Array:
        """Costs (F,) above those at each factor's `point`, the walk of the bias included."""
        pulled = (self._H @ self.z[:, :, None])[:, :, 0]
        walks = 0.5 * self._walk * np.sum(self._walked**2, axis=1)
        return np.asarray(np.sum((self._g + 0.5 * pulled) * self.z, axis=1) + walks)

    def here(self) -> tuple[Array, Array]:
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
        g[:, i] -= self._walk[:, None] * self._walked
        g[:, j] += self._walk[:, None] * self._walked
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

    One at rest does not calibrate, it speaks of the gyro's bias only, and that whatever c is: the
    rate that was read is the bias, across the field's direction `rest` (3,), a mean over the epoch.
    What seems to be said along it comes from the noise of the directions. Its borders keep a token
    of information, to stay determined. The first and the last, as `drawn` says, are drawn by it to
    where the epoch wants them; one that an epoch with motion shares is not.
    """
    H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    H[_AMONG] = q.H
    g[_FROM_CHAIN] = q.g
    if rest is not None:
        gain = np.linalg.solve(H[_BORDERS][:, _BORDERS], np.c_[H[_BORDERS][:, _BIAS], g[_BORDERS]])
        cross = H[_BIAS][:, _BORDERS]
        wanted = at_borders(q) * np.repeat(drawn, 2)
        H_bias, g_bias = H[_BIAS, _BIAS] - cross @ gain[:, :3], g[_BIAS] - cross @ gain[:, 3]
        across = np.eye(3) - np.outer(rest, rest)
        H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
        H[_BIAS, _BIAS], g[_BIAS] = across @ H_bias @ across, across @ g_bias
        H[_BORDERS, _BORDERS], g[_BORDERS] = _TOKEN, -_TOKEN * wanted
    return Factor(a, a + 1, H, g, point, walk)


def at_borders(q: chain.Quadratic) -> Array:
    """Where an epoch alone wants its borders (4,), first and last, from where they are.

    A direction that it does not tell stays: against that a rad of doubt is nothing.
    """
    H, g = q.H[_CHAIN_BORDERS][:, _CHAIN_BORDERS], q.g[_CHAIN_BORDERS]
    return np.asarray(-np.linalg.solve(H + np.eye(len(g)), g), dtype=np.float64)


def chain_step(z: Array, *, calibrates: bool = True) -> Array:
    """The 16 numbers of `chain.move` out of a factor's 19; only the bias for `not calibrates`."""
    step = np.array(z[_FROM_CHAIN])
    if not calibrates:
        step[C], step[12:] = 0.0, 0.0
    return step


def gap_factor(a: int, c: Array, node_a: Node, node_b: Node, walk: float) -> Factor:
    """Across a gap, between nodes a and a + 1, only the gyro bias is linked."""
    point = LinearisationPoint(c.copy(), node_a, node_b)
    return Factor(a, a + 1, np.zeros((SIZE, SIZE)), np.zeros(SIZE), point, walk)


def bias_prior(node: int, c: Array, at: Node, sigma_bias: float) -> Factor:
    """Prior on the first node's gyro bias (rad/s)."""
    H = np.zeros((SIZE, SIZE))
    H[9:12, 9:12] = np.eye(3) / sigma_bias**2
    return Factor(node, node, H, np.zeros(SIZE), LinearisationPoint(c.copy(), at, at))
