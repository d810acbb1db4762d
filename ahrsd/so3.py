"""Rotations as arrays: what `scipy.spatial.transform.Rotation` does not have, or does slower.

Quaternions are scipy's everywhere (`Rotation.from_quat`, `as_quat`). Here are

* the left Jacobian, skew, tangent bases, running products: scipy has none of them;
* Log: scipy's, which first makes a rotation of every matrix, takes up to 40 times as long;
* yaw, pitch, roll to matrices: scipy's takes up to 30 times as long;
* Exp, of the same terms as the Jacobian. Scipy's is faster, but its last digit is another, and on
  that rest the recorded decisions of the estimator.

`python tests/benchmarks/estimator/bench_rotations.py` prints these ratios.

Exp(phi) = I + a [phi]x + b [phi]x^2,  a = sin(t)/t,  b = (1 - cos(t))/t^2,  t = |phi|
Jl(phi)  = I + b [phi]x + c [phi]x^2,  c = (t - sin(t))/t^3
with Exp(phi + d) = Exp(Jl(phi) d) Exp(phi) to first order in d (checked numerically in
tests/vocabulary/test_so3.py). Below t = 1e-3 the coefficients are their Taylor series, whose first
neglected terms are below 1e-15 there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL = 1e-3


def skew(v: Array) -> Array:
    """[v]x of (..., 3) vectors: skew(a) @ b = a x b.  Returns (..., 3, 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _series(t2: Array) -> tuple[Array, Array, Array]:
    t = np.sqrt(t2)
    small = t < _SMALL
    safe = np.where(small, 1.0, t)  # the untaken branch must not divide by zero
    sine, safe2 = np.sin(safe), safe * safe
    a = np.where(small, 1 - t2 / 6, sine / safe)
    b = np.where(small, 0.5 - t2 / 24, (1 - np.cos(safe)) / safe2)
    c = np.where(small, 1 / 6 - t2 / 120, (safe - sine) / (safe * safe2))
    return a, b, c


def _polynomial(v: Array, t2: Array, a: Array, b: Array) -> Array:
    """I + a [v]x + b [v]x^2 of v (3, ...) with |v|^2 = t2: (3, 3, ...)."""
    out = v[:, None] * (b * v)  # [v]x^2 = v v^T - |v|^2 I
    x, y, z = a * v
    out[0, 1] -= z
    out[1, 0] += z
    out[0, 2] += y
    out[2, 0] -= y
    out[1, 2] -= x
    out[2, 1] += x
    rest = 1 - b * t2
    for i in range(3):
        out[i, i] += rest
    return np.asarray(out)


def _columns(phi: Array) -> tuple[Array, Array]:
    v = np.ascontiguousarray(np.moveaxis(phi, -1, 0))
    return v, np.sum(v * v, axis=0)


def _matrices(columns: Array) -> Array:
    return np.ascontiguousarray(np.moveaxis(columns, (0, 1), (-2, -1)))


def exp(phi: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad."""
    v, t2 = _columns(phi)
    a, b, _ = _series(t2)
    return _matrices(_polynomial(v, t2, a, b))


def exp_and_left_jacobian(phi: Array) -> tuple[Array, Array]:
    """Exp(phi) and Jl(phi), both (..., 3, 3)."""
    R, Jl = columns_exp_and_left_jacobian(_columns(phi)[0])
    return _matrices(R), _matrices(Jl)


def columns_exp_and_left_jacobian(v: Array) -> tuple[Array, Array]:
    """Exp(v) and Jl(v), both (3, 3, ...), of rotation vectors v (3, ...)."""
    t2 = np.sum(v * v, axis=0)
    a, b, c = _series(t2)
    return _polynomial(v, t2, a, b), _polynomial(v, t2, b, c)


def products(R: Array) -> Array:
    """Products of all rotations (n, 3, 3) up to each row: within parts, then of the parts."""
    n, part = len(R), 16
    if n <= part:
        parts = R.copy()[None]
    else:
        whole = np.concatenate([R, np.broadcast_to(np.eye(3), (-n % part, 3, 3))])
        parts = whole.reshape(-1, part, 3, 3)
    step = 1
    while step < part:
        parts[:, step:] = parts[:, :-step] @ parts[:, step:]
        step *= 2
    if n > part:
        parts[1:] = products(parts[:-1, -1])[:, None] @ parts[1:]
    return parts.reshape(-1, 3, 3)[:n]


def from_yaw_pitch_roll(yaw: Array, pitch: Array, roll: Array) -> Array:
    """R_nb (N, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll) of angles (N,) in rad."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    R = np.empty((len(yaw), 3, 3))
    R[:, 0] = np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=1)
    R[:, 1] = np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=1)
    R[:, 2] = np.stack([-sp, cp * sr, cp * cr], axis=1)
    return R


def compose(phi: Array) -> Array:
    """Rotation vector of Exp(phi_1) Exp(phi_2) ... (body increments), for (N, n, 3)."""
    if phi.shape[1] == 1:
        return np.asarray(phi[:, 0])
    R = exp(phi[:, 0])
    for j in range(1, phi.shape[1]):
        R = R @ exp(phi[:, j])
    return log(R)


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
    """(N, 3, 2) orthonormal bases of the planes normal to the unit vectors u (N, 3)."""
    out = np.empty((len(u), 3, 2))
    _bases(u.T, out.transpose(1, 2, 0))
    return out


def frames(u: Array) -> Array:
    """(3, 3, N): two tangents of the unit vectors u (3, N), and these themselves."""
    out = np.empty((3, 3, u.shape[1]))
    _bases(u, out)
    out[:, 2] = u
    return out


def _bases(u: Array, out: Array) -> None:
    """Tangents of u (3, N) into the first two columns of `out` (3, 2+, N).

    Without branches (Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017).
    """
    x, y, z = u
    s = np.copysign(1.0, z)
    a = -1.0 / (s + z)
    ab = x * y * a
    out[0, 0], out[1, 0], out[2, 0] = 1.0 + s * x * x * a, s * ab, -s * x
    out[0, 1], out[1, 1], out[2, 1] = ab, s + y * y * a, -y
