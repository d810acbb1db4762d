"""The emulated device's own real-time hard and soft iron compensation (registers 44 and 47).

A quadric  m' Q m + 2 u' m = 1  fitted to the field as it leaves register 26, with old samples
fading away and a weak pull towards the present solution, so that directions which the motion does
not show stay as they are. Then B = -Q^-1 u and C = Q^(1/2) with det C = 1, as in register 23.
How the real device does it is not public; this one converges in the times that register 44 states.
"""

from __future__ import annotations

import numpy as np

from drivers.vn100.emulator.motion import Array

FADING_S = {1: 90.0, 2: 70.0, 3: 50.0, 4: 30.0, 5: 18.0}  # by ConvergeRate
SAMPLE_TICKS = 40  # one sample in so many ticks is used
_PULL = 1e-4  # of the weight of the data
_STEP_GAUSS = 0.02
_UNIT_GAUSS = 0.5  # so that the quadric's coefficients are about 1


class OnBoardHsi:
    """Fits (C, B) to the samples it is given; `reset` begins again."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the solution and the samples."""
        self.matrix: Array = np.eye(3)
        self.offset: Array = np.zeros(3)
        self._moments: Array = np.zeros((9, 9))
        self._sums: Array = np.zeros(9)
        self._weight = 0.0
        self._solution: Array | None = None
        self._newest: Array | None = None

    def add(self, field_gauss: Array, converge_rate: int, period_s: float) -> None:
        """Use samples (N, 3), one every `period_s`, as far as the field has moved, and solve."""
        fade = np.exp(-len(field_gauss) * period_s / FADING_S[converge_rate])
        moved = [sample for sample in field_gauss if self._moved(sample)]
        if not moved:
            return
        field_gauss = np.array(moved)
        x, y, z = (field_gauss / _UNIT_GAUSS).T
        rows = np.column_stack((x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z))
        rows = np.hstack((rows, 2 * field_gauss / _UNIT_GAUSS))
        self._moments = fade * self._moments + rows.T @ rows
        self._sums = fade * self._sums + rows.sum(axis=0)
        self._weight = fade * self._weight + len(rows)
        if self._solution is None:
            power = float(np.mean(np.sum(rows[:, :3], axis=1)))
            self._solution = np.concatenate((np.full(3, 1 / power), np.zeros(6)))
        self._solve(self._solution)

    def _moved(self, sample: Array) -> bool:
        """Whether this is a new direction: at rest there is nothing to learn but noise."""
        if not sample.any():  # a matrix of zeros in register 23
            return False
        if self._newest is not None and np.linalg.norm(sample - self._newest) < _STEP_GAUSS:
            return False
        self._newest = sample
        return True

    def _solve(self, present: Array) -> None:
        pull = _PULL * self._weight
        pulled = self._moments + pull * np.eye(9)
        found = np.asarray(np.linalg.solve(pulled, self._sums + pull * present), np.float64)
        a, b, c, d, e, f = found[:6]
        Q = np.array([[a, d, e], [d, b, f], [e, f, c]])
        eigenvalues, axes = np.linalg.eigh(Q)
        if eigenvalues[0] < 0.05 * eigenvalues[2] or eigenvalues[2] <= 0:
            return  # no ellipsoid: the motion was too small
        self._solution = found
        root = (axes * np.sqrt(eigenvalues)) @ axes.T
        self.matrix = np.asarray(root / np.linalg.det(root) ** (1 / 3))
        self.offset = -np.linalg.solve(Q, found[6:]) * _UNIT_GAUSS
