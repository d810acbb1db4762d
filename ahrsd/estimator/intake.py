"""From blocks of samples to the data of epochs; any split into blocks gives the same epochs.

The rate is measured on the first _RATE_ROWS samples after a start or a gap, whatever blocks they
came in; from it follows how many samples make a step, and likewise whether the magnetometer's
readings are held over several samples (`held`). Pieces between short gaps share an epoch:
nothing links the steps on the two sides of a gap, but the gyro's bias is the same.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from ahrsd import so3
from ahrsd.estimator import chain
from ahrsd.estimator.held import HeldReadings, rows_per_reading
from ahrsd.estimator.parameters import MIN_EPOCH_STEPS, EstimatorParameters
from ahrsd.estimator.steps import StepAverager, Steps, join, samples_per_step, split
from ahrsd.samples import Array, SampleBlock

_RATE_ROWS = 33
_LONGEST_GAP_S = 60.0  # after a longer one the gyro's bias may have moved
_SPARE = 2  # steps by which the count of what waits may be wrong


def check(block: SampleBlock) -> None:
    """Raises ValueError naming the first row that is not a finite sample with a positive step.

    Only the first row of a block after a gap may lack its step.
    """
    table = (
        ("time_s", block.time_s),
        ("raw_b_gauss", block.raw_b_gauss),
        ("gyro_b_rad_s", block.gyro_b_rad_s),
    )
    for name, values in table:
        good = np.isfinite(values if values.ndim == 1 else values.sum(axis=1))
        if not good.all():
            k = int(np.argmin(good))
            raise ValueError(f"{name} of row {k} is not finite: {values[k]}")
    start = int(block.gap_before)
    good = block.dt_s[start:] > 0.0
    good &= block.dt_s[start:] < np.inf
    if not good.all():
        k = start + int(np.argmin(good))
        raise ValueError(f"dt_s of row {k} is not a positive step: {block.dt_s[k]}")


class Intake:
    """Blocks in, epochs out; also counts what went in."""

    def __init__(self, parameters: EstimatorParameters) -> None:
        self._parameters = parameters
        self.averaged = 1
        self.samples = 0
        self._averager: StepAverager | None = None
        self._held: HeldReadings | None = None
        self._rows: list[Array] = []  # samples of a piece whose rate is not known yet
        self._waiting: list[Array] = []  # samples that are not steps yet
        self._waiting_count = 0
        self._pending: list[Steps] = []
        self._pending_count = 0
        self._fresh = True
        self._earlier_s = 0.0
        self._from_s: float | None = None
        self._to_s = 0.0

    @property
    def duration_s(self) -> float:
        """Time covered, gaps left out."""
        return self._earlier_s + (0.0 if self._from_s is None else self._to_s - self._from_s)

    def add(self, block: SampleBlock) -> list[chain.EpochData]:
        """Take samples that follow the last ones without a gap; return completed epochs."""
        if len(block) == 0:
            return []
        self.samples += len(block)
        if self._from_s is None:
            self._from_s = float(block.time_s[0])
        self._to_s = float(block.time_s[-1])
        rows = np.column_stack(
            [block.time_s, block.dt_s, block.raw_b_gauss, block.gyro_b_rad_s, block.accel_b_m_s2]
        )
        closed: list[chain.EpochData] = []
        if self._averager is None:
            self._rows.append(rows)
            rows = np.vstack(self._rows)
            length = rows_per_reading(rows, _RATE_ROWS)
            if length is None:
                return []
            self._rows.clear()
            closed = self._measure(rows[1:_RATE_ROWS, 1], length)
        if self._held is not None:
            rows = self._held.thin(rows)
        self._waiting.append(rows)
        self._waiting_count += len(rows)
        enough = self._parameters.epoch_steps + int(self._fresh)
        if self._pending_count + self._waiting_count // self.averaged + _SPARE >= enough:
            self._work_off()
        return closed + self._complete()

    def _work_off(self) -> None:
        """Make steps of what waits; small blocks wait, because each would cost as much as one."""
        if self._waiting:
            self._take(np.vstack(self._waiting))
            self._waiting.clear()
            self._waiting_count = 0

    def _measure(self, dt_s: Array, length: int) -> list[chain.EpochData]:
        """Measure the rate; steps of another length do not share an epoch.

        length: samples for which a reading is held
        """
        self._held = HeldReadings(length) if length > 1 else None
        rate_hz = 1.0 / (length * float(np.median(dt_s)))
        averaged = samples_per_step(rate_hz, self._parameters.step_rate_hz)
        data = self._closed() if averaged != self.averaged else None
        self.averaged = averaged
        self._averager = StepAverager(averaged)
        return [] if data is None else [data]

    def _take(self, rows: Array) -> None:
        averager = self._averager or StepAverager(self.averaged)
        steps = averager.add(rows)
        if len(steps):
            self._pending.append(steps)
            self._pending_count += len(steps)

    def gap(self, next_s: float) -> list[chain.EpochData]:
        """The next sample, at `next_s`, does not follow the last one; epochs that end here."""
        self._work_off()
        if self._averager is None and self._pending_count and self._too_short:
            rows = np.vstack(self._rows)  # too short to tell its rate: as the one before
            self._take(rows if self._held is None else HeldReadings(self._held.length).thin(rows))
        closed = self._settled() + self._complete()
        if self._pending_count and 0.0 <= next_s - self._to_s <= _LONGEST_GAP_S:
            self._cut()
        elif (data := self.interrupt()) is not None:
            closed.append(data)
        return closed

    @property
    def _too_short(self) -> bool:
        return 0 < sum(map(len, self._rows)) < _RATE_ROWS

    def _settled(self) -> list[chain.EpochData]:
        """A piece that ends before it is known how long readings are held: as in the one before."""
        if self._averager is not None or not self._rows or self._too_short:
            return []
        rows = np.vstack(self._rows)
        self._rows.clear()
        length = 1 if self._held is None else self._held.length
        closed = self._measure(rows[1:_RATE_ROWS, 1], length)
        self._take(rows if self._held is None else self._held.thin(rows))
        return closed

    def _cut(self) -> None:
        self._rows.clear()
        self._averager = None
        self._earlier_s, self._from_s = self.duration_s, None

    def _complete(self) -> list[chain.EpochData]:
        closed = []
        while self._pending_count >= self._parameters.epoch_steps + int(self._fresh):
            closed.append(self._close(self._parameters.epoch_steps + int(self._fresh)))
        return closed

    @property
    def pending(self) -> int:
        """Steps of the epoch that is not complete yet."""
        self._work_off()
        return self._pending_count

    def copy(self) -> Intake:
        """A copy that goes its own way, for closing the epoch early."""
        self._work_off()
        other = copy(self)
        other._pending, other._rows = list(self._pending), list(self._rows)
        other._averager, other._waiting = copy(self._averager), []
        other._held = None if self._held is None else self._held.copy()
        return other

    def interrupt(self) -> chain.EpochData | None:
        """What is pending as a short epoch, if it is worth one; the next one starts anew."""
        self._work_off()
        data = self._closed()
        self._cut()
        return data

    def _closed(self) -> chain.EpochData | None:
        enough = self._pending_count >= MIN_EPOCH_STEPS
        data = self._close(self._pending_count) if enough else None
        self._pending.clear()
        self._pending_count = 0
        self._fresh = True
        return data

    def _close(self, count: int) -> chain.EpochData:
        steps, rest = split(join(self._pending), count)
        self._pending = [rest] if len(rest) else []
        self._pending_count = len(rest)
        fresh, self._fresh = self._fresh, False
        cut = steps.linked == 0
        angle = np.where(cut[:, None], 0.0, steps.angle_b_rad)
        return chain.EpochData(
            steps.field_b_gauss,
            angle,
            np.where(cut, np.median(steps.dt_s[~cut]), steps.dt_s),
            _down(steps.accel_b_m_s2, angle),
            steps.time_s,
            measures_first=fresh,
            linked=steps.linked if cut[1:].any() else None,
        )


def _down(accel: Array, angle: Array) -> Array:
    """Unit vectors towards the earth (n, 3) from specific force, which points up at rest.

    The force is averaged over the epoch in one frame, that of its middle, to which the gyro's
    angles (n, 3) turn it: what a vehicle does to get round a bend averages out there, and so does a
    gyro's bias to first order.
    """
    if not np.isfinite(accel).all():
        return np.full_like(accel, np.nan)
    R = so3.products(so3.exp(angle))
    up = np.einsum("nji,j->ni", R, np.einsum("nij,nj->i", R, accel))
    return np.asarray(-up / np.maximum(np.sqrt(np.sum(up * up, axis=1, keepdims=True)), 1e-9))


def with_border(data: chain.EpochData, before: chain.EpochData) -> chain.EpochData:
    """Put the previous epoch's last step in front, as the shared border."""
    return chain.EpochData(
        np.vstack([before.field_b_gauss[-1:], data.field_b_gauss]),
        np.vstack([np.zeros((1, 3)), data.angle_b_rad]),
        np.r_[data.dt_s[0], data.dt_s],
        np.vstack([before.down_b[-1:], data.down_b]),
        np.r_[before.time_s[-1], data.time_s],
        measures_first=False,
        linked=None if data.linked is None else np.r_[1.0, data.linked],
    )
