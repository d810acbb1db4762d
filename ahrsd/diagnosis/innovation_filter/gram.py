"""Gram matrices of a whitened regression, one per block of time: all that tests need.

Columns in groups, the whitened innovation e~ last.  With Z the columns of some groups and X the
others, the regression on Z is taken out of X by X - Z M, M = (Z^T Z)^+ Z^T X, so every block's
matrix becomes T^T G_b T with T = [-M; I]: the blocks of the projected regression, whose sum is the
Schur complement.  Tests are small algebra on these.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array

#: Directions with less information than this share of the group's own are dropped: not observable.
RANK_SHARE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Gram:
    """B blocks of the P columns and the innovation.

    groups:      columns of each group, in order
    blocks:      (B, P + 1, P + 1) sums over the block; the last row and column belong to e~
    counts:      (B,) scalar residuals in the block
    spans_s:     (B, 2) first and last time of the block
    information: (P,) sums of squares of the columns before anything was projected out
    """

    groups: Mapping[str, slice]
    blocks: Array
    counts: Array
    spans_s: Array
    information: Array

    def __len__(self) -> int:
        return len(self.blocks)

    @property
    def total(self) -> Array:
        """(P + 1, P + 1), the sum over the blocks."""
        return np.asarray(self.blocks.sum(axis=0))

    def columns(self, names: Sequence[str]) -> list[int]:
        """Column numbers of the groups, in the order asked for."""
        return [k for name in names for k in range(*self.groups[name].indices(10**9))]

    def select(self, names: Sequence[str]) -> Gram:
        """Only these groups (and e~), in this order."""
        index = self.columns(names)
        keep = np.array([*index, self.blocks.shape[1] - 1])
        return Gram(
            slices([(name, len(self.columns([name]))) for name in names]),
            self.blocks[:, keep[:, None], keep],
            self.counts,
            self.spans_s,
            self.information[index],
        )

    def rows(self, index: NDArray[np.intp]) -> Gram:
        """Only these blocks."""
        return Gram(
            self.groups,
            self.blocks[index],
            self.counts[index],
            self.spans_s[index],
            self.information,
        )

    def project(self, names: Sequence[str], total: Array | None = None) -> Gram:
        """The regression on the groups `names` taken out; those groups are left out.

        total: (P + 1, P + 1) the matrix that the regression is computed from, by default the sum
               of the blocks; a cross-validation passes the sum of its training blocks.
        """
        inner = self.columns(names)
        others = [name for name in self.groups if name not in names]
        outer = [*self.columns(others), self.blocks.shape[1] - 1]
        whole = self.total if total is None else total
        M = solve(whole[np.ix_(inner, inner)], whole[np.ix_(inner, outer)])
        rows, others_at = np.array(inner, dtype=np.intp), np.array(outer, dtype=np.intp)
        cross = M.T @ self.blocks[:, rows[:, None], others_at]
        left = self.blocks[:, others_at[:, None], others_at]
        middle = M.T @ self.blocks[:, rows[:, None], rows] @ M
        return Gram(
            slices([(name, len(self.columns([name]))) for name in others]),
            left - cross - np.swapaxes(cross, 1, 2) + middle,
            self.counts,
            self.spans_s,
            self.information[outer[:-1]],
        )

    def json(self) -> dict[str, object]:
        """Groups, spans, counts and upper triangles, with a SHA-256 over the numbers."""
        upper = np.triu_indices(self.blocks.shape[1])
        numbers = [[float(f"{v:.12g}") for v in block[upper]] for block in self.blocks]
        content: dict[str, object] = {
            "groups": {name: [s.start, s.stop] for name, s in self.groups.items()},
            "spans_s": self.spans_s.tolist(),
            "counts": self.counts.tolist(),
            "upper_triangles": numbers,
        }
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return {**content, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def solve(G: Array, right: Array) -> Array:
    """G^+ right for a positive semi-definite G, columns scaled to one unit of information."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(G * scale[:, None] * scale)
    kept = values > RANK_SHARE * 1e-3 * len(values)
    basis = vectors[:, kept]
    inner = (basis.T @ (scale[:, None] * right)) / values[kept][:, None]
    return np.asarray(scale[:, None] * (basis @ inner))


def slices(widths: Sequence[tuple[str, int]]) -> dict[str, slice]:
    """Consecutive column slices of the given widths."""
    ends = np.cumsum([width for _, width in widths]).tolist()
    return {name: slice(end - width, end) for (name, width), end in zip(widths, ends, strict=True)}
