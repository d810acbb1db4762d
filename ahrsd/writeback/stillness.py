"""Whether the vehicle stands still, judged from its own samples and failing closed."""

from __future__ import annotations

from collections import deque

import numpy as np

from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.policy import StillPolicy

_SLOTS_PER_WINDOW = 30  # the window is kept as sums of so many parts: memory does not grow


class Stillness:
    """A window of `duration_s` over rate (less bias) and specific force.

    Without an accelerometer, without samples, after a gap or with a rate over the limit it is not
    still.
    """

    def __init__(self, policy: StillPolicy) -> None:
        self._policy = policy
        self._since_s: float | None = None  # device time of the first sample of the still run
        self._device_s = self._host_s = -np.inf
        self._slots: deque[tuple[float, int, Array, Array]] = deque()

    def reset(self) -> None:
        """Nothing is known any more."""
        self._since_s = None
        self._slots.clear()

    def update(self, block: SampleBlock, gyro_bias_rad_s: Array) -> None:
        """Take N further samples of the raw sensor."""
        if not len(block):
            return
        if block.gap_before:
            self.reset()
        rate = np.linalg.norm(block.gyro_b_rad_s - gyro_bias_rad_s, axis=1)
        quiet = (rate < self._policy.gyro_rad_s) & np.isfinite(block.accel_b_m_s2).all(axis=1)
        loud = np.flatnonzero(~quiet)
        if len(loud):
            self.reset()
        first = int(loud[-1]) + 1 if len(loud) else 0
        if first < len(block):
            self._extend(block.time_s[first:], block.accel_b_m_s2[first:])
        self._device_s, self._host_s = float(block.time_s[-1]), float(block.host_s[-1])

    def why_not(self, host_s: float) -> str | None:
        """Why the vehicle does not count as still at this instant, None where it does."""
        policy = self._policy
        age_s = host_s - self._host_s
        if not age_s <= policy.max_age_s:
            return f"the newest sample is {age_s:.1f} s old, limit {policy.max_age_s} s"
        if self._since_s is None or self._device_s - self._since_s < policy.duration_s:
            still_s = 0.0 if self._since_s is None else self._device_s - self._since_s
            return f"still for {still_s:.1f} s, needed {policy.duration_s} s"
        spread = self._spread()
        if not spread < policy.accel_m_s2:
            return f"the specific force varies by {spread:.3f} m/s^2, limit {policy.accel_m_s2}"
        return None

    def _extend(self, time_s: Array, accel_m_s2: Array) -> None:
        if self._since_s is None:
            self._since_s = float(time_s[0])
        slot_s = self._policy.duration_s / _SLOTS_PER_WINDOW
        for index in np.unique(np.floor(time_s / slot_s)):
            part = accel_m_s2[np.floor(time_s / slot_s) == index]
            self._slots.append(
                (float(index * slot_s), len(part), part.sum(axis=0), (part**2).sum(axis=0))
            )
        newest_s = float(time_s[-1])
        while self._slots and newest_s - self._slots[0][0] > self._policy.duration_s + slot_s:
            self._slots.popleft()

    def _spread(self) -> float:
        """Standard deviation of the window, of the worst axis."""
        count = sum(slot[1] for slot in self._slots)
        mean = np.sum([slot[2] for slot in self._slots], axis=0) / count
        variance = np.sum([slot[3] for slot in self._slots], axis=0) / count - mean**2
        return float(np.sqrt(max(float(variance.max()), 0.0)))
