"""A calibration without a truth: corrected fields and their normalised spread ([R] 4.4)."""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array


def field_spread(corrected: Array) -> float:
    """Standard deviation of |h| over its mean, of corrected fields (N, 3); 0 is perfect."""
    size = np.linalg.norm(corrected, axis=1)
    return float(np.std(size) / np.mean(size))


def corrected(raw_b_gauss: Array, soft_iron: Array | None, hard_iron_gauss: Array) -> Array:
    """A^-1 (m - b) of readings (N, 3); without a soft iron m - b."""
    centred = raw_b_gauss - hard_iron_gauss
    if soft_iron is None:
        return centred
    return np.asarray(np.linalg.solve(soft_iron, centred.T).T, dtype=np.float64)
