"""MAGICAL-NLS: nonlinear least squares for soft iron, hard iron and gyro bias.

    minimise sum |[w - w_b]x (C m - b') + C m'|^2

over 12 unknowns, the terms of A (C = A^-1, rescaled to unit volume each time), b' and w_b. Start
A = I, b' = 0, w_b = 0; trust region reflective, tolerance 1e-6.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.kinematic import Model
from ahrsd.baselines.soft_iron import positive, unit_volume
from ahrsd.baselines.windows import per_sample
from ahrsd.estimator.chain import upper_triangle
from ahrsd.samples import Array

TOLERANCE = 1e-6
_MAX_EVALUATIONS = 1000


def model() -> Model:
    """Terms of A, b' and w_b in one node."""
    start = np.concatenate([upper_triangle(np.eye(3)), np.zeros(6)])
    return Model(unit_volume, start, (12,), norm=False)


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError where the search diverges or does not end."""
    kin, m = per_sample(data, settings), model()
    # the solver asks for the two at the same point one after the other
    kept: dict[bytes, tuple[Array, Array]] = {}
    # trf shrinks its region where a step leads to what is not finite
    outside = np.full(3 * len(kin), np.nan), np.full((3 * len(kin), 12), np.nan)

    def both(x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if key not in kept:
            kept.clear()
            kept[key] = m.residual(kin, x) if positive(x[:6]) else outside
        return kept[key]

    def value(x: Array) -> Array:
        return both(x)[0]

    def derivative(x: Array) -> Array:
        return both(x)[1]

    found = least_squares(
        value,
        m.start,
        jac=derivative,
        method="trf",
        ftol=TOLERANCE,
        xtol=TOLERANCE,
        gtol=TOLERANCE,
        max_nfev=_MAX_EVALUATIONS,
    )
    if not found.success:
        raise MethodError(f"no end after {found.nfev} evaluations")
    return m.fit(np.asarray(found.x), int(found.nfev))
