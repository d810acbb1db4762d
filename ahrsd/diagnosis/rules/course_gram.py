"""Courses in stretches without their columns: each source in its own rows, then what is kept of it.

A stretch's three columns are driven inside it only; behind it the filter's state, a few numbers,
carries all that is left of them.  With x the state, the whitened rows of a piece of recording are

    W [x; c],   W = [reach | own]        reach (3 n, s): of the state it starts from, own (3 n, 3)

and W with the states carried from piece to piece gives every product of the columns: the same
numbers as columns (N, 3, 3 J) through the filter, without any of them.
`tests/diagnosis/rules/test_course_gram.py` holds both against each other.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.innovation_filter.blocks import Layout, Recursion
from ahrsd.diagnosis.innovation_filter.gram import Gram, slices
from ahrsd.diagnosis.rules.locate import group_name
from ahrsd.diagnosis.rules.regression import Base, group_gram
from ahrsd.diagnosis.where_and_when.locate import Frame, Segments, frame_columns, unit_columns
from ahrsd.samples import Array

#: rows of a piece, at most: as many pieces as steps in one, about
_ROWS = 128


@dataclass(frozen=True, slots=True, eq=False)
class Courses:
    """Whitened columns X (3 N, q) of courses in some frames, frame by frame, stretch by stretch.

    rows: (N, 3, s + 3 F) of unit states at each piece's start and of unit sources in it
    edges: (M + 1,) rows at which pieces begin;  states: (M, s + 3 F, q) what of X each is made of
    """

    rows: Array
    edges: tuple[int, ...]
    states: Array

    def products(self) -> Array:
        """(q, q) X^T X."""
        inner = np.array([part.T @ part for part in self._pieces(self.rows)])
        flat = self.states.reshape(-1, self.states.shape[2])
        return np.asarray(flat.T @ (inner @ self.states).reshape(flat.shape))

    def cross(self, columns: Array) -> Array:
        """(q, k) X^T of columns (N, 3, k)."""
        pairs = zip(self._pieces(self.rows), self._pieces(columns), strict=True)
        inner = np.concatenate([own.T @ other for own, other in pairs])
        return np.asarray(self.states.reshape(len(inner), -1).T @ inner)

    def times(self, value: Array) -> Array:
        """(N, 3) X value, of (q,) coefficients."""
        parts = self.states @ value
        pairs = zip(self._pieces(self.rows), parts, strict=True)
        return np.concatenate([own @ part for own, part in pairs]).reshape(-1, 3)

    def _pieces(self, columns: Array) -> list[Array]:
        """(3 n, k) of each piece, of (N, 3, k)."""
        flat = columns.reshape(-1, columns.shape[2])
        return [flat[3 * a : 3 * b] for a, b in itertools.pairwise(self.edges)]


def courses(basis: Base, frames: Sequence[Frame], cut: Segments) -> Courses | None:
    """The frames' courses as the innovations of the basis see them.

    None where noise of its own law is in the basis: what the filter keeps is then not all that is
    left of a stretch.
    """
    recursion = basis.filtered.recursion
    if basis.rest is not None or recursion is None:
        return None
    pieces = _pieces(recursion, cut)
    rows, ends = _from_starts(recursion, pieces.layout, _driven(basis, recursion, frames))
    if basis.weight is not None:
        rows = basis.weight @ rows
    edges = (*pieces.layout.starts.tolist(), len(rows))
    return Courses(rows, edges, _carried(ends, pieces.stretch, len(cut)))


def course_gram(basis: Base, frame: Frame, cut: Segments) -> Gram:
    """The same as `group_gram` of the frame's columns; one block, calibration and terms taken out.

    By the columns where `courses` are none.
    """
    found = courses(basis, [frame], cut)
    if found is None:
        return group_gram(basis, {group_name(frame): frame_columns(basis.context, frame, cut)})
    Z, e = basis.known, basis.innovation[:, :, None]
    beside = np.concatenate([Z, e], axis=2)
    flat = beside.reshape(-1, beside.shape[2])
    cross = found.cross(beside)
    total = np.block([[flat.T @ flat, cross.T], [cross, found.products()]])
    q, width = Z.shape[2], 3 * len(cut)
    order = np.r_[0:q, q + 1 : q + 1 + width, q]  # the innovation last
    return _as_gram(basis, frame, total[np.ix_(order, order)]).project(list(basis.groups))


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Consecutive pieces of the recording.  stretch: (M,) in which each lies, -1 for none."""

    layout: Layout
    stretch: NDArray[np.intp]


def _pieces(recursion: Recursion, cut: Segments) -> _Pieces:
    """Cut where the stretch changes, and so that no piece is long."""
    count = len(recursion.matrix)
    changes = np.flatnonzero(np.diff(cut.index)) + 1
    starts = np.union1d(np.arange(0, count, _ROWS), changes).astype(np.intp)
    ends = np.append(starts[1:], count)
    rows = starts + np.arange(int(np.max(ends - starts)))[:, None]
    layout = Layout(starts, ends, starts == 0, np.where(rows < ends, rows, count))
    return _Pieces(layout, cut.index[starts])


def _driven(basis: Base, recursion: Recursion, frames: Sequence[Frame]) -> Array:
    """(N, 3 + s, 3 F) what unit sources of each frame add to outputs and states, row by row."""
    s = recursion.states
    parts = []
    for frame in frames:
        side = slice(s, s + 3) if frame == "gyro" else slice(s + 3, s + 6)
        parts.append(recursion.matrix[:, :, side] @ unit_columns(basis.context, frame))
    return np.concatenate(parts, axis=2)


def _from_starts(recursion: Recursion, layout: Layout, driven: Array) -> tuple[Array, Array]:
    """Rows (N, 3, s + u) of unit states at each piece's start and of the u unit sources in it.

    And the states (M, s, s + u) behind each piece.
    """
    s = recursion.states
    rest = np.zeros((3 + s, s))
    rest[3:] = np.eye(s)
    steps = layout.padded(recursion.matrix[:, :, :s], rest)
    inputs = layout.padded(driven, 0.0)
    state = np.zeros((len(layout.starts), s, s + driven.shape[2]))
    state[:, :, :s] = np.eye(s)
    out = np.empty((len(driven) + 1, 3, state.shape[2]))
    for row, step, new in zip(layout.rows, steps, inputs, strict=True):
        done = step @ state
        done[:, :, s:] += new
        out[row] = done[:, :3]
        state = done[:, 3:]
    return out[:-1], state


def _carried(ends: Array, stretch: NDArray[np.intp], count: int) -> Array:
    """(M, s + 3 F, 3 J F) what of each column each piece starts from, and is driven by.

    ends: (M, s, s + 3 F) states behind each piece
    """
    s, own = ends.shape[1:]
    frames = (own - s) // 3
    states = np.zeros((len(ends), own, 3 * count * frames))
    carried = np.zeros((s, states.shape[2]))
    for m, (end, j) in enumerate(zip(ends, stretch, strict=True)):
        states[m, :s] = carried
        for f in range(frames if j >= 0 else 0):
            at = 3 * (f * count + j)
            states[m, s + 3 * f : s + 3 * f + 3, at : at + 3] = np.eye(3)
        carried = end @ states[m]
    return states


def _as_gram(basis: Base, frame: Frame, sums: Array) -> Gram:
    """The sums over all rows as a Gram of one block, the course behind the known groups."""
    width = len(sums) - 1 - basis.known.shape[2]
    known = [(name, where.stop - where.start) for name, where in basis.groups.items()]
    time_s = basis.context.track.time_s
    return Gram(
        slices([*known, (group_name(frame), width)]),
        sums[None],
        np.array([3.0 * len(basis.innovation)]),
        np.array([[time_s[0], time_s[-1]]], float),
        np.diag(sums)[:-1].copy(),
    )
