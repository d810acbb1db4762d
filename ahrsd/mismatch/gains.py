"""Kalman gains of a linear model over all samples, block-parallel and exact.

    P-_k = S_k P_(k-1) S_k^T + Q_k,   S = H P- H^T + R,   K = P- H^T S^-1,   P_k = P- - K S K^T

with H = [A 0] and R = sigma^2 I.  A block's whole effect on the covariance is the triple (T, C, J)
of p(x_end | x_start) ~ N(T x_start, C) and of the information J that its readings hold on x_start
(Sarkka & Garcia-Fernandez, IEEE TAC 66(1), 2021, eq. 10-14): the filter from P = 0 gives it, and

    P_end = T P (I + J P)^-1 T^T + C

chains the blocks; a second pass from the true starts gives every gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.mismatch.blocks import Layout
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The model of every sample.

    transition: (N, s, s); of a run's first row it drops what that row knows anew
    process:    (N, s, s); of a run's first row the covariance that its reading leaves
    soft_iron:  A (3, 3);  variance: sigma_mag^2
    opens:      (N,) a run's first row: the state is taken from the reading
    blind:      (N,) no reading in this row
    """

    transition: Array
    process: Array
    soft_iron: Array
    variance: float
    opens: NDArray[np.bool]
    blind: NDArray[np.bool]


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """gain K (N, s, 3); innovation_covariance (N, 3, 3); covariance behind each row is not kept."""

    gain: Array
    innovation_covariance: Array


def gains(model: Linear, layout: Layout) -> Gains:
    """Gains of all rows."""
    sweep = _Sweep(model, layout)
    starts = _starts(*sweep.element())
    gain, S = sweep.filter(starts)
    gain[model.blind] = 0.0
    gain[model.opens, :3] = np.linalg.inv(model.soft_iron)
    gain[model.opens, 3:] = 0.0
    return Gains(gain, S)


def _starts(T: Array, C: Array, J: Array) -> Array:
    """Covariance at the start of each block (B, s, s); the first block opens a run."""
    size = T.shape[-1]
    out = np.empty_like(C)
    P = np.zeros((size, size))
    for b in range(len(T)):
        out[b] = P
        P = T[b] @ P @ np.linalg.solve(np.eye(size) + J[b] @ P, T[b].T) + C[b]
        P = (P + P.T) / 2
    return out


class _Sweep:
    """All blocks, step by step."""

    def __init__(self, model: Linear, layout: Layout) -> None:
        size = model.transition.shape[-1]
        self._layout = layout
        self._A = model.soft_iron
        self._R = model.variance * np.eye(3)
        self._steps = layout.padded(model.transition, np.eye(size))
        self._process = layout.padded(model.process, 0.0)
        self._blind = layout.padded((model.blind | model.opens).astype(float), 1.0) > 0
        self._any_blind = np.any(self._blind, axis=1)

    def _prior(self, j: int, P: Array) -> tuple[Array, Array, Array]:
        """P-, A P-[:3] as (B, 3, s), and S of step j, from P behind step j - 1."""
        step = self._steps[j]
        prior = step @ P @ np.swapaxes(step, 1, 2) + self._process[j]
        cross = self._A @ prior[:, :3]
        return prior, cross, cross[:, :, :3] @ self._A + self._R

    def element(self) -> tuple[Array, Array, Array]:
        """(T, C, J) of every block."""
        count, blocks, size = self._steps.shape[:3]
        C = np.zeros((blocks, size, size))
        J = np.zeros_like(C)
        T: Array = np.broadcast_to(np.eye(size), C.shape)
        for j in range(count):
            prior, cross, S = self._prior(j, C)
            moved = self._steps[j] @ T
            seen = self._A @ moved[:, :3]
            both = inverse(S) @ np.concatenate([cross, seen], axis=2)
            if self._any_blind[j]:
                both[self._blind[j]] = 0.0
            back = np.swapaxes(cross, 1, 2)
            C = _symmetric(prior - back @ both[:, :, :size])
            J = J + np.swapaxes(seen, 1, 2) @ both[:, :, size:]
            T = moved - back @ both[:, :, size:]
        return T, C, J

    def filter(self, P: Array) -> tuple[Array, Array]:
        """Gains (N, s, 3) and innovation covariances (N, 3, 3) from the true starts."""
        count, blocks, size = self._steps.shape[:3]
        gain = np.empty((count, blocks, size, 3))
        S = np.empty((count, blocks, 3, 3))
        for j in range(count):
            prior, cross, S[j] = self._prior(j, P)
            gain_t = inverse(S[j]) @ cross
            if self._any_blind[j]:
                gain_t[self._blind[j]] = 0.0
            gain[j] = np.swapaxes(gain_t, 1, 2)
            P = _symmetric(prior - gain[j] @ cross)
        return self._layout.unpadded(gain), self._layout.unpadded(S)


#: entries of a 3 x 3 matrix, row by row, whose products make up its cofactors, row by row
_FIRST = np.array([4, 5, 3, 7, 8, 6, 1, 2, 0]), np.array([8, 6, 7, 2, 0, 1, 5, 3, 4])
_SECOND = np.array([5, 3, 4, 8, 6, 7, 2, 0, 1]), np.array([7, 8, 6, 1, 2, 0, 4, 5, 3])


def inverse(S: Array) -> Array:
    """(B, 3, 3) of well-conditioned (B, 3, 3), by cofactors: LAPACK is called for each."""
    flat = S.reshape(-1, 9)
    cofactors = flat[:, _FIRST[0]] * flat[:, _FIRST[1]] - flat[:, _SECOND[0]] * flat[:, _SECOND[1]]
    determinant = np.einsum("bi,bi->b", flat[:, :3], cofactors[:, :3])
    return np.asarray(np.swapaxes((cofactors / determinant[:, None]).reshape(-1, 3, 3), 1, 2))


def _symmetric(P: Array) -> Array:
    return np.asarray((P + np.swapaxes(P, 1, 2)) / 2)
