"""How still the corrected field stands when the corrected gyroscope carries it into one frame.

u_k = R_k C (m_k - B),  R_k = R_{k-1} Exp((w_k - w_b) dt_k),  R = I at the start of a stretch

On the Earth u does not move: its spread over a stretch, |u - mean| / |mean| (rms), is the error of
both corrections together and knows no other reference. A wrong gyro bias turns u, a wrong C or B
makes it wander as the vehicle turns, and a C that is turned about an axis does so wherever the
vehicle turns about another one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.samples import Array, SampleBlock

STRETCH_S = 10.0
STRETCHES = 6  # that are remembered: a minute
_FEWEST = 10  # samples of a stretch that count


class CarriedField:
    """Pairs of corrections side by side on the same samples; `spreads` in the order of `pairs`."""

    def __init__(self, pairs: Sequence[tuple[Affine, Array]]) -> None:
        self._pairs = [(mag, bias.copy()) for mag, bias in pairs]
        self._done: deque[Array] = deque(maxlen=STRETCHES)
        self._begin()

    def take(self, block: SampleBlock) -> None:
        """Further samples; a step of unknown length begins a new stretch."""
        usable = np.isfinite(block.gyro_b_rad_s).all(axis=1) & np.isfinite(block.dt_s)
        dt_s = np.where(usable, block.dt_s, 0.0)
        rate = np.where(usable[:, None], block.gyro_b_rad_s, 0.0)
        turns = [so3.exp((rate - bias) * dt_s[:, None]) for _, bias in self._pairs]
        fields = [mag.apply(block.raw_b_gauss) for mag, _ in self._pairs]
        for k in range(len(block)):
            if not usable[k] or self._length_s > STRETCH_S:
                self._end()
                self._begin()
                continue
            self._length_s += float(dt_s[k])
            for n in range(len(self._pairs)):
                self._R[n] = self._R[n] @ turns[n][k]
                self._carried[n].append(self._R[n] @ fields[n][k])

    @property
    def spreads(self) -> Array:
        """(pairs,) rms over the newest stretches; nan before the first one has ended."""
        if not self._done:
            return np.full(len(self._pairs), np.nan)
        return np.asarray(np.sqrt(np.mean(self._done, axis=0)))

    def _begin(self) -> None:
        self._length_s = 0.0
        self._R = [np.eye(3) for _ in self._pairs]
        self._carried: list[list[Array]] = [[] for _ in self._pairs]

    def _end(self) -> None:
        if len(self._carried[0]) < _FEWEST:
            return
        u = np.array(self._carried)
        mean = u.mean(axis=1)
        squares = ((u - mean[:, None]) ** 2).sum(axis=2).mean(axis=1)
        self._done.append(squares / (mean**2).sum(axis=1))
