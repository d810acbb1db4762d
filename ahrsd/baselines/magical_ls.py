"""MAGICAL-LS: iterative least squares for soft and hard iron, gyro bias known ([R]).

    minimise sum |[w]x (C m - b') + C m'|^2

over the six terms of the symmetric A (C = A^-1) and b', by Gauss-Newton from A = I and b' = 0; A is
rescaled to unit volume after each step, A (l0 l1 l2)^(-1/3). The sum alone is least at C = 0, so a
step is the shortest that solves the linear problem: none along A itself, where nothing changes.

With the bias known the residual is Phi [c, b'], linear, and Phi = Q R: all steps need is R (9, 9).
They are many where the derivative is noise, because the residual that stays is large.
"""

from __future__ import annotations

import numpy as np

from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.kinematic import residual
from ahrsd.baselines.soft_iron import answer, positive, rescaled, unit_volume
from ahrsd.baselines.windows import per_sample
from ahrsd.estimator.chain import symmetric, upper_triangle
from ahrsd.samples import Array

_MAX_STEPS = 20_000
_MAX_HALVINGS = 30
_TOLERANCE = 1e-7  # of a step, in units of A and gauss


def estimate(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A and b; the note says which gyro bias was taken as known."""
    known = settings.known_gyro_bias_rad_s
    _, phi = residual(per_sample(data, settings), np.zeros(6), np.zeros(3), known)
    R = np.asarray(np.linalg.qr(phi[:, :9]).R)
    x = np.concatenate([upper_triangle(np.eye(3)), np.zeros(3)])
    for count in range(1, _MAX_STEPS + 1):
        r, J = _rows(R, x)
        # rcond drops the direction along A, whose singular value is rounding only
        step = np.asarray(np.linalg.lstsq(J, -r, rcond=1e-10)[0])
        x, moved = _taken(R, x, step, float(r @ r))
        if moved < _TOLERANCE:
            A, b = answer(unit_volume(x[:6])[0], x[6:])
            note = "gyro bias taken as given" if np.any(known) else "gyro bias taken as zero"
            return MethodFit(A, b, None, count, note)
    raise MethodError(f"no end after {_MAX_STEPS} steps")


def _rows(R: Array, x: Array) -> tuple[Array, Array]:
    """Residual (9,) of x = [A (6), b' (3)] and its derivative (9, 9)."""
    c6, J6 = unit_volume(x[:6])
    return R @ np.concatenate([c6, x[6:]]), np.hstack([R[:, :6] @ J6, R[:, 6:]])


def _taken(R: Array, x: Array, step: Array, cost: float) -> tuple[Array, float]:
    """x after the longest halving of the step that does not raise the cost, and how far it went."""
    for halving in range(_MAX_HALVINGS):
        part = step / 2**halving
        new = x + part
        if positive(new[:6]):
            new[:6] = upper_triangle(rescaled(symmetric(new[:6])))
            r, _ = _rows(R, new)
            if r @ r <= cost:
                return new, float(np.linalg.norm(part))
    return x, 0.0
