"""Correlated noise that is whitened out of a regression."""

from __future__ import annotations

from typing import Protocol

from ahrsd.samples import Array


class Whitening(Protocol):
    """V^-1/2 of noise of covariance V."""

    def whitened(self, values: Array) -> Array:
        """V^-1/2 of (N, 3) or (N, 3, p)."""
