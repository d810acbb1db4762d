"""FNP, Method 2 of [L] (2.38-2.55): norm preservation with the constraint solved away.

    J(b) = 1/2 sum s_k^-2 (|B~_k - b| - |H_k|)^2,    B_k = b + |H_k| (B~_k - b) / |B~_k - b|

The same answer as NP from three unknowns. s_k is the same for all readings here and cancels.
"""

from __future__ import annotations

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.sphere import distances, linear_centre, minimise
from ahrsd.samples import Array


def rows(b: Array, field: Array, norms: Array) -> tuple[Array, Array]:
    """r (N,) and dr/db (N, 3)."""
    rho, n = distances(field, b)
    return rho - norms, -n


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    return minimise(lambda b: rows(b, field, norms), linear_centre(field))
