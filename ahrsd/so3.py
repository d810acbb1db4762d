"""Rotations, vectorised over the first axis: Exp, Log, skew and the left Jacobian.

Exp(phi) = I + a [phi]x + b [phi]x^2,  a = sin(t)/t,  b = (1 - cos(t))/t^2,  t = |phi|
Jl(phi)  = I + b [phi]x + c [phi]x^2,  c = (t - sin(t))/t^3
with Exp(phi + d) = Exp(Jl(phi) d) Exp(phi) to first order in d (checked numerically in
tests/test_so3.py). Below t = 1e-3 the coefficients are their Taylor series, whose first neglected
terms are below 1e-15 there.
"""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array

_SMALL = 1e-3


def skew(v: Array) -> Array:
    """[v]x of (..., 3) vectors: skew(a) @ b = a x b.  Returns (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _series(phi: Array) -> tuple[Array, Array, Array, Array, Array]:
    t2 = np.sum(phi * phi, axis=-1)
    t = np.sqrt(t2)
    small = t < _SMALL
    safe = np.where(small, 1.0, t)  # the untaken branch must not divide by zero
    a = np.where(small, 1 - t2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - t2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - t2 / 120, (safe - np.sin(safe)) / safe**3)
    K = skew(phi)
    return a[..., None, None], b[..., None, None], c[..., None, None], K, K @ K


def exp(phi: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad."""
    a, b, _, K, K2 = _series(phi)
    return np.asarray(np.eye(3) + a * K + b * K2)


def exp_and_left_jacobian(phi: Array) -> tuple[Array, Array]:
    """Exp(phi) and Jl(phi), both (..., 3, 3)."""
    a, b, c, K, K2 = _series(phi)
    return np.asarray(np.eye(3) + a * K + b * K2), np.asarray(np.eye(3) + b * K + c * K2)


def log(R: Array) -> Array:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3); |phi| <= pi.

    Near pi the axis comes from the symmetric part (R + R^T)/2 = cos t I + (1 - cos t) n n^T, whose
    largest diagonal entry is well conditioned there.
    """
    v = np.stack(
        [
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ],
        axis=-1,
    )
    sin2 = np.linalg.norm(v, axis=-1)
    cos2 = np.trace(R, axis1=-2, axis2=-1) - 1
    t = np.arctan2(sin2, cos2)
    scale = np.where(sin2 > 1e-9, t / np.where(sin2 > 1e-9, sin2, 1.0), 0.5)
    out = np.asarray(v * scale[..., None])
    near_pi = (np.pi - t) < 1e-4
    if np.any(near_pi):
        out[near_pi] = _log_near_pi(R[near_pi], v[near_pi], t[near_pi])
    return out


def _log_near_pi(R: Array, v: Array, t: Array) -> Array:
    S = (R + np.swapaxes(R, -1, -2)) / 2
    nn = (S - np.cos(t)[..., None, None] * np.eye(3)) / (1 - np.cos(t))[..., None, None]
    k = np.argmax(np.diagonal(nn, axis1=-2, axis2=-1), axis=-1)
    n = np.take_along_axis(nn, k[..., None, None], axis=-1)[..., 0]
    n = n / np.linalg.norm(n, axis=-1, keepdims=True)
    sign = np.where(np.sum(n * v, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return np.asarray(sign * n * t[..., None])


def tangent_basis(u: Array) -> Array:
    """(N, 3, 2) orthonormal bases of the planes normal to the unit vectors u (N, 3).

    Without branches (Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017).
    """
    x, y, z = u.T
    s = np.copysign(1.0, z)
    a = -1.0 / (s + z)
    ab = x * y * a
    out = np.empty((len(u), 3, 2))
    out[:, 0, 0], out[:, 1, 0], out[:, 2, 0] = 1.0 + s * x * x * a, s * ab, -s * x
    out[:, 0, 1], out[:, 1, 1], out[:, 2, 1] = ab, s + y * y * a, -y
    return out
