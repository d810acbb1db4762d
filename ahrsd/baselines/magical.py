"""MAGICAL's four methods ([R]): linear and nonlinear least squares, batch and incremental graph.

Soft iron, hard iron and, but for LS, the gyro bias from the magnetometer and the gyroscope; the
residual is that of `kinematic`.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodSettings
from ahrsd.baselines.graphs import batch, incremental
from ahrsd.baselines.kinematic import Model, per_sample, residual, windowed
from ahrsd.baselines.soft_iron import answer, positive, rescaled, triangle, unit_volume
from ahrsd.estimator.chain import symmetric, upper_triangle
from ahrsd.samples import Array

# -- MAGICAL-LS ------------------------------------------------------------------------------------
#
# MAGICAL-LS: iterative least squares for soft and hard iron, gyro bias known ([R]).
#
#     minimise sum |[w]x (C m - b') + C m'|^2
#
# over the six terms of the symmetric A (C = A^-1) and b', by Gauss-Newton from A = I and b' = 0; A
# is rescaled to unit volume after each step, A (l0 l1 l2)^(-1/3). The sum alone is least at C = 0,
# so a step is the shortest that solves the linear problem: none along A itself, where nothing
# changes.
#
# With the bias known the residual is Phi [c, b'], linear, and Phi = Q R: all steps need is R (9,
# 9). They are many where the derivative is noise, because the residual that stays is large.


_LS_MAX_STEPS = 20_000
_LS_MAX_HALVINGS = 30
_LS_TOLERANCE = 1e-7  # of a step, in units of A and gauss


def estimate_ls(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A and b; the note says which gyro bias was taken as known."""
    known = settings.known_gyro_bias_rad_s
    _, phi = residual(per_sample(data, settings), np.zeros(6), np.zeros(3), known)
    R = np.asarray(np.linalg.qr(phi[:, :9]).R)
    x = np.concatenate([upper_triangle(np.eye(3)), np.zeros(3)])
    for count in range(1, _LS_MAX_STEPS + 1):
        r, J = _rows(R, x)
        # rcond drops the direction along A, whose singular value is rounding only
        step = np.asarray(np.linalg.lstsq(J, -r, rcond=1e-10)[0])
        x, moved = _taken(R, x, step, float(r @ r))
        if moved < _LS_TOLERANCE:
            A, b = answer(unit_volume(x[:6])[0], x[6:])
            note = "gyro bias taken as given" if np.any(known) else "gyro bias taken as zero"
            return MethodFit(A, b, None, count, note)
    raise MethodError(f"no end after {_LS_MAX_STEPS} steps")


def _rows(R: Array, x: Array) -> tuple[Array, Array]:
    """Residual (9,) of x = [A (6), b' (3)] and its derivative (9, 9)."""
    c6, J6 = unit_volume(x[:6])
    return R @ np.concatenate([c6, x[6:]]), np.hstack([R[:, :6] @ J6, R[:, 6:]])


def _taken(R: Array, x: Array, step: Array, cost: float) -> tuple[Array, float]:
    """x after the longest halving of the step that does not raise the cost, and how far it went."""
    for halving in range(_LS_MAX_HALVINGS):
        part = step / 2**halving
        new = x + part
        if positive(new[:6]):
            new[:6] = upper_triangle(rescaled(symmetric(new[:6])))
            r, _ = _rows(R, new)
            if r @ r <= cost:
                return new, float(np.linalg.norm(part))
    return x, 0.0


# -- MAGICAL-NLS -----------------------------------------------------------------------------------
#
# MAGICAL-NLS: nonlinear least squares for soft iron, hard iron and gyro bias.
#
#     minimise sum |[w - w_b]x (C m - b') + C m'|^2
#
# over 12 unknowns, the terms of A (C = A^-1, rescaled to unit volume each time), b' and w_b. Start
# A = I, b' = 0, w_b = 0; trust region reflective, tolerance 1e-6.


NLS_TOLERANCE = 1e-6
_NLS_MAX_EVALUATIONS = 1000


def unit_volume_model() -> Model:
    """Terms of A, b' and w_b in one node."""
    start = np.concatenate([upper_triangle(np.eye(3)), np.zeros(6)])
    return Model(unit_volume, start, (12,), norm=False)


def estimate_nls(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError where the search diverges or does not end."""
    kin, m = per_sample(data, settings), unit_volume_model()
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
        ftol=NLS_TOLERANCE,
        xtol=NLS_TOLERANCE,
        gtol=NLS_TOLERANCE,
        max_nfev=_NLS_MAX_EVALUATIONS,
    )
    if not found.success:
        raise MethodError(f"no end after {found.nfev} evaluations")
    return m.fit(np.asarray(found.x), int(found.nfev))


# -- MAGICAL-BFG -----------------------------------------------------------------------------------
#
# MAGICAL-BFG: batch factor graph ([R]).
#
# One node x = (C's upper triangle, b', w_b). Per averaged window of theta samples one residual
# factor
#
#     [w - w_b]x (C m - b') + C m'
#
# and one norm factor |C|_F - 1 that keeps C from vanishing; relative and absolute tolerance 1e-7. A
# = C^-1 is rescaled to unit volume and b = A b' at the end.


def triangle_model() -> Model:
    """C's triangle, b' and w_b in one node, with the norm factor; start C = I."""
    start = np.concatenate([upper_triangle(np.eye(3)), np.zeros(6)])
    return Model(triangle, start, (12,), norm=True)


def estimate_bfg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.batch`."""
    return batch(triangle_model(), windowed(data, settings))


# -- MAGICAL-IFG -----------------------------------------------------------------------------------
#
# MAGICAL-IFG: incremental factor graph ([R]).
#
# MAGICAL-BFG's factors as they arrive, averaged over a window of theta samples, optimised every
# Gamma factors (iSAM2 with dogleg); the answer is the mean of the last 20 % of the estimates.
#
# The seed's figures come out only where iSAM2 never linearises again, which is the default here:
# the derivative by the gyro bias, [C m - b']x, then stays that of C = I while the norm factor takes
# |C|_F from sqrt 3 to 1, and the gyro bias comes out at about half of the truth, as in [R] Table
# 5.1. `MethodSettings.relinearize` mends it.


NEVER = 0.0


def estimate_ifg(data: MethodData, settings: MethodSettings) -> MethodFit:
    """A, b and w_b.  MethodError as `graphs.incremental`."""
    threshold = NEVER if settings.relinearize is None else settings.relinearize
    return incremental(triangle_model(), windowed(data, settings), settings, threshold)
