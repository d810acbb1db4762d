"""Total least squares on the effective measurement (Crassidis & Cheng 2020, as in [L] 2.25-2.32).

    z_k = |B~_k|^2 - |H_k|^2 = 2 B~_k . b - |b|^2 + v_k

The readings' noise is in the regressor 2 B~_k too, so that v_k = 2 (B~_k - b) . noise to first
order: its variance 4 s_k^2 |B~_k - b|^2 moves with b. The reduced form that carries it along:

    J(b) = 1/2 sum (|B~_k - b|^2 - |H_k|^2)^2 / (4 s_k^2 |B~_k - b|^2)

With rho = |B~_k - b| a row is (rho - H^2 / rho) / 2 and its derivative -(1 + H^2 / rho^2) / 2 along
the unit vector from b to B~_k. s_k is the same for all readings here and cancels.
"""

from __future__ import annotations

from ahrsd.baselines.data import MethodData, MethodFit, MethodSettings
from ahrsd.baselines.sphere import distances, linear_centre, minimise
from ahrsd.samples import Array


def rows(b: Array, field: Array, norms: Array) -> tuple[Array, Array]:
    """r (N,) and dr/db (N, 3)."""
    rho, n = distances(field, b)
    ratio = norms**2 / rho
    return (rho - ratio) / 2, -(1 + ratio / rho)[:, None] / 2 * n


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    return minimise(lambda b: rows(b, field, norms), linear_centre(field))
