"""Many columns fitted together beside a model: free courses in some frames, and others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.diagnosis.innovation_filter.gram import RANK_SHARE, solve
from ahrsd.diagnosis.rules.course_gram import Courses, courses
from ahrsd.diagnosis.rules.regression import BATCH_COLUMNS, Base, residual
from ahrsd.diagnosis.values import Columns
from ahrsd.diagnosis.where_and_when.locate import Frame, Segments, frame_columns
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """Whitened columns X (3 N, q), the courses first.

    free: the courses, None where they are among the others;  others: (N, 3, k);  units: (q,) by
    which all are multiplied
    """

    free: Courses | None
    others: Array
    units: Array

    def products(self) -> Array:
        """(q, q) X^T X."""
        flat = self.others.reshape(-1, self.others.shape[2])
        own = flat.T @ flat
        if self.free is not None:
            cross = self.free.cross(self.others)
            own = np.block([[self.free.products(), cross], [cross.T, own]])
        return np.asarray(own * self.units * self.units[:, None])

    def cross(self, columns: Array) -> Array:
        """(q, k) X^T of columns (N, 3, k)."""
        flat = self.others.reshape(-1, self.others.shape[2])
        parts = [] if self.free is None else [self.free.cross(columns)]
        parts.append(flat.T @ columns.reshape(len(flat), -1))
        return np.concatenate(parts) * self.units[:, None]

    def times(self, value: Array) -> Array:
        """(N, 3) X value, of (q,) coefficients."""
        value = value * self.units
        k = len(value) - self.others.shape[2]
        own = self.others @ value[k:]
        return np.asarray(own if self.free is None else own + self.free.times(value[:k]))


def together(
    basis: Base,
    frames: Sequence[tuple[Frame, float]],
    cut: Segments,
    others: Sequence[tuple[Columns, float]],
) -> Together:
    """Courses of the frames, and other columns, each with its unit, as the innovation sees them."""
    free = courses(basis, [frame for frame, _ in frames], cut)
    units = [np.full(3 * len(cut), unit) for _, unit in frames]
    units += [np.full(columns.width, unit) for columns, unit in others]
    plain = [columns for columns, _ in others]
    if free is None:
        plain = [*(frame_columns(basis.context, frame, cut) for frame, _ in frames), *plain]
    return Together(free, _whitened(basis, plain), np.concatenate(units))


def pieces(columns: Columns, most: int) -> list[Columns]:
    """The columns in parts of at most `most`."""
    if columns.width <= most:
        return [columns]
    cuts = range(0, columns.width, most)
    mag, gyro = (
        [None if side is None else side[:, :, at : at + most] for at in cuts]
        for side in (columns.mag, columns.gyro)
    )
    return [Columns(*sides) for sides in zip(mag, gyro, strict=True)]


def _whitened(basis: Base, columns: Sequence[Columns]) -> Array:
    """(N, 3, q) the columns next to each other, as the innovation sees them.

    Hundreds of them, so a piece at a time into where all of them stay.
    """
    parts = [piece for one in columns for piece in pieces(one, BATCH_COLUMNS)]
    ends = np.cumsum([piece.width for piece in parts])
    out = np.empty((len(basis.innovation), 3, int(ends[-1])))
    for batch, seen in basis.passed(parts):
        first = 0
        for k in batch:
            width = parts[k].width
            out[:, :, ends[k] - width : ends[k]] = seen[:, :, first : first + width]
            first += width
    return out


def projected(basis: Base, columns: Array) -> tuple[Array, Array]:
    """Information (q, q) and score (q,) of (N, 3, q) with the known columns regressed out.

    Combinations with less information than RANK_SHARE of what the columns had are left out: they
    are made of the noise of the field that the columns were built from.
    """
    Z = basis.known.reshape(-1, basis.known.shape[2])
    X = columns.reshape(len(Z), -1)
    return _regressed(basis, X.T @ X, X.T @ Z, X.T @ basis.innovation.ravel())


def projected_with(
    basis: Base, free: Together, products: Array, named: Array | None = None
) -> tuple[Array, Array]:
    """The same of columns together, whose products are known, and of further (N, 3, p)."""
    Z, e = basis.known.reshape(-1, basis.known.shape[2]), basis.innovation.ravel()
    named = np.empty((len(basis.innovation), 3, 0)) if named is None else named
    X = named.reshape(len(Z), -1)
    beside = np.concatenate([basis.known, basis.innovation[:, :, None], named], axis=2)
    q = Z.shape[1]
    cross = free.cross(beside)
    with_named = cross[:, q + 1 :]
    return _regressed(
        basis,
        np.block([[products, with_named], [with_named.T, X.T @ X]]),
        np.concatenate([cross[:, :q], X.T @ Z]),
        np.concatenate([cross[:, q], X.T @ e]),
    )


def _regressed(basis: Base, whole: Array, cross: Array, seen: Array) -> tuple[Array, Array]:
    """Of X^T X (q, q), X^T Z and X^T e: those with the known columns Z regressed out."""
    Z = basis.known.reshape(-1, basis.known.shape[2])
    M = solve(Z.T @ Z, cross.T)
    root = np.sqrt(np.maximum(np.diag(whole), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((whole - cross @ M) / np.outer(root, root))
    kept = values > RANK_SHARE * len(root)
    directions = root[:, None] * vectors[:, kept]
    s = vectors[:, kept].T @ ((seen - M.T @ (Z.T @ basis.innovation.ravel())) / root)
    return (directions * values[kept]) @ directions.T, directions @ s


def left_beside(basis: Base, free: Together, G: Array, s: Array) -> Array:
    """(N, 3) innovation with known columns and these, of projected G and s, regressed out."""
    theta = solve(G, s[:, None])[:, 0]
    return residual(basis.known, basis.innovation - free.times(theta))
