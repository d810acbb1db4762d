"""NP with an uncertain field, Method 3 of [L] (2.56-2.73): |H_k| is itself measured, with noise.

    minimise 1/2 sum |B~_k - b - B'_k|^2 / s_k^2 + (H~_k - |B'_k|)^2 / s_h^2   over all B'_k and b

in turn over B'_k = B_k - b, which lies along n_k, from b to B~_k, and is c_k rho_k + (1 - c_k) H~_k
long with rho_k = |B~_k - b| and c_k = s_h^2 / (s_k^2 + s_h^2), and over b, the mean of B~_k - B'_k:

    db = mean (1 - c_k) (rho_k - H~_k) n_k

A field less sure than the readings has c_k near 1 and turns that crawl: they are lengthened by
1 / mean (1 - c_k), which ends at the same place. Where all samples have the same noise, c_k cancels
and b is FNP's; `MethodSettings.sigma_field_gauss` of every sample makes a difference. The errors of
|H_k| count as independent; an error common to all of them is not what this model knows.
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.checks import mag_noise
from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.sphere import linear_centre
from ahrsd.samples import Array

_MAX_TURNS = 50_000
_LEFT_GAUSS = 1e-9


def solve(field: Array, norms: Array, weights: Array, start: Array) -> tuple[Array, int]:
    """b (3,) and the turns; weights (N,) are 1 - c_k, at any scale.

    In the end each turn leaves the same part of the error, so what is left is a geometric series.
    MethodError where that is not below 1e-9 gauss in 50,000 turns.
    """
    b, before = start.copy(), np.inf
    axes = np.ascontiguousarray(field.T)
    share = weights / np.sum(weights)
    for count in range(1, _MAX_TURNS + 1):
        d = axes - b[:, None]
        rho = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        if not np.all(rho > 0):
            raise MethodError("diverged: the hard iron is one of the readings")
        step = d @ (share * (1 - norms / rho))
        b = b + step
        moved = float(np.sqrt(step @ step))
        if moved < _LEFT_GAUSS * max(1 - moved / before, 0.0) or moved == 0.0:
            return b, count
        before = moved
    raise MethodError(f"no end after {_MAX_TURNS} turns")


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """b.  MethodError where the field's magnitude is not known or the turns do not end."""
    field, norms = data.raw_b_gauss, data.field_norms()
    sigma = np.asarray(settings.sigma_field_gauss, dtype=np.float64)
    if sigma.ndim and sigma.shape != (len(data),):
        raise MethodError(f"sigma_field_gauss has {sigma.shape}: one number or {len(data)}")
    noise = mag_noise(data, settings) ** 2
    weights = np.broadcast_to(noise / (noise + sigma**2), (len(data),))
    b, count = solve(field, norms, weights, linear_centre(field))
    return MethodFit(None, b, None, count)
