"""MAGICAL-LS: iterative least squares for soft and hard iron, gyro bias known.

    minimise sum |[w]x (C m - b') + C m'|^2

over the six terms of the symmetric A (C = A^-1) and b', by Gauss-Newton from A = I and b' = 0; A is
rescaled to unit volume after each step, A (l0 l1 l2)^(-1/3). The sum alone is least at C = 0, so a
step is the shortest that solves the linear problem: none along A itself, where nothing changes.
"""

from __future__ import annotations

import numpy as np

from ahrsd.estimator.chain import symmetric, upper_triangle
from ahrsd.methods.data import Data, Fit, MethodError, Settings
from ahrsd.methods.magical_nls import model
from ahrsd.methods.soft_iron import rescaled
from ahrsd.methods.windows import Kinematics, per_sample
from ahrsd.samples import Array

_MAX_STEPS = 100
_MAX_HALVINGS = 30
_TOLERANCE = 1e-9  # of the step, in units of A and gauss


def estimate(data: Data, settings: Settings) -> Fit:
    """A and b; the note says which gyro bias was taken as known."""
    kin = per_sample(data, settings)
    known = settings.known_gyro_bias_rad_s
    m = model()
    x = m.start.copy()
    x[9:] = known
    for count in range(1, _MAX_STEPS + 1):
        r, J = m.residual(kin, x)
        step = np.zeros(12)
        # rcond drops the direction along A, whose singular value is rounding only
        step[:9] = np.linalg.lstsq(J[:, :9], -r, rcond=1e-10)[0]
        x, moved = _taken(kin, x, step, float(r @ r))
        if moved < _TOLERANCE:
            fit = m.fit(x, count)
            note = "gyro bias taken as zero" if not np.any(known) else "gyro bias taken as given"
            return Fit(fit.soft_iron, fit.hard_iron_gauss, None, count, note)
    raise MethodError(f"no end after {_MAX_STEPS} steps")


def _taken(kin: Kinematics, x: Array, step: Array, cost: float) -> tuple[Array, float]:
    """x after the longest halving of the step that does not raise the cost, and how far it went."""
    m = model()
    for halving in range(_MAX_HALVINGS):
        part = step / 2**halving
        new = x + part
        A = symmetric(new[:6])
        if np.linalg.eigvalsh(A)[0] <= 0:
            continue
        new[:6] = upper_triangle(rescaled(A))
        r, _ = m.residual(kin, new)
        if r @ r <= cost:
            return new, float(np.linalg.norm(part))
    return x, 0.0
