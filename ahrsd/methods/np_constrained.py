"""NP, Method 1 of [L] (2.33-2.37): norm preservation as a constrained problem.

    minimise 1/2 sum |B~_k - B_k|^2 / s_k^2  over all B_k and b,  subject to |B_k - b| = |H_k|

3 N + 3 unknowns and N constraints, by sequential quadratic programming: the constraints g_k =
|B_k - b| - |H_k| are linear along n_k = (B_k - b) / |B_k - b| and the objective is quadratic. Given
the step of b, that of B_k is explicit (a multiplier per constraint),

    lambda_k = n_k . db - g_k - n_k . (B~_k - B_k),    dB_k = B~_k - B_k + lambda_k n_k

which leaves sum (lambda_k / s_k)^2 to be minimised over db. Ends where B_k meet the constraints and
db vanishes; s_k is the same for all readings here and cancels.
"""

from __future__ import annotations

import numpy as np

from ahrsd.methods.data import Data, Fit, MethodError, Settings
from ahrsd.methods.sphere import distances, linear_centre
from ahrsd.samples import Array

_MAX_ITERATIONS = 500
_STEP_GAUSS = 1e-13
_CONSTRAINT_GAUSS = 1e-12


def solve(field: Array, norms: Array, start: Array) -> tuple[Array, Array, int]:
    """b (3,), B_k (N, 3) and the iterations.  MethodError where they do not end."""
    b, B = start.copy(), field.copy()
    for count in range(1, _MAX_ITERATIONS + 1):
        size, n = distances(B, b)
        rest = size - norms + np.sum(n * (field - B), axis=1)
        db = np.linalg.lstsq(n, rest, rcond=None)[0]
        multiplier = n @ db - rest
        B = field + multiplier[:, None] * n
        b = b + db
        violation = float(np.max(np.abs(np.linalg.norm(B - b, axis=1) - norms)))
        if float(np.linalg.norm(db)) < _STEP_GAUSS and violation < _CONSTRAINT_GAUSS:
            return b, B, count
    raise MethodError(f"no end after {_MAX_ITERATIONS} iterations")


def estimate(data: Data, settings: Settings) -> Fit:
    """b.  MethodError where the field's magnitude is not known or the search does not end."""
    del settings
    field, norms = data.raw_b_gauss, data.field_norms()
    b, _, count = solve(field, norms, linear_centre(field))
    return Fit(None, b, None, count)
