"""NP with an uncertain field, Method 3 of [L] (2.56-2.73): |H_k| is itself measured, with noise.

    minimise 1/2 sum |B~_k - b - B'_k|^2 / s_k^2 + (H~_k - |B'_k|)^2 / s_h^2   over all B'_k and b

in turn over B'_k = B_k - b, which lies along B~_k - b with the weighted mean of |B~_k - b| and H~_k
as its length, and over b, the mean of B~_k - B'_k. Both are explicit. The errors of |H_k| count as
independent from sample to sample; an error common to all of them is not what this model knows.
"""

from __future__ import annotations

import numpy as np

from ahrsd.methods.checks import mag_noise
from ahrsd.methods.data import Data, Fit, MethodError, Settings
from ahrsd.methods.sphere import distances, linear_centre
from ahrsd.samples import Array

_MAX_ITERATIONS = 20_000
_STEP_GAUSS = 1e-10


def solve(field: Array, norms: Array, share: float, start: Array) -> tuple[Array, int]:
    """b (3,) and the iterations; `share` of the reading in |B'_k|, s_h^2 / (s^2 + s_h^2).

    Each turn leaves the same part of the error, so a geometric series says how much is left.
    MethodError where that is not below 1e-10 gauss in 20,000 turns.
    """
    b = start.copy()
    before = np.inf
    for count in range(1, _MAX_ITERATIONS + 1):
        rho, n = distances(field, b)
        length = share * rho + (1 - share) * norms
        step = np.mean(field - length[:, None] * n, axis=0) - b
        b = b + step
        moved = float(np.linalg.norm(step))
        rate = min(moved / before, 1.0) if before < np.inf and before > 0 else 1.0
        if moved <= _STEP_GAUSS * (1 - rate) or moved == 0.0:
            return b, count
        before = moved
    raise MethodError(f"no end after {_MAX_ITERATIONS} turns")


def estimate(data: Data, settings: Settings) -> Fit:
    """b.  MethodError where the field's magnitude is not known or the turns do not end."""
    field, norms = data.raw_b_gauss, data.field_norms()
    noise = mag_noise(data, settings) ** 2
    share = settings.sigma_field_gauss**2 / (noise + settings.sigma_field_gauss**2)
    b, count = solve(field, norms, share, linear_centre(field))
    return Fit(None, b, None, count)
