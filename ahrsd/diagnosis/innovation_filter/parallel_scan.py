"""Linear recursions and Kalman gains over all samples, exact, in blocks that advance in parallel.

    x_k = S_k x_(k-1) + U_k z_k          S (s, s) per sample, x (s, p): one column per parameter

A Python loop over N samples is slow; numpy over N / n blocks is not.  Each block of n ~ sqrt(N)
consecutive samples starts from zero, and all blocks take their j-th step together.  As the
recursion is linear, the states at the block boundaries are chained afterwards, and the product of
the S before each sample adds their effect.
`tests/diagnosis/innovation_filter/test_innovation.py` compares with the plain loop.

Kalman gains of a linear model (`kalman_gains`):

    P-_k = S_k P_(k-1) S_k^T + Q_k,   S = H P- H^T + R,   K = P- H^T S^-1,   P_k = P- - K S K^T

with H = [A 0] and R = sigma^2 I.  The effect of a block on the covariance is a triple (T, C, J):
p(x_end | x_start) ~ N(T x_start, C), and J is the information that its readings hold on x_start
(Sarkka & Garcia-Fernandez, IEEE TAC 66(1), 2021, eq. 10-14).  The filter from P = 0 gives it, and

    P_end = T P (I + J P)^-1 T^T + C

chains the blocks.  Two successive triples combine to a triple:

    T = Tj (I + Ci Jj)^-1 Ti
    C = Tj (I + Ci Jj)^-1 Ci Tj^T + Cj
    J = Ti^T (I + Jj Ci)^-1 Jj Ti + Ji

A second pass from the true starting covariances gives every gain.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from ahrsd.samples import Array

#: columns up to which one banded triangular system is faster than the blocks
NARROW = 12
#: rows of a block: a step costs nearly the same for hundreds of blocks as for a few
STEPS = 24


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """B blocks of consecutive samples, none of which spans two runs; n is the longest.

    starts, ends: (B,) first row and one behind the last
    opens:        (B,) whether the block is the first of its run
    rows:         (n, B) row of each block's j-th step; N (behind the end) where it has none
    """

    starts: NDArray[np.intp]
    ends: NDArray[np.intp]
    opens: NDArray[np.bool]
    rows: NDArray[np.intp]

    def padded(self, values: Array, fill: Array | float) -> Array:
        """(n, B, ...) of (N, ...), step by step; `fill` where a block has ended."""
        tail = np.broadcast_to(np.asarray(fill, np.float64), values.shape[1:])
        return np.asarray(np.concatenate([values, tail[None]])[self.rows])

    def unpadded(self, values: Array) -> Array:
        """(N, ...) of (n, B, ...)."""
        count = int(self.ends[-1]) if len(self.ends) else 0
        out = np.empty((count + 1, *values.shape[2:]))
        out[self.rows] = values
        return out[:-1]


def layout_of(runs: tuple[slice, ...], longest: int | None = None) -> Layout:
    """Blocks of nearly equal length in every run, about as many as a block has steps.

    longest: most rows of a block, if given
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

    matrix: (N, 3 + s, s + z) the rows [Y V; S U]; z is 6: inputs of gyro (3) and mag (3)
    made:   cache of what was built from it
    """

    layout: Layout
    matrix: Array
    made: dict[str, Array] = field(default_factory=dict)

    @property
    def states(self) -> int:
        """Number of states, s."""
        return int(self.matrix.shape[-1]) - 6

    def run(self, gyro: Array | None, mag: Array | None) -> Array:
        """Outputs (N, 3, p) of the inputs z = [gyro; mag], each (N, 3, p) or None for zero."""
        given = gyro if gyro is not None else mag
        if given is None:
            raise ValueError("a recursion needs an input")
        if given.shape[2] <= NARROW:
            return self._run_banded(gyro, mag)
        return self._run_blocks(gyro, mag, given.shape[2])

    def _run_banded(self, gyro: Array | None, mag: Array | None) -> Array:
        """For few columns: the states of all rows solve one banded triangular system."""
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
        """(2 s, N s) subdiagonals of the matrix that maps the states to their inputs."""
        if "band" not in self.made:
            s, count = self.states, len(self.matrix)
            band = np.zeros((2 * s, count, s))
            for i, j in np.ndindex(s, s):
                band[s + i - j, :-1, j] = -self.matrix[1:, 3 + i, j]
            self.made["band"] = band.reshape(2 * s, -1)
        return self.made["band"]

    def _run_blocks(self, gyro: Array | None, mag: Array | None, p: int) -> Array:
        """For many columns, p: all blocks from zero, then the effect of their true starts."""
        count, s, rows = len(self.matrix), self.states, self.layout.rows
        steps = self._padded_steps(gyro is not None, mag is not None)
        width = steps.shape[-1]
        out = np.empty((count + 1, 3, p))
        work = np.zeros((rows.shape[1], width, p))
        for row, step in zip(rows, steps, strict=True):
            at = np.minimum(row, count - 1)  # values behind a block's end are not used
            if gyro is not None:
                work[:, s : s + 3] = gyro[at]
            if mag is not None:
                work[:, width - 3 :] = mag[at]
            done = step @ work
            out[row] = done[:, :3]
            work[:, :s] = done[:, 3:]
        self._add_block_starts(out[:-1], work[:, :s])
        return out[:-1]

    def _padded_steps(self, gyro: bool, mag: bool) -> Array:
        """(n, B, 3 + s, s + 3 or 6) the matrix step by step, columns of the given inputs."""
        key = f"steps{' gyro' * gyro}{' mag' * mag}"
        if key not in self.made:
            s = self.states
            columns = [*range(s), *[*range(s, s + 3)] * gyro, *[*range(s + 3, s + 6)] * mag]
            fill = np.zeros(self.matrix.shape[1:])
            fill[3:, :s] = np.eye(s)
            selected = self.layout.padded(self.matrix, fill)[:, :, :, columns]
            self.made[key] = np.ascontiguousarray(selected)
        return self.made[key]

    def _add_block_starts(self, out: Array, ends: Array) -> None:
        """Add the contribution of each block's true starting state, in place."""
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


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """The state-space model of every sample.

    transition: (N, s, s); in a run's first row it drops the states that this row initialises
    process:    (N, s, s); in a run's first row the covariance after its reading
    soft_iron:  A (3, 3);  variance: sigma_mag^2
    opens:      (N,) first row of a run: the state is taken from the reading
    blind:      (N,) no reading in this row
    """

    transition: Array
    process: Array
    soft_iron: Array
    variance: float
    opens: NDArray[np.bool]
    blind: NDArray[np.bool]


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """gain K (N, s, 3); innovation_covariance (N, 3, 3); the state's covariance is not kept."""

    gain: Array
    innovation_covariance: Array


def kalman_gains(model: LinearModel, runs: tuple[slice, ...]) -> Gains:
    """Gains of all rows of the gap-free runs."""
    sweep = _Sweep(model, layout_of(runs, STEPS))
    starts = _start_covariances(*sweep.element())
    gain, S = sweep.filter(starts)
    gain[model.blind] = 0.0
    gain[model.opens, :3] = np.linalg.inv(model.soft_iron)
    gain[model.opens, 3:] = 0.0
    return Gains(gain, S)


def _start_covariances(T: Array, C: Array, J: Array) -> Array:
    """Covariance at the start of each block (s, s, B); the first block opens a run.

    Prefix combination in log2(B) rounds: blocks are combined by twos, fours, and so on.
    """
    size, _, count = C.shape
    identity = np.eye(size)[:, :, None]
    reach = 1
    while reach < count:
        before, after = (slice(None, -reach), slice(reach, None))
        Ti, Ci, Ji = (part[:, :, before] for part in (T, C, J))
        Tj, Cj, Jj = (part[:, :, after] for part in (T, C, J))
        through = _solve(
            identity + _product(Jj, Ci), np.concatenate([_transpose(Tj), _product(Jj, Ti)], 1)
        )
        carried, seen = _transpose(through[:, :size]), through[:, size:]
        T, C, J = (
            np.concatenate([part[:, :, :reach], chained], axis=2)
            for part, chained in (
                (T, _product(carried, Ti)),
                (C, _symmetric(_product(_product(carried, Ci), _transpose(Tj)) + Cj)),
                (J, _symmetric(_product(_transpose(Ti), seen) + Ji)),
            )
        )
        reach *= 2
    return np.concatenate([np.zeros((size, size, 1)), C[:, :, :-1]], axis=2)


class _Sweep:
    """All blocks, step by step.  Matrices are (i, j, B): faster for thousands of 3 x 3."""

    def __init__(self, model: LinearModel, layout: Layout) -> None:
        self._size = model.transition.shape[-1]
        self._layout = layout
        self._A = model.soft_iron
        self._R = model.variance * np.eye(3)[:, :, None]
        self._steps = _blocks_last(layout.padded(model.transition, np.eye(self._size)))
        self._process = _blocks_last(layout.padded(model.process, 0.0))
        self._blind = layout.padded((model.blind | model.opens).astype(float), 1.0) > 0
        self._any_blind = np.any(self._blind, axis=1)

    def _predict(self, j: int, P: Array) -> tuple[Array, Array, Array]:
        """P-, A P-[:3] as (3, s, B), and S of step j, from P after step j - 1."""
        step = self._steps[j]
        moved = _product(step, P)
        prior = np.einsum("ikb,jkb->ijb", moved, step) + self._process[j]
        cross = self._observe(prior)
        return prior, cross, np.einsum("ikb,kj->ijb", cross[:, :3], self._A) + self._R

    def _observe(self, states: Array) -> Array:
        """A X[:3], (3, s, B)."""
        field = states[:3]
        return np.asarray((self._A @ field.reshape(3, -1)).reshape(field.shape))

    def element(self) -> tuple[Array, Array, Array]:
        """(T, C, J) of every block, (s, s, B) each."""
        (count, blocks), size = self._blind.shape, self._size
        C = np.zeros(self._steps.shape[1:])
        J = np.zeros_like(C)
        T: Array = np.repeat(np.eye(size)[:, :, None], blocks, axis=2)
        for j in range(count):
            prior, cross, S = self._predict(j, C)
            moved = _product(self._steps[j], T)
            seen = self._observe(moved)
            both = _product(inverse_3x3(S), np.concatenate([cross, seen], axis=1))
            if self._any_blind[j]:
                both[:, :, self._blind[j]] = 0.0
            back = np.einsum("kib,kjb->ijb", cross, both)
            C = _symmetric(prior - back[:, :size])
            J += np.einsum("kib,kjb->ijb", seen, both[:, size:])
            T = moved - back[:, size:]
        return T, C, J

    def filter(self, starts: Array) -> tuple[Array, Array]:
        """Gains (N, s, 3) and innovation covariances (N, 3, 3) from the true starts (s, s, B)."""
        (count, blocks), size = self._blind.shape, self._size
        gain = np.empty((count, 3, size, blocks))
        S = np.empty((count, 3, 3, blocks))
        P = starts
        for j in range(count):
            prior, cross, S[j] = self._predict(j, P)
            gain[j] = _product(inverse_3x3(S[j]), cross)
            if self._any_blind[j]:
                gain[j][:, :, self._blind[j]] = 0.0
            P = _symmetric(prior - np.einsum("kib,kjb->ijb", gain[j], cross))
        unpadded = self._layout.unpadded
        return unpadded(gain.transpose(0, 3, 2, 1)), unpadded(S.transpose(0, 3, 1, 2))


def _product(left: Array, right: Array) -> Array:
    """(i, j, B) products of (i, k, B) and (k, j, B)."""
    return np.asarray(np.einsum("ikb,kjb->ijb", left, right))


def _transpose(matrices: Array) -> Array:
    """(j, i, B) of (i, j, B)."""
    return np.swapaxes(matrices, 0, 1)


def _solve(left: Array, right: Array) -> Array:
    """(s, j, B) left^-1 right of (s, s, B) and (s, j, B)."""
    out = np.linalg.solve(np.moveaxis(left, 2, 0), np.moveaxis(right, 2, 0))
    return np.ascontiguousarray(np.moveaxis(out, 0, 2))


def _blocks_last(matrices: Array) -> Array:
    """(..., i, j, B) of (..., B, i, j)."""
    return np.ascontiguousarray(np.moveaxis(matrices, -3, -1))


#: indices of the entries of a 3 x 3 matrix whose products, added and subtracted, are its cofactors
_COFACTOR_PLUS = np.array([4, 5, 3, 7, 8, 6, 1, 2, 0]), np.array([8, 6, 7, 2, 0, 1, 5, 3, 4])
_COFACTOR_MINUS = np.array([5, 3, 4, 8, 6, 7, 2, 0, 1]), np.array([7, 8, 6, 1, 2, 0, 4, 5, 3])


def inverse_3x3(S: Array) -> Array:
    """(3, 3, B) inverses by cofactors, for well-conditioned matrices: faster than LAPACK."""
    flat = S.reshape(9, -1)
    cofactors = (
        flat[_COFACTOR_PLUS[0]] * flat[_COFACTOR_PLUS[1]]
        - flat[_COFACTOR_MINUS[0]] * flat[_COFACTOR_MINUS[1]]
    )
    determinant = np.einsum("ib,ib->b", flat[:3], cofactors[:3])
    return _transpose((cofactors / determinant).reshape(S.shape))


def _symmetric(P: Array) -> Array:
    return np.asarray((P + _transpose(P)) / 2)
