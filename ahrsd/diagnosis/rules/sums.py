"""Products of a fit with what is held against it, computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What a fit with all its terms has in common with columns that were held against it.

    known (3 N, q), innovation (3 N,): of the fit;  inner (q, q), seen (q,): their products
    found: by effect and setting (p, p) X^T X, (q, p) Z^T X, (p,) X^T e
    """

    known: Array
    innovation: Array
    inner: Array
    seen: Array
    found: dict[tuple[str, str], tuple[Array, Array, Array]] = field(default_factory=dict)

    @staticmethod
    def of(known: Array, innovation: Array) -> Sums:
        """Nothing held against it yet; (N, 3, q), (N, 3)."""
        Z, e = known.reshape(-1, known.shape[2]), innovation.ravel()
        return Sums(Z, e, Z.T @ Z, Z.T @ e)

    def add(self, parts: Sequence[tuple[tuple[str, str], int]], columns: Array) -> None:
        """Whitened columns (N, 3, p) of the parts (key, width) next to each other."""
        X = columns.reshape(-1, columns.shape[2])
        squares, cross, seen = X.T @ X, self.known.T @ X, self.innovation @ X
        ends = accumulate(width for _, width in parts)
        for (key, width), end in zip(parts, ends, strict=True):
            own = slice(end - width, end)
            self.found[key] = squares[own, own], cross[:, own], seen[own]
