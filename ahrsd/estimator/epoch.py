"""An epoch in the window: what it measured, where it was linearised, and the factor it became."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.estimator import chain, noise
from ahrsd.estimator.factors import Factor, Node, at_borders, gap_factor
from ahrsd.estimator.graph import Graph
from ahrsd.estimator.misfit import MisfitScore, scores
from ahrsd.estimator.systematic import Cells
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
    turned: bool
    typical: noise.Typical


@dataclass(frozen=True, slots=True, eq=False)
class InstrumentInformation:
    """Quadratic of an epoch in iron and instrument (`instrument.py`): H (17, 17), g (17,) at c."""

    H: Array
    g: Array
    c: Array


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

    used: the noise that it was linearised with; usual: that of the window then; instrument: set
    by `instrument.linearise_instrument`.
    """

    piece: EpochContent
    u: Array
    used: chain.Noise
    usual: chain.Noise
    quadratic: chain.Quadratic
    factor: Factor
    score: MisfitScore | None = None
    instrument: InstrumentInformation | None = None
    _residuals: noise.Residuals | None = None
    _cells: Cells | None = None

    @property
    def data(self) -> chain.EpochData:
        """What it measured."""
        return self.piece.data

    @property
    def a(self) -> int:
        """The node at its beginning; the next one is at its end."""
        return self.piece.a

    @property
    def turned(self) -> bool:
        """Whether it calibrates."""
        return self.piece.turned

    @property
    def weights(self) -> Array:
        """Of its fields."""
        return self.quadratic.weights

    @property
    def cells(self) -> Cells:
        """Where its directions were."""
        if self._cells is None:
            self._cells = Cells.of(self.u, self.data.count)
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


def scores_of(epochs: Sequence[WindowEpoch]) -> list[MisfitScore]:
    """What epochs ask for, found once where each was linearised."""
    new = [e for e in epochs if e.score is None]
    for epoch, score in zip(new, scores([e.factor for e in new]) if new else [], strict=True):
        epoch.score = score
    return [e.score for e in epochs if e.score is not None]


def grown(
    graph: Graph, data: chain.EpochData, walk: float, *, moving: bool
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
    return EpochContent(data, a, information, moving, noise.Typical.of(data)), u


def place_borders(graph: Graph, begun: Sequence[WindowEpoch]) -> None:
    """Put borders that are at directions of single fields to where their epochs alone want them.

    Until then a chain is bent towards the noise of one field and seems that noisy itself; for an
    epoch at rest, whose borders only a token moves, for long.
    """
    for epoch in begun:
        step = at_borders(epoch.quadratic)
        own = [(epoch.a + 1, step[2:])]
        if epoch.data.measures_first:
            own.append((epoch.a, step[:2]))
        for j, tangent in own:
            graph.nodes[j] = graph.nodes[j].retracted(np.r_[np.zeros(3), tangent])


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A window's calibration c (9,), nodes by index, epochs and factors at one moment."""

    c: Array
    nodes: dict[int, Node]
    epochs: list[WindowEpoch]
    factors: list[Factor]
