"""An epoch in the window: what it measured, where it was linearised, and the factor it became."""

from __future__ import annotations

from dataclasses import dataclass

from ahrsd.estimator import chain, noise
from ahrsd.estimator.factors import Factor, Node
from ahrsd.estimator.systematic import Cells
from ahrsd.samples import Array


@dataclass(slots=True, eq=False)
class Epoch:
    """One epoch in the window: its data, directions, noise, and its factor's nodes a -> b."""

    data: chain.Data
    u: Array
    used: chain.Noise
    weights: Array | None
    a: int
    b: int
    quadratic: chain.Quadratic
    factor: Factor
    turned: bool
    _residuals: noise.Residuals | None = None
    _cells: Cells | None = None

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
            M = chain.symmetric(self.factor.point.c[:6])
            self._residuals = noise.residuals(self.quadratic, self.data, self.used, M)
        return self._residuals

    @property
    def cost(self) -> float:
        """Half the sum of squares with the interior directions at their best."""
        return self.quadratic.cost


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A window's calibration c (9,), nodes by index, epochs and factors at one moment."""

    c: Array
    nodes: dict[int, Node]
    epochs: list[Epoch]
    factors: list[Factor]
