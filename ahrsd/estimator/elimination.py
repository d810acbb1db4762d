"""Block tridiagonal chains of 2x2 blocks: their interior eliminated onto what is shared.

Several chains are handled as one whose couplings between them are zero. Each keeps its first and
its last block. The interior's Hessian is factored as L L^T (banded); with Y = L^-1 B, B what
couples the interior to the rest and its gradient, the Schur complement takes Y^T Y away, and a step
of the interior costs one more triangular solution, for one column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs

from ahrsd.samples import Array

Index = NDArray[np.intp]
_SHARED = 12  # columns of what all blocks couple to; then come the first and the last block
_GRADIENT = 16


@dataclass(frozen=True, slots=True, eq=False)
class Interior:
    """L (4, 2 n) in LAPACK's lower banded storage and Y (2 n, 17), without the border blocks."""

    factor: Array
    half: Array

    def step(self, z: Array) -> Array:
        """Moves (n, 2) of the interior where the 16 numbers that it couples to move by z."""
        right = self.half[:, :_GRADIENT] @ z + self.half[:, _GRADIENT]
        solved, _ = dtbtrs(self.factor, -right[:, None], uplo="L", trans="T", overwrite_b=1)
        return np.asarray(solved.reshape(-1, 2))

    def part(self, first: int, last: int) -> Interior:
        """A copy of what lies between two border blocks, given where they are."""
        rows = slice(2 * first + 2, 2 * last)
        return Interior(self.factor[:, rows].copy(order="F"), self.half[rows].copy(order="F"))


def eliminated(diag: Array, upper: Array, border: Array, first: Index, last: Index) -> Interior:
    """Of chains in one row: blocks (2, 2, N), those above them (2, 2, N - 1), border (2, 13, N).

    border: coupling to the 12 shared numbers, and the gradient; first, last: rows of each chain's
    border blocks, whose rows of the result mean nothing. LinAlgError where a direction is not
    determined.
    """
    n = diag.shape[2]
    right = np.zeros((_GRADIENT + 1, n, 2))
    right[:_SHARED] = border[:, :_SHARED].transpose(1, 2, 0)
    right[_GRADIENT] = border[:, _SHARED].T
    right[:, first], right[:, last] = 0.0, 0.0
    right[_SHARED : _SHARED + 2, first + 1] = upper[:, :, first].transpose(0, 2, 1)
    right[_SHARED + 2 : _GRADIENT, last - 1] = upper[:, :, last - 1].transpose(1, 2, 0)
    diag, upper = diag.copy(), upper.copy()
    diag[:, :, first] = diag[:, :, last] = np.eye(2)[:, :, None]
    upper[:, :, first] = upper[:, :, last - 1] = 0.0
    return Interior(*halfway(diag, upper, right))


def halfway(diag: Array, upper: Array, right: Array) -> tuple[Array, Array]:
    """L, banded, of a symmetric block tridiagonal matrix, and L^-1 times right (columns, N, 2)."""
    factor, info = dpbtrf(band(diag, upper), lower=1, overwrite_ab=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"directions of an epoch are not determined (dpbtrf {info})")
    half, _ = dtbtrs(factor, right.reshape(len(right), -1).T, uplo="L", overwrite_b=1)
    return factor, half


def band(diag: Array, upper: Array) -> Array:
    """Lower banded storage (4, 2n) of a symmetric block tridiagonal matrix with 2x2 blocks."""
    out = np.zeros((4, 2 * diag.shape[2]), order="F")
    out[0, 0::2], out[0, 1::2] = diag[0, 0], diag[1, 1]
    out[1, 0::2] = diag[1, 0]
    out[1, 1:-1:2] = upper[1, 0]
    out[2, 0:-2:2], out[2, 1:-2:2] = upper[0, 0], upper[1, 1]
    out[3, 0:-2:2] = upper[0, 1]
    return out
