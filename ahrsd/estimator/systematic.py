"""Errors of the model that repeat with the attitude: averaging does not make them smaller.

A field that differs from place to place, an arm that always goes the same way, the sensor's own
nonlinearity: what is left over then depends on where the sensor points, and a thousand samples of
one attitude are worth one. White noise shows in the differences of successive fields; what the
residuals hold beyond it is taken to be of this kind. It is one unknown per cell of the sphere of
directions that was visited, so the information of n samples with noise s, of which s_r repeats,
shrinks by n s_r^2 / (cells s^2).
"""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array

_BANDS, _SECTORS = 8, 12  # cells of equal area, about 22 deg across
_WHITE = 1.5  # residual variance over that of the differences up to which there is nothing else
_LEAST = 0.005  # of a band's cell: share of the samples that makes a cell count


class Cells:
    """How many steps were seen in each cell of the sphere of directions."""

    def __init__(self, count: Array | None = None) -> None:
        self._count: Array = np.zeros(_BANDS * _SECTORS) if count is None else count

    @staticmethod
    def of(directions: Array, each: Array | float) -> Cells:
        """Of unit vectors (n, 3), each standing for that many steps."""
        band = np.minimum((directions[:, 2] + 1) / 2 * _BANDS, _BANDS - 1).astype(int)
        angle = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) % 1.0
        sector = np.minimum(angle * _SECTORS, _SECTORS - 1).astype(int)
        weights = np.broadcast_to(each, len(directions))
        count = np.bincount(band * _SECTORS + sector, weights, minlength=_BANDS * _SECTORS)
        return Cells(count.astype(np.float64))

    def __add__(self, other: Cells) -> Cells:
        return Cells(self._count + other._count)

    @property
    def steps(self) -> float:
        """All steps."""
        return float(self._count.sum())

    @property
    def visited(self) -> int:
        """Cells with more than a few of them."""
        return int(np.count_nonzero(self._count > _LEAST * self._count.sum()))


def excess(cells: Cells, residual_gauss: float, white_gauss: float) -> float:
    """By how much the information shrinks, at least 1."""
    repeats = max(0.0, 1.0 - _WHITE * (white_gauss / residual_gauss) ** 2)
    return max(1.0, repeats * cells.steps / max(cells.visited, 1))
