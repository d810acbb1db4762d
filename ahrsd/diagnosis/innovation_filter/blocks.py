"""Linear recursions over all samples in blocks that advance together, exactly.

    x_k = S_k x_(k-1) + U_k z_k          S (s, s) per sample, x (s, p): one column per parameter

A Python loop over N samples is slow, numpy over N / n blocks is not: each block of n ~ sqrt(N)
consecutive samples starts from zero, all blocks take their j-th step together, and since the
recursion is linear the states at the block boundaries are chained afterwards and their effect is
added with the product of the S before each sample.
`tests/diagnosis/innovation_filter/test_innovation.py` compares with the plain loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from ahrsd.samples import Array

#: columns up to which one triangular system with a band is quicker than the blocks
NARROW = 12


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """B blocks of consecutive samples, none of which spans two runs; n is the longest.

    starts, ends: (B,) first row and row behind the last
    opens:        (B,) whether the block is its run's first
    rows:         (n, B) row of each block's j-th step; N (behind the end) where it has none
    """

    starts: NDArray[np.intp]
    ends: NDArray[np.intp]
    opens: NDArray[np.bool]
    rows: NDArray[np.intp]

    def padded(self, values: Array, rest: Array | float) -> Array:
        """(n, B, ...) of (N, ...): step by step; `rest` where a block has ended."""
        tail = np.broadcast_to(np.asarray(rest, np.float64), values.shape[1:])
        return np.asarray(np.concatenate([values, tail[None]])[self.rows])

    def unpadded(self, values: Array) -> Array:
        """(N, ...) of (n, B, ...)."""
        count = int(self.ends[-1]) if len(self.ends) else 0
        out = np.empty((count + 1, *values.shape[2:]))
        out[self.rows] = values
        return out[:-1]


def layout_of(runs: tuple[slice, ...], longest: int | None = None) -> Layout:
    """Blocks of nearly equal length in every run, about as many as there are steps in one.

    longest: rows of a block at most, where not as many
    """
    count = sum(run.stop - run.start for run in runs)
    longest = longest or max(16, round(np.sqrt(count)))
    starts: list[int] = []
    opens: list[bool] = []
    for run in runs:
        parts = -(-(run.stop - run.start) // longest)
        edges = np.linspace(run.start, run.stop, parts + 1).round().astype(int)
        starts.extend(edges[:-1].tolist())
        opens.extend([True] + [False] * (parts - 1))
    first = np.array(starts, dtype=np.intp)
    last = np.array([*starts[1:], count], dtype=np.intp)
    rows = first + np.arange(int(np.max(last - first)))[:, None]
    return Layout(first, last, np.array(opens), np.where(rows < last, rows, count))


def products_before(layout: Layout, steps: Array) -> tuple[Array, Array]:
    """Products of `steps` (N, s, s) from a block's start to before each row, and over each block.

    Row k of the first is S_(k-1) ... S_(first of the block), (N, s, s); the second is (B, s, s).
    """
    size = steps.shape[-1]
    padded = layout.padded(steps, np.eye(size))
    before = np.empty_like(padded)
    total = np.broadcast_to(np.eye(size), padded.shape[1:])
    for j, step in enumerate(padded):
        before[j] = total
        total = step @ total
    return layout.unpadded(before), np.asarray(total)


@dataclass(frozen=True, slots=True, eq=False)
class Recursion:
    """x_k = S_k x_(k-1) + U_k z_k from x = 0, with outputs y_k = Y_k x_(k-1) + V_k z_k.

    matrix: (N, 3 + s, s + z) the rows [Y V; S U]; z is 6: what is driven by gyro (3), mag (3)
    made:   what was built from it, once
    """

    layout: Layout
    matrix: Array
    made: dict[str, Array] = field(default_factory=dict)

    @property
    def states(self) -> int:
        """s."""
        return int(self.matrix.shape[-1]) - 6

    def run(self, gyro: Array | None, mag: Array | None) -> Array:
        """Outputs (N, 3, p) of the inputs z = [gyro; mag], each (N, 3, p) or None for zero."""
        given = gyro if gyro is not None else mag
        if given is None:
            raise ValueError("a recursion needs an input")
        if given.shape[2] <= NARROW:
            return self._banded(gyro, mag)
        return self._stepped(gyro, mag, given.shape[2])

    def _banded(self, gyro: Array | None, mag: Array | None) -> Array:
        """Few columns: the states of all rows solve a triangular system with a band."""
        s = self.states
        first, last = s + 3 * (gyro is None), s + 6 - 3 * (mag is None)
        inputs = np.concatenate([part for part in (gyro, mag) if part is not None], axis=1)
        driven = self.matrix[:, :, first:last] @ inputs
        states, _ = dtbtrs(self._band(), driven[:, 3:].reshape(-1, driven.shape[2]), "L", "N", "U")
        before = states.reshape(-1, s, driven.shape[2])[:-1]
        out: Array = driven[:, :3].copy()
        out[1:] += self.matrix[1:, :3, :s] @ before
        return out

    def _band(self) -> Array:
        """(2 s, N s) subdiagonals of what maps the states to what drives them, I - S one down."""
        if "band" not in self.made:
            s, count = self.states, len(self.matrix)
            band = np.zeros((2 * s, count, s))
            for i, j in np.ndindex(s, s):
                band[s + i - j, :-1, j] = -self.matrix[1:, 3 + i, j]
            self.made["band"] = band.reshape(2 * s, -1)
        return self.made["band"]

    def _stepped(self, gyro: Array | None, mag: Array | None, p: int) -> Array:
        """Many columns, p: all blocks from zero, and then what their true starts add."""
        count, s, rows = len(self.matrix), self.states, self.layout.rows
        steps = self._padded(gyro is not None, mag is not None)
        width = steps.shape[-1]
        out = np.empty((count + 1, 3, p))
        work = np.zeros((rows.shape[1], width, p))
        for row, step in zip(rows, steps, strict=True):
            at = np.minimum(row, count - 1)  # what stands behind a block's end is not looked at
            if gyro is not None:
                work[:, s : s + 3] = gyro[at]
            if mag is not None:
                work[:, width - 3 :] = mag[at]
            done = step @ work
            out[row] = done[:, :3]
            work[:, :s] = done[:, 3:]
        self._chain(out[:-1], work[:, :s])
        return out[:-1]

    def _padded(self, gyro: bool, mag: bool) -> Array:
        """(n, B, 3 + s, s + 3 or 6) the matrix step by step, its columns of the inputs given."""
        key = f"steps{' gyro' * gyro}{' mag' * mag}"
        if key not in self.made:
            s = self.states
            columns = [*range(s), *[*range(s, s + 3)] * gyro, *[*range(s + 3, s + 6)] * mag]
            rest = np.zeros(self.matrix.shape[1:])
            rest[3:, :s] = np.eye(s)
            kept = self.layout.padded(self.matrix, rest)[:, :, :, columns]
            self.made[key] = np.ascontiguousarray(kept)
        return self.made[key]

    def _chain(self, out: Array, ends: Array) -> None:
        """Add what each block's true starting state contributes, in place."""
        if "reach" not in self.made:
            s = self.states
            before, self.made["total"] = products_before(self.layout, self.matrix[:, 3:, :s])
            self.made["reach"] = self.matrix[:, :3, :s] @ before
        reach, total = self.made["reach"], self.made["total"]
        start = np.zeros_like(ends[0])
        for b, (first, last) in enumerate(zip(self.layout.starts, self.layout.ends, strict=True)):
            if np.any(start):
                flat = reach[first:last].reshape(-1, self.states) @ start
                out[first:last] += flat.reshape(last - first, 3, -1)
            start = total[b] @ start + ends[b]
