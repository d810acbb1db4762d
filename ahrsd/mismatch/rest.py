"""Correlated noise with a few directions of its own, whitened out of a regression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Correlated noise V = noise I + U diag(d^2) U^T, of which V^-1/2 is applied to columns.

    directions: (3 N, r) U, orthonormal;  kept: (r,) sqrt(noise / (noise + d^2));  noise: power
    """

    directions: Array
    kept: Array
    noise: float

    def whitened(self, values: Array) -> Array:
        """V^-1/2 of (N, 3) or (N, 3, p)."""
        flat = values.reshape(len(self.directions), -1)
        seen = self.directions.T @ flat
        left = flat - self.directions @ ((1.0 - self.kept)[:, None] * seen)
        return np.asarray((left / np.sqrt(self.noise)).reshape(values.shape))
