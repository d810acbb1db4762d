"""Recursive filters of columns of samples, and what else smooths them, by linear algebra alone.

    y_k = keep_k y_(k-1) + x_k

is a triangular system with one band.  (Importing scipy's signal processing costs more time than a
short recording's whole diagnosis spends in filters.)
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtbtrs

from ahrsd.samples import Array

_TRUNCATED = 4.0  # deviations of a Gaussian that are kept


def first_order(values: Array, keep: float | Array) -> Array:
    """(N, k) of (N, k): each row plus `keep`, one number or (N - 1,), times the result before."""
    return autoregression(values, np.atleast_1d(np.asarray(keep, float))[None])


def autoregression(values: Array, coefficients: Array) -> Array:
    """(N, k): y_k = sum_j coefficients_j y_(k-j) + values_k, from zero.

    coefficients: (p, 1), or (p, N - 1) where they change from row to row
    """
    count = len(values)
    band = np.ones((len(coefficients) + 1, count))
    band[1:, : count - 1] = -coefficients
    out, _ = dtbtrs(band, values.reshape(count, -1), uplo="L", diag="U")
    return np.asarray(out).reshape(values.shape)


def both_ways(values: Array, keep: float) -> Array:
    """(N, k) sums over all rows, weighted by keep^|distance|."""
    back = first_order(values[::-1], keep)[::-1]
    return np.asarray(first_order(values, keep) + back - values)


def gaussian(values: Array, width: float) -> Array:
    """(N, k) smoothed by a Gaussian of `width` rows, mirrored at the ends."""
    reach = int(_TRUNCATED * width + 0.5)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    weight /= weight.sum()
    mirrored = np.pad(values, [(reach, reach), (0, 0)], mode="symmetric")
    columns = [np.convolve(column, weight, mode="valid") for column in mirrored.T]
    return np.column_stack(columns)
