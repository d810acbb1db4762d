"""A set's readings and columns in time, in the noise that the set leaves: white, of unit variance.

The noise of a set has a power per octave.  Divided by its root and turned back into time, readings
are independent of each other but for what the set's components say of them:

    y = X w + e,    w ~ N(0, Phi),    e ~ N(0, 1)

so that some of them can be held back, and what is left can be compared with anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.fft import idct

from ahrsd.diagnosis.innovation_filter.innovation import batches, joined, sensitivities
from ahrsd.diagnosis.model import Columns
from ahrsd.diagnosis.one_model.linearised import Linearised, by_frequency
from ahrsd.diagnosis.one_model.model_search import Hypotheses, Hypothesis
from ahrsd.samples import Array

#: relative: columns that are alike but for rounding would else leave no root
_ROUNDED = 1e-10
#: columns that pass the filter together
_BATCH = 96


@dataclass(frozen=True, slots=True, eq=False)
class WhiteRows:
    """Rows of the readings that are there, and of a set's columns, in the set's noise.

    y (N, 3);  X (N, 3, q);  phi (q,): log variances of the coefficients
    log_power: of the noise that was taken out, mean over the rows
    rows:      of the track, numbers (N,) of those that are here
    made, log_noise: of which and by which they were made
    """

    y: Array
    X: Array
    phi: Array
    log_power: float
    rows: NDArray[np.intp]
    made: Linearised
    log_noise: Array

    def like(self, rows: Array) -> Array:
        """Other rows by frequency (3 M, p) as (N, 3, p) here."""
        return _in_time(self.made, rows, self.log_noise)[self.rows]

    def passed(self, columns: Sequence[Columns]) -> Array:
        """(N, 3, p) columns of any kind as the filter and this noise leave them."""
        made, found = self.made, []
        for batch in batches(columns, _BATCH):
            cube = sensitivities(made.regressing, joined([columns[k] for k in batch]))
            cube = by_frequency(cube / made.point.loud.amplitude[:, None, None])
            found.append((batch, self.like(cube)))
        cut = {
            number: part
            for batch, cube in found
            for number, part in zip(batch, _cut(cube, [columns[k] for k in batch]), strict=True)
        }
        return np.concatenate([cut[k] for k in range(len(columns))], axis=2)

    def in_track(self, values: Array) -> Array:
        """(rows of the track, ...) with nothing where there is no reading."""
        out = np.zeros((len(self.made.point.loud.amplitude), *values.shape[1:]))
        out[self.rows] = values
        return out

    def fit(self, width: int | None = None) -> Fit:
        """The likeliest coefficients of the first `width` columns, or of all."""
        X = self.X.reshape(-1, self.X.shape[2])[:, :width]
        deviation = np.exp(0.5 * self.phi[:width])
        return Fit(X, deviation, root_of(X.T @ X, deviation))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Columns (3 N, q) with their prior deviations; root: upper, of A = I + D X^T X D."""

    X: Array
    deviation: Array
    root: Array

    def left(self, values: Array) -> Array:
        """(3 N, k) of values (3 N, k), the columns at their likeliest taken out."""
        D = self.deviation[:, None]
        w = D * linalg.cho_solve((self.root, False), D * (self.X.T @ values))
        return np.asarray(values - self.X @ w)

    def information(self, Z: Array) -> Array:
        """(p, p) Z^T V^-1 Z of other columns (3 N, p), V with all that the fit's columns may be."""
        seen = linalg.solve_triangular(
            self.root, self.deviation[:, None] * (self.X.T @ Z), trans="T", check_finite=False
        )
        return np.asarray(Z.T @ Z - seen.T @ seen)


def root_of(G: Array, deviation: Array) -> Array:
    """Upper root of I + D G D."""
    A = G * deviation * deviation[:, None]
    diagonal = np.diag_indices_from(A)
    A[diagonal] = A[diagonal] * (1.0 + _ROUNDED) + 1.0
    return np.asarray(linalg.cholesky(A, check_finite=False))


def white_rows(all_sets: Hypotheses, known: Hypothesis) -> WhiteRows:
    """A set's rows in its own noise."""
    made = all_sets.made
    rows = np.concatenate([*(made.rows(key) for key in known.keys), made.y[:, None]], axis=1)
    cube = _in_time(made, rows, known.at.log_noise)
    seen = np.flatnonzero(made.point.filtered.used)
    laws = [all_sets.component(key).law for key in known.keys]
    psi = all_sets.psi_of(known)
    phi = [law.log_variance(psi[key]) for key, law in zip(known.keys, laws, strict=True)]
    count = np.diff(made.edges)
    log_power = float(count @ known.at.log_noise) / float(count.sum())
    y, X = cube[seen, :, -1], cube[seen, :, :-1]
    return WhiteRows(y, X, np.concatenate(phi), log_power, seen, made, known.at.log_noise)


def _in_time(made: Linearised, rows: Array, log_noise: Array) -> Array:
    """(N, 3, p) of rows by frequency (3 M, p), the noise's powers taken out."""
    scale = np.exp(-0.5 * np.repeat(log_noise, 3 * np.diff(made.edges)))
    cube = (rows * scale[:, None]).reshape(-1, 3, rows.shape[1])
    return np.asarray(idct(cube, axis=0, norm="ortho")[: len(made.point.loud.amplitude)])


def _cut(cube: Array, columns: Sequence[Columns]) -> list[Array]:
    edges = np.cumsum([one.width for one in columns])[:-1]
    return np.split(cube, edges, axis=2)
