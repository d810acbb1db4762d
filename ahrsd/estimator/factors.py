"""Quadratic factors between the calibration and the nodes between epochs, and their re-basing.

Variables: c = [M (6), b (3)] and, per node between epochs, y = [gyro bias (3), border direction
(2, in the node's tangent plane)]. A factor remembers where it was linearised; `at` expresses it
around the present values: the calibration and the bias move additively, a direction moved from u0
to u is T0^T (u - u0) away in the old tangent plane, and T0^T T turns the new tangents into old.
"""

from __future__ import annotations

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
_TOKEN = 1.0  # information on a direction, 1/rad^2
# where chain.Quadratic's 16 numbers go among the factor's 19
_FROM_CHAIN = np.r_[0:9, 9:12, 12:14, 17:19]


@dataclass(slots=True, eq=False)
class Node:
    """Border between two epochs: the gyro bias from here on (rad/s) and the field's direction."""

    bias: Array
    direction: Array
    tangent: Array

    @staticmethod
    def at(bias: Array, direction: Array) -> Node:
        """A node with a tangent basis of its direction."""
        return Node(bias.copy(), direction.copy(), so3.tangent_basis(direction[None])[0])

    def copy(self) -> Node:
        """An independent copy."""
        return Node(self.bias.copy(), self.direction.copy(), self.tangent.copy())

    def moved(self, step: Array) -> Node:
        """The node after a step (5,), on the sphere."""
        direction = self.direction + self.tangent @ step[3:]
        return Node.at(self.bias + step[:3], direction / np.linalg.norm(direction))


@dataclass(frozen=True, slots=True, eq=False)
class Point:
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
    point: Point
    walk: float = 0.0

    def offset(self, c: Array, a: Node, b: Node) -> tuple[Array, Array]:
        """How far the present values are from `point` (19,), and the 19x19 chart change."""
        z = np.zeros(SIZE)
        J = np.eye(SIZE)
        z[C] = c - self.point.c
        for where, node, old in ((9, a, self.point.a), (14, b, self.point.b)):
            z[where : where + 3] = node.bias - old.bias
            z[where + 3 : where + 5] = old.tangent.T @ (node.direction - old.direction)
            J[where + 3 : where + 5, where + 3 : where + 5] = old.tangent.T @ node.tangent
        return z, J

    def rise(self, c: Array, a: Node, b: Node) -> float:
        """Cost at the present values above that at `point`, the walk of the bias included."""
        z, _ = self.offset(c, a, b)
        d = b.bias - a.bias
        return float(self.g @ z + 0.5 * z @ self.H @ z + 0.5 * self.walk * d @ d)

    def at(self, c: Array, a: Node, b: Node) -> tuple[Array, Array]:
        """H (19, 19) and gradient (19,) around the present values."""
        z, J = self.offset(c, a, b)
        H = J.T @ self.H @ J
        g = J.T @ (self.g + self.H @ z)
        if self.walk:
            d = b.bias - a.bias
            for k in range(3):
                i, j = 9 + k, 14 + k
                H[i, i] += self.walk
                H[j, j] += self.walk
                H[i, j] -= self.walk
                H[j, i] -= self.walk
                g[i] -= self.walk * d[k]
                g[j] += self.walk * d[k]
        return H, g


def epoch_factor(
    q: chain.Quadratic, a: int, point: Point, walk: float, *, calibrates: bool = True
) -> Factor:
    """The factor of one epoch, between nodes a and a + 1, from its eliminated chain.

    One that does not calibrate speaks of the gyro's bias only. At rest that holds whatever c is:
    the rate that was read is the bias. Its borders keep a token of information, to stay determined.
    """
    H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    H[np.ix_(_FROM_CHAIN, _FROM_CHAIN)] = q.H
    g[_FROM_CHAIN] = q.g
    if not calibrates:
        gain = np.linalg.solve(H[_BORDERS][:, _BORDERS], np.c_[H[_BORDERS][:, _BIAS], g[_BORDERS]])
        cross = H[_BIAS][:, _BORDERS]
        H_bias, g_bias = H[_BIAS, _BIAS] - cross @ gain[:, :3], g[_BIAS] - cross @ gain[:, 3]
        H, g = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
        H[_BIAS, _BIAS], g[_BIAS] = H_bias, g_bias
        H[_BORDERS, _BORDERS] = _TOKEN
    return Factor(a, a + 1, H, g, point, walk)


def chain_step(z: Array, *, calibrates: bool = True) -> Array:
    """The 16 numbers of `chain.move` out of a factor's 19; only the bias for `not calibrates`."""
    step = np.array(z[_FROM_CHAIN])
    if not calibrates:
        step[C], step[12:] = 0.0, 0.0
    return step


def gap_factor(a: int, c: Array, node_a: Node, node_b: Node, walk: float) -> Factor:
    """Across a gap, between nodes a and a + 1, only the gyro bias is linked."""
    point = Point(c.copy(), node_a.copy(), node_b.copy())
    return Factor(a, a + 1, np.zeros((SIZE, SIZE)), np.zeros(SIZE), point, walk)


def bias_prior(node: int, c: Array, at: Node, sigma_bias: float) -> Factor:
    """Prior on the first node's gyro bias (rad/s)."""
    H = np.zeros((SIZE, SIZE))
    H[9:12, 9:12] = np.eye(3) / sigma_bias**2
    return Factor(node, node, H, np.zeros(SIZE), Point(c.copy(), at.copy(), at.copy()))
