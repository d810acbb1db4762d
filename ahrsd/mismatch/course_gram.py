"""Gram of a course in stretches without its columns: each source in its rows, then what is kept.

A stretch's three columns are driven inside it only; behind it the filter's state, a few numbers,
carries all that is left of them.  With x the state, the whitened rows of a piece of recording are

    W [x; c],   W = [reach | own]        reach (3 n, s): of the state it starts from, own (3 n, 3)

and C = W^T W of the pieces, with the states carried from piece to piece, is the whole Gram: the
same numbers as columns (N, 3, 3 J) through the filter, without any of them.
`tests/mismatch/test_course_gram.py` holds both against each other.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.mismatch.blocks import Layout, Recursion
from ahrsd.mismatch.gram import Gram, slices
from ahrsd.mismatch.locate import Frame, Segments, frame_columns, group_name, unit_columns
from ahrsd.mismatch.regression import Base, group_gram
from ahrsd.mismatch.values import Columns
from ahrsd.samples import Array

#: rows of a piece, at most: as many pieces as steps in one, about
_ROWS = 128


def course_gram(basis: Base, frame: Frame, cut: Segments) -> Gram:
    """The same as `group_gram` of the frame's columns; one block, calibration and terms taken out.

    Where noise of its own law is in the basis, by the columns: what the filter keeps is then not
    all that is left of a stretch.
    """
    if basis.rest is not None or basis.filtered.recursion is None:
        return group_gram(basis, {group_name(frame): frame_columns(basis.context, frame, cut)})
    recursion = basis.filtered.recursion
    driving = unit_columns(basis.context, frame)
    side = slice(0, 3) if frame == "gyro" else slice(3, 6)
    pieces = _pieces(recursion, cut)
    rows, ends = _from_starts(recursion, pieces.layout, driving, side)
    if basis.weight is not None:
        rows = basis.weight @ rows
    beside = np.concatenate([basis.known, basis.innovation[:, :, None]], axis=2)
    stacked = np.concatenate([rows, beside], axis=2)
    edges = itertools.pairwise([*pieces.layout.starts.tolist(), len(stacked)])
    flat = [stacked[a:b].reshape(3 * (b - a), -1) for a, b in edges]
    products = np.array([part.T @ part for part in flat])
    total = _summed(products, ends, pieces.stretch, len(cut))
    return _as_gram(basis, frame, total, 3 * len(cut)).project(list(basis.groups))


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Consecutive pieces of the recording.  stretch: (M,) in which each lies, -1 for none."""

    layout: Layout
    stretch: NDArray[np.intp]


def course_response(basis: Base, frame: Frame, cut: Segments, course: Array) -> Array:
    """(N, 3) whitened, what a course (J, 3) of the frame's coefficients adds to the innovations."""
    known = np.concatenate([course, np.zeros((1, 3))])[cut.index]  # index -1: in no stretch
    driven = unit_columns(basis.context, frame) @ known[:, :, None]
    columns = Columns(gyro=driven) if frame == "gyro" else Columns(mag=driven)
    return np.asarray(basis.whitened([columns])[0][:, :, 0])


def _pieces(recursion: Recursion, cut: Segments) -> _Pieces:
    """Cut where the stretch changes, and so that no piece is long."""
    count = len(recursion.matrix)
    changes = np.flatnonzero(np.diff(cut.index)) + 1
    starts = np.union1d(np.arange(0, count, _ROWS), changes).astype(np.intp)
    ends = np.append(starts[1:], count)
    rows = starts + np.arange(int(np.max(ends - starts)))[:, None]
    layout = Layout(starts, ends, starts == 0, np.where(rows < ends, rows, count))
    return _Pieces(layout, cut.index[starts])


def _from_starts(
    recursion: Recursion, layout: Layout, driving: Array, side: slice
) -> tuple[Array, Array]:
    """Rows (N, 3, s + 3) of unit states at each piece's start and of unit sources in it.

    And the states (M, s, s + 3) behind each piece.  driving: (N, 3, 3) of the sources
    """
    s = recursion.states
    matrix = recursion.matrix
    driven = matrix[:, :, s:][:, :, side] @ driving  # (N, 3 + s, 3)
    rest = np.zeros((3 + s, s))
    rest[3:] = np.eye(s)
    steps, inputs = layout.padded(matrix[:, :, :s], rest), layout.padded(driven, 0.0)
    state = np.zeros((len(layout.starts), s, s + 3))
    state[:, :, :s] = np.eye(s)
    out = np.empty((len(matrix) + 1, 3, s + 3))
    for row, step, new in zip(layout.rows, steps, inputs, strict=True):
        done = step @ state
        done[:, :, s:] += new
        out[row] = done[:, :3]
        state = done[:, 3:]
    return out[:-1], state


def _summed(products: Array, ends: Array, stretch: NDArray[np.intp], count: int) -> Array:
    """(3 J + q + 1, same) the products of all columns, of known ones and of the innovation.

    products: (M, s + 3 + q + 1, same) of each piece;  ends: (M, s, s + 3) states behind it
    """
    s, own = ends.shape[1], ends.shape[2]
    width = 3 * count
    other = products.shape[1] - own
    total = np.zeros((width + other, width + other))
    total[width:, width:] = products[:, own:, own:].sum(axis=0)
    states = np.zeros((len(products), own, width))  # what of each course each piece starts from
    carried = np.zeros((s, width))
    for m, (end, j) in enumerate(zip(ends, stretch, strict=True)):
        states[m, :s] = carried
        if j >= 0:
            states[m, s:, 3 * j : 3 * j + 3] = np.eye(3)
        carried = end @ states[m]
    seen = products[:, :own, :own] @ states
    total[:width, :width] = states.reshape(-1, width).T @ seen.reshape(-1, width)
    cross = np.swapaxes(products[:, :own, own:], 1, 2) @ states
    total[width:, :width] = cross.sum(axis=0)
    total[:width, width:] = total[width:, :width].T
    return total


def _as_gram(basis: Base, frame: Frame, total: Array, width: int) -> Gram:
    """The sums, course first, as a Gram in which the known groups come first."""
    q = len(total) - width - 1
    order = np.r_[width : width + q, 0:width, width + q]
    sums = total[np.ix_(order, order)]
    known = [(name, where.stop - where.start) for name, where in basis.groups.items()]
    time_s = basis.context.track.time_s
    return Gram(
        slices([*known, (group_name(frame), width)]),
        sums[None],
        np.array([3.0 * len(basis.innovation)]),
        np.array([[time_s[0], time_s[-1]]], float),
        np.diag(sums)[:-1].copy(),
    )
